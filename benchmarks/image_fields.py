"""2D fields: how long the default takes to where the course's network ends, what each of them reaches, and what the default
reaches on pictures of other kinds, and on a large one."""

import argparse
from pathlib import Path
from statistics import median

from benchmarks.methods import Run, censored_median, find_seconds_to_psnr, train
from benchmarks.procedural_images import KINDS, leaves, write_picture
from benchmarks.tables import Row, Rows, name_tables

COURSE_METHOD, FAST_METHOD = "picture_mlp", "picture"
CHECK_FRACTIONS = tuple(round(0.005 * 1.25**i, 4) for i in range(24))
"""Shares of a short run's budget after which it is measured: the answer is a matter of tenths of a second."""
FIELDS = ("hashgrid2d", "picture_mlp", "fourier", "siren")
SIZE = 512
"""Pixels along each side of the pictures that are drawn."""
LARGE_SIZE, LARGE_SECONDS = 4096, 60
"""The same of a picture as a camera makes it, of leaves; and its training."""


def measure(args: argparse.Namespace) -> Rows:
    """Three tables: the race against the course's own recipe, all fields after the same few seconds, and the default on
    pictures of each kind. A picture that the overrides name is that of the first two tables alone."""
    overrides, seeds, output = args.overrides, args.seeds, args.output
    often = ",".join(str(check) for check in CHECK_FRACTIONS if check < 1)
    course = train(COURSE_METHOD, overrides, seeds[0], output / "pictures" / COURSE_METHOD)
    runs: dict[str, list[Run]] = {name: [] for name in FIELDS}
    for name in FIELDS:
        for seed in seeds:
            folder = output / "pictures" / f"{name}_{seed}"
            chosen = [*overrides, f"model={name}"] if name != "hashgrid2d" else overrides
            runs[name].append(train(FAST_METHOD, chosen, seed, folder, often))
    target = float(course["psnr"])
    needed = censored_median([find_seconds_to_psnr(run["curve"], target) for run in runs["hashgrid2d"]])
    race = {
        "picture": course["scene"]["name"],
        "course_psnr": target,
        "course_steps": course["steps"],
        "course_seconds": course["train_seconds"],
        "hashgrid2d_seconds": needed,
        "ratio": None if needed is None else course["train_seconds"] / needed,
    }
    fields = [
        {
            "field": name,
            "seeds": len(found),
            "seconds": median(run["train_seconds"] for run in found),
            "psnr": median(run["psnr"] for run in found),
            "worst": min(run["psnr"] for run in found),
            "parameters": found[0]["parameters"],
            "bytes": found[0]["artifact_bytes"],
        }
        for name, found in runs.items()
    ]
    others = [part for part in overrides if not part.startswith("dataset.path=")]
    kinds = [measure_kind(kind, SIZE, others, seeds, output) for kind in KINDS]
    kinds.append(
        measure_kind(leaves.__name__, LARGE_SIZE, [*others, f"budget.seconds={LARGE_SECONDS}"], seeds[:1], output)
    )
    return name_tables({"pictures": [race], "2D fields": fields, "kinds of pictures": kinds})


def measure_kind(kind: str, size: int, overrides: list[str], seeds: list[int], output: Path) -> Row:
    """What the default recipe makes of a picture that is drawn for it."""
    path = write_picture(kind, size, 0, output / "pictures" / "drawn")
    found: list[Run] = []
    for seed in seeds:
        folder = output / "pictures" / f"{path.stem}_{seed}"
        found.append(train(FAST_METHOD, [*overrides, f"dataset.path='{path}'"], seed, folder))
        print(f"{path.stem}, seed {seed}: {found[-1]['psnr']:.2f} dB", flush=True)
    return {
        "picture": path.stem,
        "seeds": len(found),
        "seconds": median(run["train_seconds"] for run in found),
        "psnr": median(run["psnr"] for run in found),
        "worst": min(run["psnr"] for run in found),
        "parameters": found[0]["parameters"],
        "peak_memory_bytes": max(run["peak_memory_bytes"] for run in found),
    }
