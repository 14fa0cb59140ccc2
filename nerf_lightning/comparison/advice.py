"""Recommendations and caveats of a comparison, as sentences."""

from typing import Any

import numpy as np
import pandas as pd

from nerf_lightning.comparison.points import format_bytes, round_cost
from nerf_lightning.utils.machine import MAX_BACKGROUND_LOAD

MIN_SEEDS = 3
"""Number of runs below which a point on a frontier may be chance."""


def recommend(points: pd.DataFrame, within_db: float, seconds: float) -> list[str]:
    """Recommends points of a comparison: one sentence per point that is best, fastest or smallest.

    Args:
        points: from `compute_points`, best first.
        within_db: allowed loss of the fastest and the smallest against the best, dB.
        seconds: budget of training time.
    """
    best, costs = points["psnr"].max(), points["train_seconds"].map(round_cost)
    choices = {
        "best": points.index[0],
        f"fastest within {within_db:g} dB of the best": costs[points["psnr"] >= best - within_db].idxmin(),
    }
    quick = points[costs <= seconds]
    if len(quick):
        choices[f"best after at most {seconds:g} s of training"] = quick.index[0]
    sizes = points.loc[points["psnr"] >= best - within_db, "bytes"].dropna()
    if len(sizes):
        choices[f"smallest within {within_db:g} dB of the best"] = sizes.idxmin()
    sentences = []
    for chosen in dict.fromkeys(choices.values()):
        *first, last = [words for words, number in choices.items() if number == chosen]
        words = f"{', '.join(first)} and {last}" if first else last
        sentences.append(f"{words[0].upper()}{words[1:]}: {describe_point(points.loc[chosen])}.")
    return sentences if len(quick) else [*sentences, f"Nothing trained for {seconds:g} s or less."]


def describe_point(point: Any) -> str:
    count = len(point.runs)
    seeds = f"{point.psnr_min:.2f} to {point.psnr_max:.2f} over {count} seeds" if count > 1 else "one seed"
    seeds = f"{point.collapsed} of {count} runs collapsed" if point.collapsed else seeds
    size = "" if np.isnan(point.bytes) else f", {format_bytes(point.bytes)}"
    return f"{point.label}: {point.psnr:.2f} dB ({seeds}) after {point.train_seconds:.3g} s{size}"


def list_caveats(points: pd.DataFrame) -> list[str]:
    """Caveats of a comparison: background load, few seeds."""
    caveats = []
    busy = points[points["background_load"] > MAX_BACKGROUND_LOAD]
    if len(busy):
        caveats.append(
            f"Other processes used up to {busy['background_load'].max():.0%} of the threads: timings are too long"
            f" of {', '.join(busy['label'])}. Delete those runs and repeat them."
        )
    few = points[(points["frontier"] != "") & (points["runs"].map(len) < MIN_SEEDS)]
    if len(few):
        caveats.append(f"On a frontier with fewer than {MIN_SEEDS} seeds: {', '.join(few['label'])}.")
    return caveats
