"""The first signal ends a process in order, the second one at once."""

import ctypes
import os
import signal
import time
from collections.abc import Iterator

import pytest

from nerf_lightning.utils.signals import (
    SIGNALS,
    SignalInterrupt,
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


def test_handle_signals_signal_raises_at_once(signum: int):
    with handle_signals(), handle_signals():
        with pytest.raises(SignalInterrupt) as raised:
            signal.raise_signal(signum)
        assert raised.value.signum == received_signal() == signum
        with pytest.raises(SignalInterrupt):  # also where a clean-up has lost it
            raise_if_signalled()


def test_handle_signals_signal_in_callback_raises_after_it(signum: int):
    callback = ctypes.CFUNCTYPE(None)(lambda: signal.raise_signal(signum))  # no exception leaves it
    with handle_signals(), pytest.raises(SignalInterrupt):
        callback()
        time.sleep(10)


def test_defer_signals_nested_raises_after_outer_block(signum: int, capfd: pytest.CaptureFixture[str]):
    done = []
    with handle_signals(), pytest.raises(SignalInterrupt), defer_signals():
        with defer_signals():
            signal.raise_signal(signum)
        done.append("outer block")
    assert done and capfd.readouterr().err.count("\n") == 1, "says at once that it has heard"


def test_defer_signals_false_lets_part_be_interrupted(signum: int):
    done = []
    with handle_signals(), pytest.raises(SignalInterrupt), defer_signals(), defer_signals(False):
        signal.raise_signal(signum)
        done.append("not reached")
    with handle_signals(), pytest.raises(SignalInterrupt), defer_signals():
        signal.raise_signal(signum)
        with defer_signals(False):
            done.append("not begun")
    assert not done


def test_handle_signals_second_signal_exits_at_once(signum: int, monkeypatch: pytest.MonkeyPatch):
    codes: list[int] = []
    monkeypatch.setattr(os, "_exit", codes.append)
    with handle_signals(), pytest.raises(SignalInterrupt), defer_signals():
        signal.raise_signal(signum)
        assert not codes
        signal.raise_signal(signum)
        assert codes == [128 + signum]


@pytest.mark.parametrize("error", [None, RuntimeError])
def test_exit_on_signal_prints_one_line(error: type[Exception] | None, signum: int, capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as end, exit_on_signal():
        try:
            signal.raise_signal(signum)
        except SignalInterrupt as interrupted:
            if error is not None:
                raise error from interrupted  # of a library
            interrupted.hint = "resume it"
            raise
    assert end.value.code == 128 + signum
    line = capsys.readouterr().err
    assert signal.Signals(signum).name in line and line.count("\n") == 1 and ("resume it" in line) == (error is None)
