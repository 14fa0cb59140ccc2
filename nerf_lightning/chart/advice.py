"""Which method is worth its time, in words."""

from collections.abc import Sequence

from nerf_lightning.chart.frontier import two_figures
from nerf_lightning.chart.points import Point


def advice(points: Sequence[Point], within_db: float, seconds: float, smallest_within_db: float) -> list[str]:
    """Sentences about points of one setting.

    Args:
        points: at least one.
        within_db: how far below the best the fastest may be, dB.
        seconds: a budget of training time.
        smallest_within_db: how far below the best the smallest may be, dB.
    """
    best = max(points, key=lambda point: (point.psnr, -point.seconds))
    told = [f"Best: {_told(best)}."]
    near = [point for point in points if point.psnr >= best.psnr - within_db]
    fastest = min(near, key=lambda point: (two_figures(point.seconds), -point.psnr))
    told.append(f"Fastest within {within_db:g} dB of the best: {_told(fastest)}.")
    quick = [point for point in points if two_figures(point.seconds) <= seconds]
    if quick:
        winner = max(quick, key=lambda point: (point.psnr, -point.seconds))
        told.append(f"Best within {seconds:g} s of training: {_told(winner)}.")
    else:
        told.append(f"Nothing trained for {seconds:g} s or less.")
    sized = [point for point in points if point.size is not None and point.psnr >= best.psnr - smallest_within_db]
    if sized:
        smallest = min(sized, key=lambda point: (point.size or 0.0, -point.psnr))
        told.append(f"Smallest within {smallest_within_db:g} dB of the best: {_told(smallest)}.")
    return told


def in_bytes(size: float) -> str:
    """1.2 MB, or 340 kB."""
    return f"{size / 1e6:.1f} MB" if size >= 1e6 else f"{size / 1e3:.0f} kB"


def _told(point: Point) -> str:
    seeds = f"worst of {point.seeds} seeds {point.worst:.2f}" if point.seeds > 1 else "one seed"
    if point.lost:
        seeds = f"{point.lost} of {len(point.runs)} runs lost"
    size = "" if point.size is None else f", {in_bytes(point.size)}"
    return f"{point.label}: {point.psnr:.2f} dB ({seeds}) after {point.seconds:.3g} s{size}"
