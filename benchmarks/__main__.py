"""python -m benchmarks: what methods, kernels, framework, cameras, captures, photos, 2D fields, sizes, shapes and videos give.

`python -m benchmarks device` tells whether the GPU at hand gives what the CPU gives, and how fast: its last line says it.
"""

import argparse
import os
import platform
import sys
import time
from pathlib import Path
from typing import Any

import torch

import nerf_lightning
from benchmarks import (
    cameras,
    capture,
    captures,
    device,
    growth,
    kernels,
    methods,
    overhead,
    photos,
    pictures,
    shapes,
    sizes,
    video,
)
from nerf_lightning.errors import InputError
from nerf_lightning.utils.device import the_device
from nerf_lightning.utils.files import write_json
from nerf_lightning.utils.machine import describe_machine

PARTS = (
    "methods",
    "kernels",
    "growth",
    "overhead",
    "cameras",
    "capture",
    "captures",
    "photos",
    "pictures",
    "sizes",
    "shapes",
    "video",
)
ALONE = ("device",)
"""Run only when they are named."""


def table(rows: list[dict[str, Any]]) -> str:
    """Rows as text, numbers to three figures, columns as wide as they need."""

    def cell(value: Any) -> str:
        if value is None:
            return "-"
        if isinstance(value, float | int) and not isinstance(value, bool):
            return f"{value / 1e6:.1f}M" if value >= 1e6 else f"{value:.4g}"
        return str(value)

    keys = list(dict.fromkeys(key for row in rows for key in row))
    cells = [[cell(row.get(key)) for key in keys] for row in rows]
    widths = [max(len(key), *(len(line[i]) for line in cells)) for i, key in enumerate(keys)]
    lines = [keys, ["-" * width for width in widths], *cells]
    return "\n".join("  ".join(text.rjust(width) for text, width in zip(line, widths, strict=True)) for line in lines)


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    chosen = f"which of {', '.join(PARTS)} (all by default), or {', '.join(ALONE)}"
    chosen += "; and overrides KEY=VALUE for all runs but those that are short"
    parser.add_argument("parts", nargs="*", metavar="part", help=chosen)
    parser.add_argument("--experiments", default="lego,lego_hashgrid,lego_voxels", help="experiments to train")
    parser.add_argument("--budgets", default="60", help="seconds of training, separated by commas")
    parser.add_argument("--seeds", default="0,1,2")
    parser.add_argument(
        "--scenes",
        default="",
        help="separated by commas; of the part captures: more folders of photos; of cameras: others than the built-in one",
    )
    parser.add_argument("--recipes", default="", help="of the parts cameras and captures: what to train")
    parser.add_argument("--device", default="auto", help="of the part device: auto, cpu, cuda or mps")
    parser.add_argument("--output", type=Path, default=Path("outputs/benchmarks") / time.strftime("%Y-%m-%d_%H-%M-%S"))
    arguments = parser.parse_intermixed_args()  # overrides may stand behind options
    overrides = [part for part in arguments.parts if "=" in part]
    parts = [part for part in arguments.parts if "=" not in part] or list(PARTS)
    unknown = sorted(set(parts) - {*PARTS, *ALONE})
    if unknown:
        parser.error(f"found {unknown[0]}, expected some of {', '.join([*PARTS, *ALONE])}, or overrides KEY=VALUE")
    try:
        chosen_device = the_device(arguments.device)
    except InputError as error:
        parser.error(str(error))
    budgets, seeds = [float(x) for x in arguments.budgets.split(",")], [int(x) for x in arguments.seeds.split(",")]
    experiments = arguments.experiments.split(",")
    recipes = [recipe for recipe in arguments.recipes.split(",") if recipe]
    scenes = [Path(scene) for scene in arguments.scenes.split(",") if scene]
    report: dict[str, Any] = {
        "machine": {
            "processor": platform.processor() or platform.machine(),
            "cores": os.cpu_count(),
            "threads": torch.get_num_threads(),
            "load_at_start": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
            "python": platform.python_version(),
            "torch": torch.__version__,
            "nerf_lightning": nerf_lightning.__version__,
        },
        "overrides": overrides,
    }
    text: list[str] = []
    unequal: list[str] | None = None
    for part in parts:
        tables: dict[str, list[dict[str, Any]]]
        if part == "device":
            report["device"] = {"name": str(chosen_device), **describe_machine(chosen_device)}
            print(
                f"device: {report['device']['accelerator'] or report['device']['processor']} ({chosen_device})",
                flush=True,
            )
            tables, unequal = device.measure(chosen_device, overrides, budgets[0], seeds[0], arguments.output)
        elif part == "capture":
            tables = capture.measure(seeds, arguments.output)
        elif part == "cameras":
            tables = cameras.measure(overrides, seeds, scenes, recipes or list(cameras.RECIPES), arguments.output)
        elif part == "captures":
            tables = captures.measure(
                overrides, budgets[0], seeds, scenes, recipes or list(captures.RECIPES), arguments.output
            )
        elif part == "photos":
            tables = photos.measure(seeds, arguments.output)
        elif part == "pictures":
            tables = pictures.measure(overrides, seeds, arguments.output)
        elif part == "sizes":
            tables = sizes.measure(overrides, budgets[0], arguments.output)
        elif part == "shapes":
            tables = shapes.measure(budgets[0], arguments.output)
        elif part == "video":
            tables = video.measure(seeds[0], arguments.output)
        elif part == "methods":
            rows, report["runs"] = methods.measure(experiments, overrides, budgets, seeds, arguments.output)
            tables = {part: rows}
        elif part == "kernels":
            tables = {part: kernels.measure()}
        elif part == "growth":
            tables = {part: growth.measure([f"+experiment={experiments[0]}", *overrides])}
            tables["threads"] = growth.by_threads(experiments, overrides)
        else:
            tables = {part: [overhead.measure([f"+experiment={experiments[0]}", *overrides])]}
        for name, rows in tables.items():
            report[name] = rows
            text.append(f"{name}\n\n{table(rows)}\n")
            print("\n" + text[-1], flush=True)
    arguments.output.mkdir(parents=True, exist_ok=True)
    (arguments.output / "table.txt").write_text("\n".join(text), encoding="utf-8")
    write_json(arguments.output / "benchmarks.json", report)
    print(f"written to {arguments.output}")
    if unequal is not None:
        print(device.verdict(unequal))
        sys.exit(bool(unequal))


if __name__ == "__main__":
    main()
