"""Warnings beside a chart: lost runs, a busy machine, too few seeds."""

import os
from collections.abc import Sequence
from pathlib import Path

from nerf_lightning.chart.points import Point
from nerf_lightning.runs.index import Run
from nerf_lightning.utils.machine import CROWDED, crowding

SEEDS = 3
"""Runs below which a point on the frontier may be luck."""


def troubles(runs: Sequence[Run]) -> list[str]:
    """A line for each run that did not come to a good end, with its folder as seen from the one that holds all runs."""
    if not runs:
        return []
    common = Path(os.path.commonpath([run.folder.absolute().parent for run in runs]))
    return [
        " ".join(f"{run.folder.absolute().relative_to(common)}: {run.status}: {run.diagnosis}".split()).rstrip(":")
        for run in runs
        if run.status != "finished" or run.psnr is None
    ]


def remarks(points: Sequence[Point], frontier: Sequence[Point]) -> list[str]:
    """What weakens the comparison of one setting's points."""
    runs = [run for point in points for run in point.runs]
    told = []
    shares = [(share, run) for run in runs if (share := crowding(run.results)) is not None and share > CROWDED]
    if shares:
        names = [run.folder.name for _, run in sorted(shares, key=lambda pair: -pair[0])]
        told.append(
            f"The machine was busy with something else during {len(shares)} of {len(runs)} runs, which took up to"
            f" {max(share for share, _ in shares):.0%} of their threads: what they measured is too slow. Delete their folders"
            f" and repeat the sweep: {'; '.join(names)}."
        )
    silent = sum(crowding(run.results) is None for run in runs)
    if silent:
        told.append(f"Of {silent} of {len(runs)} runs the load of the machine is not known.")
    few = [point.label for point in frontier if len(point.runs) < SEEDS]
    if few:
        told.append(f"On a frontier with fewer than {SEEDS} seeds: {'; '.join(few)}.")
    versions = {_version(run) for run in runs}
    if len(versions) > 1:
        told.append(f"Made by different versions of nerf_lightning: {', '.join(sorted(versions))}.")
    slow = [point.label for point in points if point.render is None]
    if slow:
        told.append(f"Without a rendering time: {'; '.join(slow)}.")
    return told


def _version(run: Run) -> str:
    versions = run.results.get("versions")
    return str(versions.get("nerf_lightning")) if isinstance(versions, dict) else "unknown"
