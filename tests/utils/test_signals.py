"""The first signal ends a process in order, the second one at once."""

import ctypes
import os
import signal
import time
from collections.abc import Iterator

import pytest

from nerf_lightning.utils.signals import (
    SIGNALS,
    Interrupted,
    defer_signals,
    exit_on_signal,
    handle_signals,
    raise_if_signalled,
    received_signal,
)


@pytest.fixture(params=SIGNALS, ids=lambda signum: signum.name)
def signum(request: pytest.FixtureRequest) -> Iterator[int]:
    yield request.param
    assert received_signal() is None, "forgotten after the block"
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_signal_raises_where_the_process_is(signum: int):
    with handle_signals(), handle_signals():
        with pytest.raises(Interrupted) as raised:
            signal.raise_signal(signum)
        assert raised.value.signum == received_signal() == signum
        with pytest.raises(Interrupted):  # also where a clean-up has lost it
            raise_if_signalled()


def test_signal_in_a_callback_is_raised_after_it(signum: int):
    callback = ctypes.CFUNCTYPE(None)(lambda: signal.raise_signal(signum))  # no exception leaves it
    with handle_signals(), pytest.raises(Interrupted):
        callback()
        time.sleep(10)


def test_deferred_signal_is_raised_after_the_outer_block(signum: int, capfd: pytest.CaptureFixture[str]):
    done = []
    with handle_signals(), pytest.raises(Interrupted), defer_signals():
        with defer_signals():
            signal.raise_signal(signum)
        done.append("outer block")
    assert done and capfd.readouterr().err.count("\n") == 1, "says at once that it has heard"


def test_part_of_a_deferring_block_may_be_interrupted(signum: int):
    done = []
    with handle_signals(), pytest.raises(Interrupted), defer_signals(), defer_signals(False):
        signal.raise_signal(signum)
        done.append("not reached")
    with handle_signals(), pytest.raises(Interrupted), defer_signals():
        signal.raise_signal(signum)
        with defer_signals(False):
            done.append("not begun")
    assert not done


def test_second_signal_exits_at_once(signum: int, monkeypatch: pytest.MonkeyPatch):
    codes: list[int] = []
    monkeypatch.setattr(os, "_exit", codes.append)
    with handle_signals(), pytest.raises(Interrupted), defer_signals():
        signal.raise_signal(signum)
        assert not codes
        signal.raise_signal(signum)
        assert codes == [128 + signum]


@pytest.mark.parametrize("error", [None, RuntimeError])
def test_command_line_exits_with_a_line(error: type[Exception] | None, signum: int, capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as end, exit_on_signal():
        try:
            signal.raise_signal(signum)
        except Interrupted as interrupted:
            if error is not None:
                raise error from interrupted  # of a library
            interrupted.hint = "resume it"
            raise
    assert end.value.code == 128 + signum
    line = capsys.readouterr().err
    assert signal.Signals(signum).name in line and line.count("\n") == 1 and ("resume it" in line) == (error is None)
