"""Whether methods learn on a device as well as on the CPU with plain torch: short trainings from the same seed."""

import io
import math
from contextlib import redirect_stdout
from pathlib import Path
from statistics import fmean
from typing import Any

import torch

from benchmarks.alike import FAILURES, Rows, told
from benchmarks.cases import versions
from benchmarks.setup import METHODS, on_device
from nerf_lightning.config.compose import composed
from nerf_lightning.training.train import train
from nerf_lightning.utils.device import CPU

PICTURE_FIELDS = ("hashgrid2d", "picture_mlp", "fourier", "siren")
STEPS = 400
SCENE = ("dataset=bricks", "dataset.size=64", "dataset.train_views=40", "dataset.val_views=4")
SMALL = ("dataset.samples=8192", "sampler.samples=96")
"""Steps that plain torch takes in some hundredths of a second on a CPU."""
PICTURE = ("+experiment=picture", "dataset.max_side=128", "dataset.pixels=2048")
FILES = ("snapshots", "orbit", "checkpoints", "progress", "heldout")
PICTURE_FILES = ("training_gif", "charts", "baselines", "enlarge")
"""Callbacks that write what nobody looks at here."""
BELOW = 0.3
"""dB that the mean over seeds may be below the CPU's."""
SEEDS = 4
"""At most: runs of one seed are some 0.3 dB apart wherever chance or rounding differ, so that a first one below is no proof."""


def everything() -> dict[str, list[str]]:
    """Overrides of each method's short training."""
    without, pictures = ([f"callbacks.{name}=null" for name in names] for names in (FILES, PICTURE_FILES))
    # As many rays a step on every device: with more it would learn more.
    common = [f"budget.steps={STEPS}", "limits.batch=1", "~logger", *without]
    return {
        **{name: [*SCENE, *SMALL, f"recipe={name}_medium", *common] for name in METHODS},
        **{name: [*PICTURE, f"model={name}", *common, *pictures] for name in PICTURE_FIELDS},
    }


def trained(overrides: list[str], kernels: str, seed: int, device: torch.device, folder: Path) -> float:
    """Held-out PSNR of a run in this process, which says nothing."""
    given = [*overrides, f"kernels={kernels}", f"seed={seed}", *on_device(device)]
    with versions(kernels), redirect_stdout(io.StringIO()):
        found: float | None = train(composed(given, folder), folder=folder)
    return math.nan if found is None else found


def beside(
    overrides: list[str], device: torch.device, seed: int, folder: Path, words: str
) -> tuple[dict[str, Any], str]:
    """A method's mean PSNR on both, and what is wrong with it, in words; "" where nothing is.

    A seed more is asked as long as those before stand below the CPU.

    Raises:
        RuntimeError, TypeError: where the device cannot do it.
    """
    there, here = [], []
    for one in range(seed, seed + SEEDS):
        print(f"{words}: {STEPS} steps on both, seed {one}", flush=True)
        there.append(trained(overrides, "auto", one, device, folder / f"device_{one}"))
        here.append(trained(overrides, "reference", one, CPU, folder / f"reference_{one}"))
        below = fmean(here) - fmean(there)
        print(
            f"{words}: {there[-1]:.2f} dB on {device.type}, {here[-1]:.2f} dB by the reference on the CPU", flush=True
        )
        if below <= BELOW:
            break
    row = {"psnr": fmean(there), "reference_psnr": fmean(here), "seeds": len(there)}
    return row, "" if below <= BELOW else f"{below:.2g} dB below the CPU"


def measure(device: torch.device, seed: int, output: Path) -> tuple[Rows, list[str]]:
    """The table, a line a method, and the methods that are not equal, with what is not."""
    rows: Rows = []
    unequal = []
    methods = everything()
    for number, (name, overrides) in enumerate(methods.items(), 1):
        row: dict[str, Any] = {"method": name}
        words = f"methods {number}/{len(methods)}: {name}"
        try:
            figures, found = beside(overrides, device, seed, output / "trainings" / name, words)
            row |= figures
        except FAILURES as error:
            found = told(error)
        rows.append({**row, "equal": not found})
        if found:
            unequal.append(f"{name} ({found})")
            print(f"{words}: {found}", flush=True)
    return rows, unequal
