"""What corrections have found, in a line and in figures."""

from statistics import median
from typing import Any

import torch

from nerf_lightning.refine.corrections import Corrections

MAX_ROTATION_DEG = 2.5
"""By which most cameras may have turned: from 2 degrees they come back, from 5 most do not."""


def format_report(corrections: Corrections) -> str:
    """In a line, what was found."""
    summary, phrases = summarize_corrections(corrections), []
    if "poses" in corrections.enabled_at:
        rotated, moved = summary["turned_degrees"], summary["moved"]
        phrases.append(f"cameras turned by up to {max(rotated):.2f} degrees and moved by up to {max(moved):.3g}")
        if median(rotated) > MAX_ROTATION_DEG:
            phrases.append(
                f"half of them by more than {median(rotated):.1f} degrees, too far for all to have found their places"
            )
        if summary["focal_factor"] is not None:
            phrases.append(f"focal length times {summary['focal_factor']:.4f}")
    if "exposure" in corrections.enabled_at:
        phrases.append(f"exposure from {min(summary['exposure']):.2f} to {max(summary['exposure']):.2f}")
        if summary["corner_brightness"] is not None:
            phrases.append(f"{summary['corner_brightness']:.2f} of the brightness in the corners")
    for part in corrections.learning_rates:
        if part not in corrections.enabled_at:
            share = max(0.0, corrections.last_error_reduction.get(part, 0.0))
            phrases.append(f"{part} as given (corrections would lower most photos' error by {share:.1%})")
    return "refine: " + "; ".join(phrases)


@torch.no_grad()
def summarize_corrections(corrections: Corrections) -> dict[str, Any]:
    """Of each photo: the angle it turned by in degrees, how far it moved in world units, and its mean gain; of all, where
    that was asked for, the factor on the focal length and that on the brightness of the farthest corners."""
    rotations, translations = corrections.poses.compute_pose_deltas()
    gains = corrections.color.gains.log().mean(1).exp()
    columns = {"turned_degrees": rotations.norm(dim=1).rad2deg(), "moved": translations.norm(dim=1), "exposure": gains}
    summary: dict[str, Any] = {name: [round(x, 5) for x in column.tolist()] for name, column in columns.items()}
    factors = {"focal_factor": corrections.poses.focal_factor, "corner_brightness": corrections.color.corner_brightness}
    return summary | {name: None if x is None else round(float(x), 5) for name, x in factors.items()}
