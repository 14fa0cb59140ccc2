"""One cell of the suite: a condition, a method and a seed, trained as a user would."""

import json
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from nerf_lightning.config.resolvers import slug
from nerf_lightning.errors import InputError, NoRoom
from nerf_lightning.stability.conditions import CONDITIONS, LARGER, Condition
from nerf_lightning.stability.methods import METHODS, Method
from nerf_lightning.utils.files import full_disk, write_json
from nerf_lightning.utils.parsing import read_json

OUTCOME = "cell.json"


@dataclass(frozen=True)
class Outcome:
    """The result of a cell, as in stability.json."""

    condition: str
    method: str
    seed: int
    guard: bool
    psnr: float | None
    """dB on held-out views; for a picture, on one with `LARGER` times the pixels it was trained on along each side."""
    status: str
    """finished, collapsed, refused (before training) or failed."""
    diagnosis: str
    recoveries: int
    alarm: str
    """What the run warned of, about the data or the result."""


@dataclass(frozen=True)
class Cell:
    """What to train."""

    condition: str
    method: str
    seed: int
    steps: int

    @property
    def parts(self) -> tuple[Condition, Method]:
        condition = next(one for one in CONDITIONS if one.name == self.condition)
        return condition, METHODS[self.method]

    @property
    def options(self) -> list[str] | None:
        """Overrides; None if the condition does not apply to the method."""
        condition, method = self.parts
        own = condition.options_for(method.kind)
        return None if own is None else [*method.options, *own]

    def folder(self, root: Path) -> Path:
        return folder_of(root, self.condition, self.method, self.seed)


def folder_of(root: Path, condition: str, method: str, seed: int) -> Path:
    """Where a cell's run is left."""
    return root / "cells" / slug(condition) / f"{slug(method)}_seed{seed}"


def run(cell: Cell, root: Path) -> Outcome:
    """Trains a cell, unless a result with the same options is there."""
    folder = cell.folder(root)
    before = _read(folder, cell)
    if before is not None:
        return before
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "log.txt").open("w", encoding="utf-8") as log, redirect_stdout(log), redirect_stderr(log):
        outcome = _train(cell, folder)
    write_json(folder / OUTCOME, {**_identity(cell), "outcome": asdict(outcome)})
    return outcome


def _identity(cell: Cell) -> dict[str, Any]:
    """What must be the same for an earlier result to count."""
    return {"cell": asdict(cell), "options": cell.options, "rate": cell.parts[0].rate}


def _read(folder: Path, cell: Cell) -> Outcome | None:
    try:
        content = read_json(folder / OUTCOME, "a cell's outcome")
        if {key: content[key] for key in _identity(cell)} == _identity(cell):
            return Outcome(**content["outcome"])
    except (InputError, KeyError, TypeError):
        pass  # missing or cut short: trained again
    return None


def _train(cell: Cell, folder: Path) -> Outcome:
    from nerf_lightning.config.compose import composed
    from nerf_lightning.dataset import Scene, save_npz
    from nerf_lightning.drawing.panels import write_png
    from nerf_lightning.training.train import train

    condition, method = cell.parts
    made = condition.scene(cell.seed)
    if isinstance(made, Scene):
        path = folder / "scene.npz"
        save_npz(made, path)
        given = ["dataset=photos", "callbacks.orbit=null"]
    else:
        path = folder / "picture.png"
        write_png(path, made.image.numpy())
        given = [
            *("callbacks.training_gif=null", "callbacks.charts=null", "callbacks.baselines=null"),
            f"dataset.max_side={max(made.size) // LARGER}",
            f"render.scale={LARGER}",
        ]
    given += [
        *(cell.options or []),
        f"dataset.path='{path}'",
        f"seed={cell.seed}",
        "threads=1",
        "device=cpu",  # cells are small, and run side by side
        f"budget.steps={cell.steps}",
        *("~logger", "callbacks.snapshots.steps=[]", "callbacks.heldout=null", "callbacks.checkpoints=null"),
    ]
    psnr, status, diagnosis, recoveries, alarm = None, "failed", "", 0, ""
    try:
        cfg = composed(given, folder)
        cfg.optimizer.lr *= condition.rate
        train(cfg)
        results = json.loads((folder / "results.json").read_text(encoding="utf-8"))
        psnr, status, diagnosis = results["psnr"], results["status"], results["diagnosis"]
        if method.flat:
            between = json.loads((folder / "enlarged.json").read_text(encoding="utf-8"))["field"]
            psnr = psnr if between is None else between  # None where every byte is right
        recoveries = len(results["recoveries"])
        alarm = "; ".join([*results["warnings"], *([diagnosis] if status == "finished" and diagnosis else [])])
    except NoRoom:
        raise  # says nothing about the method
    except InputError as error:
        status, diagnosis = "refused", str(error).replace(str(path), condition.name)
    except Exception as error:  # noqa: BLE001  (failures are what the suite looks for)
        if full_disk(error):
            raise
        diagnosis = " ".join(f"{type(error).__name__}: {error}".split())
    path.unlink(missing_ok=True)
    return Outcome(cell.condition, cell.method, cell.seed, method.guard, psnr, status, diagnosis, recoveries, alarm)
