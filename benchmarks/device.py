"""What the device at hand does: whether its kernels and trainings equal the CPU's, and how fast they are."""

from pathlib import Path

import torch

from benchmarks import alike, steps, trainings
from benchmarks.alike import Rows
from benchmarks.methods import marks, seconds_to, train
from benchmarks.setup import METHODS, on_device

TARGETS_DB = (24, 27, 30, 33)


def lego(device: torch.device, overrides: list[str], seconds: float, seed: int, output: Path) -> tuple[Rows, list[str]]:
    """Seconds to a quality of each 3D method on the Lego scene, or on what stands in for it, and the methods that fail."""
    rows: Rows = []
    failed = []
    for number, name in enumerate(METHODS, 1):
        words = f"lego {number}/{len(METHODS)}: {name}"
        print(f"{words}: {seconds:g} s of training, and its measurements", flush=True)
        given = [f"recipe={name}_medium", f"budget.seconds={seconds}", *on_device(device), *overrides]
        try:
            run = train("lego", given, seed, output / "lego" / name, marks(seconds))
        except SystemExit as stopped:  # how `train` tells that its process failed
            failed.append(f"{name} (its training failed)")
            rows.append({"method": name, "failed": str(stopped)})
            print(f"{words}: {stopped}", flush=True)
            continue
        row = {"method": name, "scene": run["scene"]["name"], "device": run["device"], "seconds": run["train_seconds"]}
        row |= {f"seconds_to_{target}_db": seconds_to(run["curve"], target) for target in TARGETS_DB}
        rows.append({**row, "psnr": run["psnr"], "render_seconds_per_view": run["render_seconds_per_view"]})
        print(f"{words}: {run['psnr']:.2f} dB on {row['scene']}", flush=True)
    return rows, failed


def measure(
    device: torch.device, overrides: list[str], seconds: float, seed: int, output: Path
) -> tuple[dict[str, Rows], list[str]]:
    """All tables, and what is not equal.

    Args:
        overrides: of the steps and of the trainings on Lego; kernels and short trainings have work of their own.
        seconds: of each training on Lego.
        seed: of all trainings, the first of those that are short.
    """
    tables, unequal = {}, []
    for name, (rows, found) in {
        "device kernels": alike.measure(device),
        "device methods": trainings.measure(device, seed, output),
        "device steps": steps.measure(device, overrides),
        "device lego": lego(device, overrides, seconds, seed, output),
    }.items():
        tables[name] = rows
        unequal += found
    return tables, unequal


def verdict(unequal: list[str]) -> str:
    """The last line."""
    return f"not equal: {', '.join(unequal)}" if unequal else "all equal"
