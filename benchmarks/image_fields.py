"""2D fields: time of the default to the PSNR of the course's network, PSNR of each field, and of more images."""

import argparse
from pathlib import Path
from statistics import median

from benchmarks.methods import Run, censored_median, find_seconds_to_psnr, train
from benchmarks.procedural_images import KINDS, leaves, write_picture
from benchmarks.tables import Row, Rows, name_tables

COURSE_METHOD, FAST_METHOD = "picture_mlp", "picture"
CHECK_FRACTIONS = tuple(round(0.005 * 1.25**i, 4) for i in range(24))
"""Fractions of a short run's budget at which it is validated: the race is decided within tenths of a second."""
FIELDS = ("hashgrid2d", "picture_mlp", "fourier", "siren")
SIZE = 512
"""Side of the procedural images, pixels."""
LARGE_SIZE, LARGE_SECONDS = 4096, 60
"""Side of a camera-sized procedural image (leaves), and seconds of its training."""


def measure(args: argparse.Namespace) -> Rows:
    """Measures three tables: the race against the course's recipe, all fields after the same few seconds, and the default
    on each kind of procedural image. A `dataset.path` in the overrides applies to the first two."""
    overrides, seeds, output = args.overrides, args.seeds, args.output
    fractions = ",".join(str(check) for check in CHECK_FRACTIONS if check < 1)
    course = train(COURSE_METHOD, overrides, seeds[0], output / "pictures" / COURSE_METHOD)
    runs: dict[str, list[Run]] = {name: [] for name in FIELDS}
    for name in FIELDS:
        for seed in seeds:
            folder = output / "pictures" / f"{name}_{seed}"
            options = [*overrides, f"model={name}"] if name != "hashgrid2d" else overrides
            runs[name].append(train(FAST_METHOD, options, seed, folder, fractions))
    target = float(course["psnr"])
    seconds = censored_median([find_seconds_to_psnr(run["curve"], target) for run in runs["hashgrid2d"]])
    race = {
        "picture": course["scene"]["name"],
        "course_psnr": target,
        "course_steps": course["steps"],
        "course_seconds": course["train_seconds"],
        "hashgrid2d_seconds": seconds,
        "ratio": None if seconds is None else course["train_seconds"] / seconds,
    }
    fields = [
        {"field": name, **summarize(results), "bytes": results[0]["artifact_bytes"]} for name, results in runs.items()
    ]
    others = [part for part in overrides if not part.startswith("dataset.path=")]
    kinds = [measure_kind(kind, SIZE, others, seeds, output) for kind in KINDS]
    large_budget = f"budget.seconds={LARGE_SECONDS}"
    kinds.append(measure_kind(leaves.__name__, LARGE_SIZE, [*others, large_budget], seeds[:1], output))
    return name_tables({"pictures": [race], "2D fields": fields, "kinds of pictures": kinds})


def measure_kind(kind: str, size: int, overrides: list[str], seeds: list[int], output: Path) -> Row:
    """Trains the default recipe on a procedural image."""
    path = write_picture(kind, size, 0, output / "pictures" / "drawn")
    runs: list[Run] = []
    for seed in seeds:
        folder = output / "pictures" / f"{path.stem}_{seed}"
        runs.append(train(FAST_METHOD, [*overrides, f"dataset.path='{path}'"], seed, folder))
        print(f"{path.stem}, seed {seed}: {runs[-1]['psnr']:.2f} dB", flush=True)
    peak_memory_bytes = max(run["peak_memory_bytes"] for run in runs)
    return {"picture": path.stem, **summarize(runs), "peak_memory_bytes": peak_memory_bytes}


def summarize(runs: list[Run]) -> Row:
    """Summarizes the runs of all seeds."""
    return {
        "seeds": len(runs),
        "seconds": median(run["train_seconds"] for run in runs),
        "psnr": median(run["psnr"] for run in runs),
        "worst": min(run["psnr"] for run in runs),
        "parameters": runs[0]["parameters"],
    }
