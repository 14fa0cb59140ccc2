"""Interrupted runs, by a signal or a full disk: progress is kept, and resuming gives the same weights."""

import json
import resource
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

from nerf_lightning.callbacks import Evaluation, PeriodicValidation, ProgressBar
from nerf_lightning.cameras import Bounds
from nerf_lightning.cli.app import exit_with_error
from nerf_lightning.config.compose import compose_config
from nerf_lightning.model import TensoRFField
from nerf_lightning.runs.run_lock import LOCK_FILE, RUN_MARKER
from nerf_lightning.system import System
from nerf_lightning.training.train import train
from tests.helpers.growth import grow

SMALL = ["+experiment=smoke_2d", "dataset.max_side=16", "budget.steps=12", "model.width=8"]
SMALL += ["callbacks.validation.fractions=[0.5]", "callbacks.pictures=null"]
STOP = 6
State = tuple[int, dict[str, torch.Tensor]]


def run_of(name: str) -> Path:
    return Path("outputs", name, "latest").resolve()


def read_state(folder: Path) -> State:
    state = torch.load(folder / "checkpoints" / "last.ckpt", weights_only=True)
    return state["global_step"], state["state_dict"]


def read_status(folder: Path) -> str:
    return json.loads((folder / "results.json").read_text())["status"]


def assert_same(one: State, other: State) -> None:
    assert one[0] == other[0] and all(torch.equal(one[1][key], other[1][key]) for key in one[1])


def temporary_files() -> list[Path]:
    return [path for path in Path().rglob(".*") if path.name not in (LOCK_FILE, RUN_MARKER)]


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory, isolated_cache: None) -> Path:
    """The folder of an uninterrupted run."""
    folder = tmp_path_factory.mktemp("whole") / "run"
    train(compose_config(SMALL, folder), folder=folder)
    return folder


def at_step(monkeypatch, kind: type, hook: str, action: Callable[[], None], step=STOP) -> None:
    """Runs an action once, at the start of a callback's hook after some steps."""
    before, done = getattr(kind, hook), []

    def hooked(self: Any, *given: Any) -> Any:
        at = self if isinstance(self, System) else given[0]  # or a callback, which is given its trainer
        if at.global_step == step and not done:
            done.append(True)
            action()
        return before(self, *given)

    monkeypatch.setattr(kind, hook, hooked)


MOMENTS = {
    "in a step": (ProgressBar, "on_train_batch_end", STOP),
    "before a measurement": (PeriodicValidation, "measure", STOP),
    "while a view is rendered": (System, "evaluate_held_out", STOP),
    "in the test": (Evaluation, "on_test_batch_end", 12),
}


@pytest.mark.parametrize(("moment", "signum"), [*((m, signal.SIGTERM) for m in MOMENTS), ("in a step", signal.SIGINT)])
def test_resume_interrupted_run_gives_same_weights(
    moment: str, signum: int, undisturbed: Path, run_cli, monkeypatch: pytest.MonkeyPatch
):
    kind, hook, step = MOMENTS[moment]
    with monkeypatch.context() as patch:
        at_step(patch, kind, hook, lambda: signal.raise_signal(signum), step)
        code, _, err = run_cli(*SMALL, "name=broken")
    assert code == 128 + signum, err
    line = err.splitlines()[-1]
    assert signal.Signals(signum).name in line and " resume=outputs/broken/" in line, err
    assert read_status(run_of("broken")) == "interrupted" and read_state(run_of("broken"))[0] == step
    assert not temporary_files()
    code, _, err = run_cli(line.split()[-1])
    assert code == 0, err
    assert read_status(run_of("broken")) == read_status(undisturbed)
    assert_same(read_state(run_of("broken")), read_state(undisturbed))


def test_train_signal_before_training_writes_nothing(run_cli, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("nerf_lightning.training.resume.build_data", lambda cfg: signal.raise_signal(signal.SIGINT))
    code, _, err = run_cli(*SMALL)
    assert code == 130 and "the same command continues" in err and err.count("\n") == 1
    assert not list(Path().iterdir())


@pytest.fixture
def limit() -> Iterator[Callable[[int], None]]:
    """Limits file sizes, so that writing fails as on a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    yield lambda size: resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_train_out_of_memory_raises_and_writes_nothing(run_cli, tmp_path: Path, monkeypatch):
    def exit_with_error() -> None:
        raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 GiB. GPU 0 has a total capacity of")

    with monkeypatch.context() as patch:
        at_step(patch, ProgressBar, "on_train_batch_start", exit_with_error, step=0)
        code, _, err = run_cli(*SMALL)
    assert code == 2 and "20.00 GiB" in err and err.count("\n") == 1
    assert not [path for path in tmp_path.rglob("*") if not path.is_dir() and not path.is_symlink()]
    with monkeypatch.context() as patch:
        at_step(patch, ProgressBar, "on_train_batch_start", exit_with_error)
        assert run_cli(*SMALL)[0] == 2
    assert read_status(run_of("smoke_2d")) == "failed"


@pytest.mark.parametrize("room", [0, 5000])
def test_train_full_disk_keeps_last_checkpoint(room: int, undisturbed: Path, run_cli, limit, monkeypatch):
    """Either no file fits, or only checkpoints do not."""
    with monkeypatch.context() as patch:
        at_step(patch, ProgressBar, "on_train_batch_end", lambda: limit(room))
        # pytest's capture needs files too.
        patch.setattr("nerf_lightning.cli.app.exit_with_error", lift_limit(limit))
        code, _, err = run_cli(*SMALL, "logger=null", "callbacks.checkpoints.every_seconds=1e-9", "name=broken")
    assert code == 2 and err.count("\n") == 1 and "no space left on the device" in err, err
    assert read_state(run_of("broken"))[0] == STOP - 1 and not temporary_files()
    results = run_of("broken") / "results.json"
    assert not results.exists() or read_status(run_of("broken")) == "failed"
    code, _, err = run_cli(f"resume={run_of('broken')}")
    assert code == 0, err
    assert_same(read_state(run_of("broken")), read_state(undisturbed))


def lift_limit(limit: Callable[[int], None]) -> Callable[[Exception], None]:
    def lift_and_fail(error: Exception) -> None:
        limit(resource.RLIM_INFINITY)
        exit_with_error(error)

    return lift_and_fail


def test_train_growing_field_checks_memory_of_final_size():
    box = Bounds(torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]]))
    field = TensoRFField(box, base_resolution=4, max_resolution=12, stages=3, size="fixed")
    expected, first = field.max_num_parameters(), sum(p.numel() for p in field.parameters())
    grow(field, 1.0)
    assert expected == sum(p.numel() for p in field.parameters()) > 3 * first
