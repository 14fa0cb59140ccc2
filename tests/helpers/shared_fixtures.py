"""What takes long to make and is only looked at: made once for all processes that share a test run."""

import os
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import pytest
from filelock import FileLock

T = TypeVar("T")


def shared_folder(factory: pytest.TempPathFactory) -> Path:
    """One for all processes of a test run."""
    folder = factory.getbasetemp()
    return folder.parent if "PYTEST_XDIST_WORKER" in os.environ else folder  # each has a folder of its own in there


def make_once(factory: pytest.TempPathFactory, name: str, make: Callable[[Path], T]) -> T:
    """What `make` returned for a new folder, in this process or another one."""
    shared = shared_folder(factory)
    found = shared / f"{name}.pickle"
    with FileLock(shared / f"{name}.lock"):
        if not found.exists():
            (shared / name).mkdir()
            found.write_bytes(pickle.dumps(make(shared / name)))
    return pickle.loads(found.read_bytes())
