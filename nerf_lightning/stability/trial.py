"""Trials of the suite: one training per condition, method and seed."""

from collections import deque
from collections.abc import Generator, Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import asdict, dataclass
from itertools import islice
from pathlib import Path
from typing import Any

from nerf_lightning.config.resolvers import slugify
from nerf_lightning.errors import DiskFullError, InputError
from nerf_lightning.stability.conditions import CONDITIONS, METHODS, UPSCALE_FACTOR
from nerf_lightning.utils.files import is_disk_full, write_json
from nerf_lightning.utils.parsing import read_json


@dataclass(frozen=True)
class TrialResult:
    """Result of a trial, as in stability.json."""

    condition: str
    method: str
    seed: int
    psnr: float | None
    """Held-out PSNR, dB; for images at `UPSCALE_FACTOR` times the training pixels per side."""
    status: str
    """finished, collapsed, refused (before training) or failed."""
    diagnosis: str
    recoveries: int
    alarm: str
    """Warnings of the run about the data or the result."""


@dataclass(frozen=True)
class Trial:
    """A training of the suite."""

    condition: str
    method: str
    seed: int
    steps: int


def list_trials(conditions: Sequence[str], methods: Sequence[str], seeds: int, steps: int) -> list[Trial]:
    """Trials of a suite: one seed of unsolvable conditions, and no control method under a control condition."""
    return [
        Trial(condition.name, name, seed, steps)
        for condition in CONDITIONS.values()
        if condition.name in conditions
        for name in methods
        if METHODS[name].is_2d == condition.is_2d and METHODS[name].get_options_for(condition) is not None
        if not (METHODS[name].control and condition.control)
        for seed in range(1 if condition.is_unsolvable else seeds)
    ]


def run_trials(trials: Sequence[Trial], root: Path, workers: int) -> Generator[TrialResult, None, None]:
    """Runs trials in single-threaded worker processes; yields their results in order.

    Raises:
        InputError: the system killed a worker.
    """
    from joblib.externals.loky import ProcessPoolExecutor
    from joblib.externals.loky.process_executor import TerminatedWorkerError

    # If this process is killed, idle workers end after a minute.
    pool = ProcessPoolExecutor(workers, timeout=60, env={"OMP_NUM_THREADS": "1"})
    try:
        # Submits a few at a time instead of pool.map: loky's shutdown fails with queued or canceled trials (joblib 1.6).
        rest = iter(trials)
        running = deque(pool.submit(run_trial, trial, root) for trial in islice(rest, 2 * workers))
        while running:
            yield running.popleft().result()
            running.extend(pool.submit(run_trial, trial, root) for trial in islice(rest, 1))
    except TerminatedWorkerError as error:
        problem = f"the system ended one of {workers} processes, as when memory is short"
        raise InputError("stability", "workers", problem, hint="give fewer; the same command continues") from error
    finally:
        pool.shutdown(kill_workers=True)


def get_trial_folder(root: Path, condition: str, method: str, seed: int) -> Path:
    return root / "trials" / slugify(condition) / f"{slugify(method)}_seed{seed}"


def run_trial(trial: Trial, root: Path) -> TrialResult:
    """Trains a trial, unless the folder holds its result for the same options."""
    condition, method = CONDITIONS[trial.condition], METHODS[trial.method]
    folder = get_trial_folder(root, trial.condition, trial.method, trial.seed)
    identity = {"steps": trial.steps, "options": method.get_options_for(condition), "condition": asdict(condition)}
    try:
        content = read_json(folder / "trial.json", "a trial's outcome")
        if content["identity"] == identity:
            return TrialResult(**content["outcome"])
    except (InputError, KeyError, TypeError):
        pass  # missing or damaged: train again
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "log.txt").open("w", encoding="utf-8") as log, redirect_stdout(log), redirect_stderr(log):
        outcome = train_trial(trial, folder)
    result = TrialResult(trial.condition, trial.method, trial.seed, **outcome)
    write_json(folder / "trial.json", {"identity": identity, "outcome": asdict(result)})
    return result


def train_trial(trial: Trial, folder: Path) -> dict[str, Any]:
    """Trains and measures; returns the fields of `TrialResult` that depend on it.

    Raises:
        OSError, DiskFullError: the disk is full, which says nothing about the method.
    """
    from nerf_lightning.config.compose import compose_config
    from nerf_lightning.config.quoting import make_override
    from nerf_lightning.dataset import save_npz
    from nerf_lightning.drawing.panels import write_png
    from nerf_lightning.training.train import train

    condition, method = CONDITIONS[trial.condition], METHODS[trial.method]
    scene: Any = condition.make(trial.seed)
    if condition.is_2d:
        path = folder / "image.png"
        write_png(path, scene.image.numpy())
        max_side = max(scene.size) // UPSCALE_FACTOR
        overrides = ["callbacks.pictures=null", f"dataset.max_side={max_side}", f"render.scale={UPSCALE_FACTOR}"]
    else:
        path = folder / "scene.npz"
        save_npz(scene, path)
        overrides = ["dataset=photos", "callbacks.orbit=null"]
    overrides += [*(method.get_options_for(condition) or []), make_override("dataset.path", path)]
    overrides += [f"seed={trial.seed}", f"budget.steps={trial.steps}"]
    overrides += ["threads=1", "device=cpu"]  # trials are small and run in parallel
    overrides += ["~logger", "callbacks.snapshots.steps=[]", "callbacks.validation=null", "callbacks.checkpoints=null"]
    outcome: dict[str, Any] = {"psnr": None, "status": "failed", "diagnosis": "", "recoveries": 0, "alarm": ""}
    try:
        cfg = compose_config(overrides, folder)
        cfg.optimizer.lr *= condition.lr_scale
        train(cfg)
        results = read_json(folder / "results.json", "figures")
        outcome |= {key: results[key] for key in ("psnr", "status", "diagnosis")}
        if method.is_2d:
            upscaled_psnr = read_json(folder / "enlarged.json", "figures")["field"]
            outcome["psnr"] = outcome["psnr"] if upscaled_psnr is None else upscaled_psnr  # None if all bytes are exact
        outcome["recoveries"] = len(results["recoveries"])
        alarms = [*results["warnings"], outcome["diagnosis"] if outcome["status"] == "finished" else ""]
        outcome["alarm"] = "; ".join(filter(None, alarms))
    except DiskFullError:
        raise
    except InputError as error:
        outcome |= {"status": "refused", "diagnosis": str(error).replace(str(path), condition.name)}
    except Exception as error:  # noqa: BLE001  (failures are results of the suite)
        if is_disk_full(error):
            raise
        outcome["diagnosis"] = " ".join(f"{type(error).__name__}: {error}".split())
    path.unlink(missing_ok=True)
    return outcome
