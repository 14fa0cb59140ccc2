"""A folder belongs to one run."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Barrier

import pytest
from lightning.pytorch.utilities.rank_zero import rank_zero_only

from nerf_lightning.errors import InputError
from nerf_lightning.runs.run_lock import (
    LOCK_FILE,
    RUN_MARKER,
    RunFolderInUse,
    delete_run_outputs,
    has_run_outputs,
    lock_folder,
    lock_new_run_folder,
)

MANY = 8


@pytest.mark.parametrize("allow_suffix", [True, False])
def test_lock_new_run_folder_concurrent_runs_get_separate_folders(allow_suffix: bool, tmp_path: Path):
    together = Barrier(MANY)

    def begin(_: int) -> str:
        together.wait()
        try:
            with lock_new_run_folder(tmp_path / "run", overwrite=False, allow_suffix=allow_suffix) as folder:
                together.wait()
                (folder / "config.yaml").touch(exist_ok=False)
                return folder.name
        except RunFolderInUse as error:
            together.wait()
            return str(error)

    with ThreadPoolExecutor(MANY) as pool:
        found = list(pool.map(begin, range(MANY)))
    names = [name for name in found if name.startswith("run")]
    assert len(set(names)) == len(names) == (MANY if allow_suffix else 1)
    assert all("a run is in progress" in line for line in set(found) - set(names))
    with (
        pytest.raises(RunFolderInUse, match="holds a run already"),
        lock_new_run_folder(tmp_path / "run", overwrite=False),
    ):
        pass
    with lock_new_run_folder(tmp_path / "run", overwrite=True) as folder:
        assert folder == tmp_path / "run"


def test_lock_folder_removes_empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(KeyError), lock_folder(Path("a/b")):
        raise KeyError
    assert not list(tmp_path.iterdir())
    with lock_folder(Path("kept")):
        Path("kept/file").touch()
    assert sorted(path.name for path in Path("kept").iterdir()) == [LOCK_FILE, RUN_MARKER, "file"]


def test_lock_folder_foreign_files_raise(tmp_path: Path):
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="holds other files"), lock_folder(tmp_path):
        pass
    (tmp_path / "config.yaml").touch()
    for overwrite in (False, True):  # a run that somebody moved here, or no run at all
        with pytest.raises((RunFolderInUse, KeyError)), lock_new_run_folder(tmp_path, overwrite) as folder:
            delete_run_outputs(folder)
            raise KeyError
    assert (tmp_path / "file").exists() and not has_run_outputs(tmp_path)


def test_lock_folder_other_ranks_do_not_write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(rank_zero_only, "rank", 1)
    with lock_new_run_folder(tmp_path / "run", overwrite=False) as folder:
        assert folder == tmp_path / "run" and not folder.exists()


@pytest.mark.parametrize("own", [True, False])
def test_delete_run_outputs_keeps_foreign_files(own: bool, tmp_path: Path):
    (tmp_path / "notes.txt").touch()
    delete_run_outputs(tmp_path)
    assert (tmp_path / "notes.txt").exists(), "there is no run"
    (tmp_path / "checkpoints").mkdir()
    (tmp_path / "checkpoints" / "last.ckpt").touch()
    (tmp_path / "results.json").touch()
    if own:
        (tmp_path / RUN_MARKER).touch()
    delete_run_outputs(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == [RUN_MARKER if own else "notes.txt"]
