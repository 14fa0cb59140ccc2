"""Asked to end: at once, after a block, as somebody else wants it, and before anything began."""

import os
import pickle
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from nerf_lightning.errors import InputError, NoRoom
from nerf_lightning.utils import ending
from nerf_lightning.utils.ending import (
    Interrupted,
    asked,
    held,
    interruptible,
    leave,
    leave_if_asked,
    listen,
    listening,
)
from nerf_lightning.utils.files import atomic, atomic_folder

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(params=ending.SIGNALS, ids=lambda number: number.name)
def number(request: pytest.FixtureRequest) -> Iterator[int]:
    listen()
    yield request.param
    listen()  # forgets


def test_a_signal_is_raised_where_it_comes_and_after_what_must_be_whole(number: int):
    with pytest.raises(Interrupted) as raised:
        signal.raise_signal(number)
    assert raised.value.number == asked() == number
    listen()
    assert asked() is None
    done = []
    with pytest.raises(Interrupted), held():
        with held():
            signal.raise_signal(number)
            signal.raise_signal(number)
        done.append("the inner block ends, the outer one goes on")
    assert done
    with held():
        pass  # raised once; but who asks is told again
    with pytest.raises(Interrupted):
        leave_if_asked()
    with pytest.raises(KeyError), held():  # what failed is told, and no signal instead
        raise KeyError


def test_what_may_be_left_at_any_point_is_left_at_once_and_says_so(number: int, capfd: pytest.CaptureFixture[str]):
    name = signal.Signals(number).name
    with pytest.raises(Interrupted), held("after this step"), interruptible("after this row"):
        with held():
            signal.raise_signal(number)  # a file is written whole
            done = True
        raise AssertionError("the row does not end")
    assert done and capfd.readouterr().err == f"nerf_lightning: {name}: after this row\n"
    listen()
    steps = []
    with pytest.raises(Interrupted), held("after this step"):
        signal.raise_signal(number)
        signal.raise_signal(number)
        steps.append("ends")
        assert capfd.readouterr().err == f"nerf_lightning: {name}: after this step\n", "at once, and once"
        with interruptible("after this row"):
            steps.append("does not begin")
    assert steps == ["ends"]


def test_what_is_lost_in_a_clean_up_is_raised_later_and_prints_nothing(number: int, monkeypatch: pytest.MonkeyPatch):
    class Cleans:
        def __init__(self, how: Callable[[], None]):
            self.how = how

        def __del__(self) -> None:
            self.how()

    printed: list[object] = []
    monkeypatch.setattr(ending, "_tell", printed.append)
    Cleans(lambda: signal.raise_signal(number))
    assert not printed
    with pytest.raises(Interrupted):
        leave_if_asked()
    Cleans(lambda: [][0])
    assert len(printed) == 1
    usual = sys.unraisablehook
    monkeypatch.setattr(sys, "unraisablehook", printed.append)  # somebody else's
    with listening():
        assert sys.unraisablehook == usual
    assert sys.unraisablehook == printed.append


@pytest.mark.parametrize("kind", [atomic, atomic_folder])
def test_whatever_is_written_is_whole_or_not_there(kind, number: int, tmp_path: Path):
    with pytest.raises(Interrupted), kind(tmp_path / "new"):
        signal.raise_signal(number)
    assert not list(tmp_path.iterdir())


def test_the_way_out_is_one_line(number: int, capfd: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as end:
        leave(number, "the same command goes on")
    assert end.value.code == 128 + number
    signal.raise_signal(number)  # no longer heard
    name = signal.Signals(number).name
    assert capfd.readouterr().err == f"nerf_lightning: interrupted ({name}); the same command goes on\n"


def test_in_somebody_elses_process_the_signal_does_what_it_did_there():
    with pytest.raises(KeyboardInterrupt), listening():
        signal.raise_signal(signal.SIGINT)
    assert asked() is None and signal.getsignal(signal.SIGINT) is signal.default_int_handler


@pytest.mark.parametrize("module", ["nerf_lightning", "nerf_lightning.render"])
@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
def test_during_imports_it_is_one_line_too(module: str, name: str, tmp_path: Path):
    """Hydra is what command lines import first; here it is one that sends the signal."""
    (tmp_path / "hydra").mkdir()
    send = f"import os, signal, time\nos.kill(os.getpid(), signal.{name})\ntime.sleep(10)\n"
    (tmp_path / "hydra" / "__init__.py").write_text(send)
    environment = {**os.environ, "PYTHONPATH": f"{tmp_path}{os.pathsep}{ROOT}"}
    done = subprocess.run(
        [sys.executable, "-m", module], env=environment, cwd=tmp_path, capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 128 + getattr(signal, name)
    assert (done.stdout, done.stderr) == ("", f"nerf_lightning: interrupted ({name}) before anything began\n")


def test_a_library_that_is_imported_leaves_signals_alone():
    probe = "import signal; before = signal.getsignal(signal.SIGTERM); import nerf_lightning.config.cli;"
    probe += "assert signal.getsignal(signal.SIGTERM) is before"
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    subprocess.run([sys.executable, "-c", probe], env=environment, check=True, timeout=60)


@pytest.mark.parametrize("kind", [InputError, NoRoom])
def test_errors_come_back_from_other_processes(kind: type[InputError]):
    error = kind("a.npz", "K", "nothing", "a matrix", "give one")
    back = pickle.loads(pickle.dumps(error))
    assert type(back) is kind and str(back) == str(error)
