"""python -m benchmarks [PART ...] [KEY=VALUE ...]: runs benchmarks, which take minutes.

Overrides KEY=VALUE apply to all trainings but the short ones. Tables and JSON go to `outputs/benchmarks/`. On a new GPU,
run `device` first, then `agreement`: how fast it is, and whether it agrees with the CPU. The last line is then
`all equal`, or lists mismatches and failures, and the exit code is 0 or 1.
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
    "device": "one device in 8 minutes: GPU kernels, steps, profiles, PSNR over time, views, memory",
    "methods": "PSNR over training time of each method, trained as users do",
    "agreement": "kernels and short trainings on a device against plain PyTorch on the CPU",
    "step_time": "a training step: time, operations, bytes, host syncs, memory",
    "camera_noise": "loss by pose and exposure errors, and the gain of refine=auto",
    "capture_accuracy": "pose and lens errors of a synthetic capture with tags",
    "capture_quality": "photos with a background: PSNR, depth error and floaters",
    "objects": "objects of six kinds before a plain background: held-out PSNR",
    "photos": "photos of mixed sizes, with occluders, masks, and a fisheye lens",
    "image_fields": "2D fields against the course's recipe, and on several kinds of images",
    "size_search": "the choice of rightsize against every size trained in full",
    "mesh_accuracy": "meshes against the true surfaces",
    "video": "frame selection from a video, and its registration by COLMAP",
}
"""Modules of this folder with a function `measure(args)` that returns or yields rows, and their descriptions."""


def parse_list(item_type: type) -> Any:
    """Makes a parser of comma-separated values."""
    return lambda text: [item_type(part) for part in text.split(",") if part]


def make_parser() -> argparse.ArgumentParser:
    parts = "\n".join(f"  {name:10}  {description}" for name, description in PARTS.items())
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser("python -m benchmarks", None, f"{__doc__}\nparts:\n{parts}", formatter_class=raw)
    parser.add_argument("parts", nargs="*", metavar="part", help="parts to run, all by default; and overrides")
    parser.add_argument("--experiments", type=parse_list(str), default=["lego", "lego_hashgrid", "lego_voxels"])
    parser.add_argument("--budgets", type=parse_list(float), default=[60.0], help="seconds of training")
    parser.add_argument("--seeds", type=parse_list(int), default=[0, 1, 2])
    parser.add_argument("--scenes", type=parse_list(Path), default=[], help="for device, camera_noise, capture_quality")
    parser.add_argument(
        "--recipes", type=parse_list(str), default=[], help="for device, camera_noise, captures, objects"
    )
    parser.add_argument("--size", type=int, default=400, help="for objects: width of the photos, pixels")
    parser.add_argument(
        "--device", default="auto", help="for device, methods, agreement, step_time: auto, cpu, cuda, mps"
    )
    parser.add_argument(
        "--quick", action="store_true", help="for device: a trial of seconds, whose figures mean nothing"
    )
    output = Path("outputs/benchmarks") / time.strftime("%Y-%m-%d_%H-%M-%S")
    parser.add_argument("--output", type=Path, default=output, help="folder, or name of the JSON file")
    return parser


def parse_args(argv: list[str] | None = None) -> argparse.Namespace:
    """Parses the command line, in which overrides may follow options."""
    parser = make_parser()
    args = parser.parse_intermixed_args(argv)
    args.report = args.output if args.output.suffix == ".json" else args.output / "benchmarks.json"
    args.output = args.report.parent
    args.overrides = [part for part in args.parts if "=" in part]
    args.parts = [part for part in args.parts if "=" not in part] or list(PARTS)
    if unknown := sorted({*args.parts} - {*PARTS}):
        parser.error(f"found {unknown[0]}, expected some of {', '.join(PARTS)}, or overrides KEY=VALUE")
    try:
        args.device = resolve_device(args.device)
    except InputError as error:
        parser.error(str(error))
    return args


def main() -> None:
    args = parse_args()
    versions = {"torch": torch.__version__, "nerf_lightning": nerf_lightning.__version__}
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else None
    machine = {**describe_machine(args.device), "threads": torch.get_num_threads(), "load": load, "versions": versions}
    report: dict[str, Any] = {"machine": machine, "overrides": args.overrides}
    console, all_rows = Console(record=True, width=240), Rows()
    print(f"device: {machine['accelerator'] or machine['processor']} ({args.device})", flush=True)
    args.output.mkdir(parents=True, exist_ok=True)
    for part in args.parts:
        rows, tables = Rows(), {}
        for row in import_module(f"benchmarks.{part}").measure(args):
            rows.append(row)
            tables = group_by_table(part, rows)
            write_json(args.report, report | tables)  # what is measured stays if the machine goes away
        report |= tables
        all_rows += rows
        for name, table_rows in tables.items():
            console.print(make_rich_table(name, table_rows))
    console.save_text(str(args.output / "table.txt"))
    print(f"written to {args.report}")
    if any("differs" in row for row in all_rows):
        differences = list_differences(all_rows)
        print(f"not equal: {', '.join(differences)}" if differences else "all equal")
        sys.exit(bool(differences))


if __name__ == "__main__":
    main()
