"""python -m benchmarks [PART ...] [KEY=VALUE ...]: measures what takes minutes.

Overrides KEY=VALUE go to all trainings but those that are short. Tables and JSON go to `outputs/benchmarks/`. On a GPU,
`agreement step_time methods` come first: whether it gives what the CPU gives, and how fast. The last line then says
`all equal`, or what is not, and the exit code is 0 or 1.
"""

import argparse
import os
import sys
import time
from importlib import import_module
from pathlib import Path
from typing import Any

import torch
from rich.console import Console

import nerf_lightning
from benchmarks.tables import Rows, group_by_table, list_differences, make_rich_table
from nerf_lightning.errors import InputError
from nerf_lightning.utils.device import resolve_device
from nerf_lightning.utils.files import write_json
from nerf_lightning.utils.machine import describe_machine

PARTS = {
    "methods": "trainings as users run them: seconds to a quality, and quality after seconds",
    "agreement": "kernels and short trainings on a device against plain PyTorch on the CPU",
    "step_time": "a training step: time, operations, memory, what Lightning adds",
    "camera_noise": "what inexact cameras and light cost, and how much of it refine=auto brings back",
    "capture_accuracy": "how near a synthetic capture with tags comes to the true cameras",
    "capture_quality": "photos with a background: quality, fog and depth",
    "photos": "photos of several sizes, with passers-by, masks, and through a fisheye",
    "image_fields": "2D fields against the course's recipe, and on pictures of many kinds",
    "size_search": "what the search for the smallest model chooses, against every size trained in full",
    "mesh_accuracy": "meshes against true surfaces",
    "video": "frames chosen from a video, and how well COLMAP places them",
}
"""Modules of this folder with a function `measure(args) -> list[dict]`, and what they measure."""


def parse_list(kind: type) -> Any:
    """A parser of numbers separated by commas."""
    return lambda text: [kind(part) for part in text.split(",") if part]


def make_parser() -> argparse.ArgumentParser:
    parts = "\n".join(f"  {name:10}  {what}" for name, what in PARTS.items())
    raw = argparse.RawDescriptionHelpFormatter
    found = argparse.ArgumentParser("python -m benchmarks", None, f"{__doc__}\nparts:\n{parts}", formatter_class=raw)
    found.add_argument("parts", nargs="*", metavar="part", help="which, all by default; and overrides")
    found.add_argument("--experiments", type=parse_list(str), default=["lego", "lego_hashgrid", "lego_voxels"])
    found.add_argument("--budgets", type=parse_list(float), default=[60.0], help="seconds of training")
    found.add_argument("--seeds", type=parse_list(int), default=[0, 1, 2])
    found.add_argument(
        "--scenes", type=parse_list(Path), default=[], help="of cameras and captures: scenes of one's own"
    )
    found.add_argument("--recipes", type=parse_list(str), default=[], help="of cameras and captures: what to train")
    found.add_argument("--device", default="auto", help="of methods, agreement and speed: auto, cpu, cuda or mps")
    output = Path("outputs/benchmarks") / time.strftime("%Y-%m-%d_%H-%M-%S")
    found.add_argument("--output", type=Path, default=output)
    return found


def parse_args(words: list[str] | None = None) -> argparse.Namespace:
    """The options; overrides may stand behind them."""
    options = make_parser()
    args = options.parse_intermixed_args(words)
    args.overrides = [part for part in args.parts if "=" in part]
    args.parts = [part for part in args.parts if "=" not in part] or list(PARTS)
    if unknown := sorted({*args.parts} - {*PARTS}):
        options.error(f"found {unknown[0]}, expected some of {', '.join(PARTS)}, or overrides KEY=VALUE")
    try:
        args.device = resolve_device(args.device)
    except InputError as error:
        options.error(str(error))
    return args


def main() -> None:
    args = parse_args()
    versions = {"torch": torch.__version__, "nerf_lightning": nerf_lightning.__version__}
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else None
    machine = {**describe_machine(args.device), "threads": torch.get_num_threads(), "load": load, "versions": versions}
    report: dict[str, Any] = {"machine": machine, "overrides": args.overrides}
    console, everything = Console(record=True, width=240), Rows()
    print(f"device: {machine['accelerator'] or machine['processor']} ({args.device})", flush=True)
    for part in args.parts:
        rows = import_module(f"benchmarks.{part}").measure(args)
        everything += rows
        for name, found in group_by_table(part, rows).items():
            report[name] = found
            console.print(make_rich_table(name, found))
    args.output.mkdir(parents=True, exist_ok=True)
    console.save_text(str(args.output / "table.txt"))
    write_json(args.output / "benchmarks.json", report)
    print(f"written to {args.output}")
    if any("differs" in row for row in everything):
        unequal = list_differences(everything)
        print(f"not equal: {', '.join(unequal)}" if unequal else "all equal")
        sys.exit(bool(unequal))


if __name__ == "__main__":
    main()
