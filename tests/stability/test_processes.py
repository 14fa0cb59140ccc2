"""The suite's processes end with the one that started them, however that ends."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from threading import Thread

import psutil
import pytest
from commands import ROOT

from nerf_lightning.errors import InputError
from nerf_lightning.stability.cell import Cell
from nerf_lightning.stability.suite import run_all
from nerf_lightning.utils.signals import Interrupted, handle_signals

LONG = 60.0
"""Seconds after which something will not come."""


class Deaf(Cell):
    """Stands for a cell: takes without end, and does not hear that it is asked to end."""

    def folder(self, root: Path) -> Path:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        (root / "begun").write_text(str(os.getpid()))
        time.sleep(10 * LONG)
        return root


DEAF = Deaf("clean", "hashgrid", 0, 1)


class Killed(Cell):
    """Stands for a cell that needs more memory than there is."""

    def folder(self, root: Path) -> Path:
        raise BrokenProcessPool


def begun(root: Path) -> int:
    """The process that has begun a cell."""
    wait_for(lambda: (root / "begun").exists() and (root / "begun").read_text() != "")
    return int((root / "begun").read_text())


def wait_for(what: Callable[[], bool]) -> None:
    end = time.monotonic() + LONG
    while not what():
        assert time.monotonic() < end
        time.sleep(0.05)


def test_asked_to_end_it_ends_also_those_that_do_not_hear(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("nerf_lightning.stability.suite.GRACE", 0.2)
    main = os.getpid()
    Thread(target=lambda: (begun(tmp_path), os.kill(main, signal.SIGTERM)), daemon=True).start()
    with pytest.raises(Interrupted), handle_signals():
        list(run_all([DEAF], tmp_path, 1))
    child = begun(tmp_path)
    wait_for(lambda: not psutil.pid_exists(child))


def test_one_that_the_system_ends_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    threads = "nerf_lightning.stability.suite.ProcessPoolExecutor", lambda count, *_: ThreadPoolExecutor(count)
    monkeypatch.setattr(*threads)  # they begin at once
    with pytest.raises(InputError, match="workers: found a process that the system ended, expected memory for 1 of"):
        list(run_all([Killed("clean", "hashgrid", 0, 1)], tmp_path, 1))


PARENT = """
import multiprocessing, sys
from pathlib import Path

def work(root):
    from nerf_lightning.stability.suite import _prepare
    _prepare()
    from test_processes import DEAF
    DEAF.folder(Path(root))

if __name__ == "__main__":
    multiprocessing.get_context("spawn").Process(target=work, args=sys.argv[1:]).start()
"""


def test_killed_it_leaves_no_process_behind(tmp_path: Path):
    (tmp_path / "parent.py").write_text(PARENT)
    paths = os.pathsep.join([str(ROOT), str(ROOT / "tests"), str(Path(__file__).parent)])
    environment = {**os.environ, "PYTHONPATH": paths}
    parent = subprocess.Popen([sys.executable, tmp_path / "parent.py", tmp_path], env=environment)
    child = begun(tmp_path)
    parent.kill()
    parent.wait()
    wait_for(lambda: not psutil.pid_exists(child))
