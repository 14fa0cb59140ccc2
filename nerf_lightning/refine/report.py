"""Refinement report: one line for the console, and figures for results.json."""

from statistics import median
from typing import Any

import torch

from nerf_lightning.refine.corrections import Corrections

MAX_ROTATION_DEG = 2.5
"""Largest median rotation: cameras recover from 2 degrees, from 5 most do not."""


def format_report(corrections: Corrections) -> str:
    """Formats the corrections in one line."""
    summary, phrases = summarize_corrections(corrections), []
    if "poses" in corrections.enabled_at:
        angles, shifts = summary["turned_degrees"], summary["moved"]
        phrases.append(f"cameras turned by up to {max(angles):.2f} degrees and moved by up to {max(shifts):.3g}")
        if median(angles) > MAX_ROTATION_DEG:
            phrases.append(f"half of them by more than {median(angles):.1f} degrees, too far for all to converge")
        if summary["focal_factor"] is not None:
            phrases.append(f"focal length times {summary['focal_factor']:.4f}")
    if "exposure" in corrections.enabled_at:
        phrases.append(f"exposure from {min(summary['exposure']):.2f} to {max(summary['exposure']):.2f}")
        if summary["corner_brightness"] is not None:
            phrases.append(f"{summary['corner_brightness']:.2f} of the brightness in the corners")
    for name in corrections.learning_rates:
        if name not in corrections.enabled_at:
            reduction = max(0.0, corrections.last_error_reduction.get(name, 0.0))
            phrases.append(f"{name} as given (corrections would lower most photos' error by {reduction:.1%})")
    return "refine: " + "; ".join(phrases)


@torch.no_grad()
def summarize_corrections(corrections: Corrections) -> dict[str, Any]:
    """Rotation (degrees), translation (world units) and mean gain of each photo; focal length factor and corner brightness of
    all, None if not refined."""
    rotations, translations = corrections.poses.compute_pose_deltas()
    gains = corrections.color.gains.log().mean(1).exp()
    columns = {"turned_degrees": rotations.norm(dim=1).rad2deg(), "moved": translations.norm(dim=1), "exposure": gains}
    summary: dict[str, Any] = {name: [round(x, 5) for x in column.tolist()] for name, column in columns.items()}
    factors = {"focal_factor": corrections.poses.focal_factor, "corner_brightness": corrections.color.corner_brightness}
    return summary | {name: None if x is None else round(float(x), 5) for name, x in factors.items()}
