"""A folder belongs to one run."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Barrier

import pytest
from lightning.pytorch.utilities.rank_zero import rank_zero_only

from nerf_lightning.errors import InputError
from nerf_lightning.runs.owner import LOCK, MARKER, Taken, clear, holds_run, own_folder, owned

MANY = 8


@pytest.mark.parametrize("renamed", [True, False])
def test_runs_that_begin_together_get_folders_of_their_own_or_an_error(renamed: bool, tmp_path: Path):
    together = Barrier(MANY)

    def begin(_: int) -> str:
        together.wait()
        try:
            with own_folder(tmp_path / "run", overwrite=False, renamed=renamed) as folder:
                together.wait()
                (folder / "config.yaml").touch(exist_ok=False)
                return folder.name
        except Taken as error:
            together.wait()
            return str(error)

    with ThreadPoolExecutor(MANY) as pool:
        found = list(pool.map(begin, range(MANY)))
    names = [name for name in found if name.startswith("run")]
    assert len(set(names)) == len(names) == (MANY if renamed else 1)
    assert all("a run that is in progress" in line for line in set(found) - set(names))
    with pytest.raises(Taken, match="found a run in it already"), own_folder(tmp_path / "run", overwrite=False):
        pass
    with own_folder(tmp_path / "run", overwrite=True) as folder:
        assert folder == tmp_path / "run"


def test_owned_removes_what_was_made_for_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(KeyError), owned(Path("a/b")):
        raise KeyError
    assert not list(tmp_path.iterdir())
    with owned(Path("kept")):
        Path("kept/file").touch()
    assert sorted(path.name for path in Path("kept").iterdir()) == [LOCK, MARKER, "file"]


def test_owned_refuses_files_of_others(tmp_path: Path):
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="other files in it"), owned(tmp_path):
        pass
    (tmp_path / "config.yaml").touch()
    for overwrite in (False, True):  # a run that somebody moved here, or no run at all
        with pytest.raises((Taken, KeyError)), own_folder(tmp_path, overwrite) as folder:
            clear(folder)
            raise KeyError
    assert (tmp_path / "file").exists() and not holds_run(tmp_path)


def test_processes_that_share_a_run_leave_the_folder_to_the_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(rank_zero_only, "rank", 1)
    with own_folder(tmp_path / "run", overwrite=False) as folder:
        assert folder == tmp_path / "run" and not folder.exists()


@pytest.mark.parametrize("own", [True, False])
def test_clear_removes_all_of_its_own_folder_and_only_runs_elsewhere(own: bool, tmp_path: Path):
    (tmp_path / "notes.txt").touch()
    clear(tmp_path)
    assert (tmp_path / "notes.txt").exists(), "there is no run"
    (tmp_path / "checkpoints").mkdir()
    (tmp_path / "checkpoints" / "last.ckpt").touch()
    (tmp_path / "results.json").touch()
    if own:
        (tmp_path / MARKER).touch()
    clear(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == [MARKER if own else "notes.txt"]
