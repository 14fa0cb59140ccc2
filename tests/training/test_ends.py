"""Runs that end before they are done: asked to, or on a full disk. What is done is kept, and going on ends alike to the bit."""

import json
import re
import resource
import shutil
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from nerf_lightning.callbacks import Checkpoints, HeldOut, Progress
from nerf_lightning.callbacks.checkpoints import InPlace, check_disk
from nerf_lightning.cameras import Bounds
from nerf_lightning.config.compose import composed
from nerf_lightning.errors import NoRoom
from nerf_lightning.model import TensoRFField
from nerf_lightning.runs.folder import load_run
from nerf_lightning.system import System
from nerf_lightning.training.train import train

ROOT = Path(__file__).resolve().parents[2]
SMALL = [
    "+experiment=smoke_2d",
    "dataset.max_side=16",
    "budget.steps=12",
    "model.width=8",
    "callbacks.heldout.at=[0.5]",
]
SMALL += [f"callbacks.{name}=null" for name in ("charts", "training_gif", "baselines")]
STOP = 6
State = tuple[int, dict[str, torch.Tensor]]


def run_of(name: str) -> Path:
    (folder,) = Path("outputs", name).iterdir()
    return folder


def weights(folder: Path) -> State:
    state = torch.load(folder / "checkpoints" / "last.ckpt", weights_only=True)
    return state["global_step"], state["state_dict"]


def status(folder: Path) -> str:
    return json.loads((folder / "results.json").read_text())["status"]


def same(one: State, other: State) -> bool:
    return one[0] == other[0] and all(torch.equal(one[1][key], other[1][key]) for key in one[1])


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory, own_cache: None) -> Path:
    """The folder of a run that nothing befell."""
    folder = tmp_path_factory.mktemp("whole") / "outputs" / "whole" / "run"
    train(composed(SMALL, folder), folder=folder)
    return folder


@pytest.fixture
def whole(undisturbed: Path) -> State:
    """Its weights."""
    return weights(undisturbed)


def at_step(
    monkeypatch: pytest.MonkeyPatch, kind: type, hook: str, action: Callable[[], None], step: int = STOP
) -> None:
    """Does something at the beginning of a callback's hook, after some steps, once."""
    before, done = getattr(kind, hook), []

    def hooked(self: Any, *given: Any) -> Any:
        at = self if isinstance(self, System) else given[0]  # or a callback, which is given its trainer
        if at.global_step == step and not done:
            done.append(True)
            action()
        return before(self, *given)

    monkeypatch.setattr(kind, hook, hooked)


MOMENTS = {
    "in a step": (Progress, "on_train_batch_end", STOP, "stopping after this step"),
    "while measuring": (HeldOut, "measure", STOP, "stopping after this step"),
    "while a view is rendered": (System, "evaluate_held_out", STOP, "stopping after this row"),
    "in the test": (Checkpoints, "on_test_batch_end", 12, "stopping after this row"),
}


@pytest.mark.parametrize(("moment", "number"), [*((m, signal.SIGTERM) for m in MOMENTS), ("in a step", signal.SIGINT)])
def test_asked_to_end_a_run_saves_what_it_has_and_goes_on(
    moment: str, number: int, undisturbed: Path, whole: State, inside, monkeypatch
):
    kind, hook, step, answer = MOMENTS[moment]
    with monkeypatch.context() as patch:
        at_step(patch, kind, hook, lambda: signal.raise_signal(number), step)
        code, _, err = inside(*SMALL, "name=broken")
    assert code == 128 + number, err
    name = signal.Signals(number).name
    line = f"nerf_lightning: interrupted ({name}); go on with: python -m nerf_lightning resume=outputs/broken/"
    assert err.startswith(f"nerf_lightning: {name}: {answer}\n{line}") and err.count("\n") == 2, err
    assert status(run_of("broken")) == "interrupted" and weights(run_of("broken"))[0] == step
    assert not list(Path().rglob(".*"))
    resume = err.split()[-1]
    code, _, err = inside(resume)
    assert code == 0, err
    assert status(run_of("broken")) == status(undisturbed) and same(weights(run_of("broken")), whole)


def test_asked_again_while_it_saves_the_checkpoint_is_whole(whole, inside, monkeypatch):
    save = InPlace.save_checkpoint

    def impatient(self: InPlace, *given: Any, **more: Any) -> None:
        signal.raise_signal(signal.SIGINT)
        save(self, *given, **more)
        signal.raise_signal(signal.SIGINT)

    with monkeypatch.context() as patch:
        at_step(patch, Progress, "on_train_batch_end", lambda: signal.raise_signal(signal.SIGINT))
        patch.setattr(InPlace, "save_checkpoint", impatient)
        code, _, err = inside(*SMALL, "name=broken")
    assert code == 130 and err.count("\n") == 2
    assert weights(run_of("broken"))[0] == STOP and not list(Path().rglob(".*"))


def test_asked_to_end_before_training_it_leaves_nothing(inside, monkeypatch):
    monkeypatch.setattr("nerf_lightning.training.train.build_data", lambda cfg: signal.raise_signal(signal.SIGINT))
    code, out, err = inside(*SMALL)
    assert (code, err) == (130, "nerf_lightning: interrupted (SIGINT); the same command goes on\n")
    assert not list(Path().iterdir())


@pytest.fixture
def limit() -> Iterator[Callable[[int], None]]:
    """Files of this process may have so many bytes; written beyond them, they fail as on a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    yield lambda size: resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_without_room_in_memory_a_line_says_so(inside, tmp_path: Path, monkeypatch):
    def fail() -> None:
        raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 GiB. GPU 0 has a total capacity of")

    with monkeypatch.context() as patch:
        at_step(patch, Progress, "on_train_batch_start", fail, step=0)
        code, _, err = inside(*SMALL)
    assert (
        code == 2 and err.startswith("nerf_lightning: memory: found no room for 20.00 GiB, ") and err.count("\n") == 1
    )
    assert not list(tmp_path.rglob("*")), "nothing was trained"
    with monkeypatch.context() as patch:
        at_step(patch, Progress, "on_train_batch_start", fail)
        assert inside(*SMALL)[0] == 2
    assert status(run_of("smoke_2d")) == "failed"


@pytest.mark.parametrize("room", [0, 1500, 5000])
def test_on_a_full_disk_nothing_is_lost(room: int, undisturbed: Path, whole: State, inside, limit, monkeypatch):
    """From where nothing fits, through results, pictures and curves, to where checkpoints alone do not."""
    every = "callbacks.checkpoints.every_seconds=1e-9"
    with monkeypatch.context() as patch:
        at_step(patch, Progress, "on_train_batch_end", lambda: limit(room))
        # Who reads what the process has said needs files too.
        patch.setattr("nerf_lightning.config.cli.give_up", gives_room(limit))
        code, _, err = inside(*SMALL, every, "name=broken")
    assert code == 2 and err.count("\n") == 1 and "no space left on the device" in err, err
    assert weights(run_of("broken"))[0] == STOP - 1 and not list(Path().rglob(".*"))
    results = run_of("broken") / "results.json"
    assert not results.exists() or status(run_of("broken")) == "failed"
    code, _, err = inside(f"resume={run_of('broken')}")
    assert code == 0, err
    assert status(run_of("broken")) == status(undisturbed) and same(weights(run_of("broken")), whole)


def gives_room(limit: Callable[[int], None]) -> Callable[[Exception], None]:
    from nerf_lightning.config import cli

    end = cli.give_up

    def give_up(error: Exception) -> None:
        limit(resource.RLIM_INFINITY)
        end(error)

    return give_up


def test_a_run_asks_beforehand_whether_its_checkpoints_fit(undisturbed: Path, inside, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(free=1000))
        code, _, err = inside(*SMALL)
    assert code == 2 and err.count("\n") == 1
    assert re.search(r"0\.0 MB free, expected [\d.]+ MB for checkpoints", err), err
    assert not list(Path().iterdir()), "before anything is written"
    system, folder = load_run(undisturbed).system, undisturbed / "checkpoints"
    size = (folder / "last.ckpt").stat().st_size
    one = 4 * 3 * sum(p.numel() for p in system.parameters())
    assert one <= size < one + 60_000, "the rest does not grow with the model"
    monkeypatch.setattr(shutil, "disk_usage", lambda path: SimpleNamespace(free=one))
    check_disk(folder, system)  # two are there already, and are replaced
    with pytest.raises(NoRoom):
        check_disk(undisturbed / "elsewhere", system)


def test_a_field_that_grows_asks_for_its_last_size():
    box = Bounds(torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]]))
    field = TensoRFField(box, coarsest=4, finest=12, stages=3, size="fixed")
    expected, first = field.values_grown(), field.values
    field.grow(1.0)
    assert expected == field.values > 3 * first


def test_a_clock_that_jumps_decides_nothing(whole, inside, monkeypatch):
    now, jumps = time.time(), iter([1e9, -1e9] * 100_000)
    monkeypatch.setattr(time, "time", lambda: now + next(jumps))
    code, _, err = inside(*SMALL, "name=jumps")
    assert code == 0, err
    assert same(weights(run_of("jumps")), whole)
    used = [path for path in (ROOT / "nerf_lightning").rglob("*.py") if "time.time(" in path.read_text()]
    assert not used, "budgets, timers and progress go by clocks that only go forward"
