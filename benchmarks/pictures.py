"""2D fields: how long the default takes to where the course's network ends, and what each of them reaches."""

from pathlib import Path
from statistics import median
from typing import Any

from benchmarks.methods import Run, middle, seconds_to, train

COURSE, FAST = "picture_mlp", "picture"
CHECKS = tuple(round(0.005 * 1.25**i, 4) for i in range(24))
"""Shares of a short run's budget after which it is measured: the answer is a matter of tenths of a second."""
FIELDS = ("hashgrid2d", "picture_mlp", "fourier", "siren")

Rows = list[dict[str, Any]]


def measure(overrides: list[str], seeds: list[int], output: Path) -> dict[str, Rows]:
    """Tables by name: the race against the course's own recipe, and all fields after the same few seconds."""
    often = ",".join(str(check) for check in CHECKS if check < 1)
    course = train(COURSE, overrides, seeds[0], output / "pictures" / COURSE)
    runs: dict[str, list[Run]] = {name: [] for name in FIELDS}
    for name in FIELDS:
        for seed in seeds:
            folder = output / "pictures" / f"{name}_{seed}"
            chosen = [*overrides, f"model={name}"] if name != "hashgrid2d" else overrides
            runs[name].append(train(FAST, chosen, seed, folder, often))
    target = float(course["psnr"])
    needed = middle([seconds_to(run["curve"], target) for run in runs["hashgrid2d"]])
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
    return {"pictures": [race], "2D fields": fields}
