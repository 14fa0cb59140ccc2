"""A folder belongs to one run."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from threading import Barrier

import pytest
from lightning.pytorch.utilities.rank_zero import rank_zero_only

from nerf_lightning.errors import InputError
from nerf_lightning.export.verb import NAMES
from nerf_lightning.runs.owner import LOCK, MADE, Taken, clear, holds_run, own_folder, owned

MANY = 20


@pytest.mark.parametrize("renamed", [True, False])
def test_twenty_at_once(renamed: bool, tmp_path: Path):
    """In folders of their own, or one alone, also once it has ended."""
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
    assert all("found a run that is still going on" in line for line in set(found) - set(names))
    assert not list(tmp_path.rglob(LOCK))
    with pytest.raises(Taken, match="found a run in it already"), own_folder(tmp_path / "run", overwrite=False):
        pass
    with own_folder(tmp_path / "run", overwrite=True) as folder:
        assert folder == tmp_path / "run"
    with own_folder(tmp_path / "run", overwrite=True, renamed=True) as folder:
        assert folder.name == ("run-21" if renamed else "run-2"), "nobody asked for that very name"


def test_what_was_made_for_nothing_is_removed(tmp_path: Path):
    with pytest.raises(KeyError), owned(tmp_path / "a"):
        raise KeyError
    (tmp_path / "b").mkdir()
    with owned(tmp_path / "b"):
        pass
    assert [path.name for path in tmp_path.iterdir()] == ["b"]


def test_a_folder_that_cannot_be_written_is_told(tmp_path: Path):
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match="expected a folder that can be written"), owned(tmp_path / "file" / "run"):
        pass


def test_processes_that_share_a_run_leave_the_folder_to_the_first(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(rank_zero_only, "rank", 1)
    with own_folder(tmp_path / "run", overwrite=False) as folder:
        assert folder == tmp_path / "run" and not folder.exists()


def test_a_finished_runs_files_are_all_removed_and_others_stay(small_run: Path, tmp_path: Path):
    assert all(any(path.match(name) for name in MADE) for path in small_run.iterdir())
    assert set(NAMES.values()) <= set(MADE)
    (tmp_path / "checkpoints").mkdir()
    (tmp_path / "checkpoints" / "last.ckpt").touch()
    for name in ("notes.txt", "events.out.tfevents.1.machine.2.0"):
        (tmp_path / name).touch()
    assert holds_run(tmp_path)
    clear(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]
    (tmp_path / "snapshots").mkdir()
    clear(tmp_path)
    assert (tmp_path / "snapshots").is_dir(), "of something else: no run is there"
