"""One process at a time, and none after its death."""

import subprocess
import sys
from pathlib import Path

import pytest

from nerf_lightning.utils import lock
from nerf_lightning.utils.lock import Held, locked

HOLDS = """
import sys
from pathlib import Path
from nerf_lightning.utils.lock import locked
with locked(Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.read()
"""


def test_one_holds_it_and_leaves_nothing(tmp_path: Path):
    path = tmp_path / "new" / ".lock"
    for _ in range(2):
        with locked(path):
            with pytest.raises(Held, match=r"process \d+ on "), locked(path):
                pass
            assert path.exists()
        assert not path.exists()


def test_a_killed_process_holds_nothing(tmp_path: Path):
    path = tmp_path / ".lock"
    root = Path(__file__).resolve().parents[2]
    process = subprocess.Popen(
        [sys.executable, "-c", HOLDS, str(path)], cwd=root, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None and process.stdout.readline() == "held\n"
    with pytest.raises(Held, match=f"process {process.pid} on "), locked(path):
        pass
    process.kill()
    process.communicate()
    assert path.exists(), "nobody removed it"
    with locked(path):
        assert path.read_text() != ""
    assert not path.exists()


def test_a_lock_that_was_removed_meanwhile_is_no_lock(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Between opening the file and locking it, its owner ended and another began."""
    path, real, beside = tmp_path / ".lock", lock._lock, []

    def late(handle: int) -> None:
        if not beside:
            path.unlink()
            beside.append(path.open("w"))
        real(handle)

    monkeypatch.setattr(lock, "_lock", late)
    with locked(path), pytest.raises(Held), locked(path):
        pass
    beside[0].close()


def test_a_file_system_without_locks_warns(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog):
    def none(handle: int) -> None:
        raise OSError(38, "Function not implemented")

    monkeypatch.setattr(lock, "_lock", none)
    with locked(tmp_path / ".lock"):
        assert "cannot be locked (Function not implemented)" in caplog.text
