"""What corrections have found, in a line and in figures."""

from statistics import median
from typing import Any

import torch

from nerf_lightning.refine.corrections import Corrections

MAX_TURN_DEG = 2.5
"""By which most cameras may have turned: from 2 degrees they come back, from 5 most do not."""


def format_report(corrections: Corrections) -> str:
    """In a line, what was found."""
    found, said = summarize_corrections(corrections), []
    if "poses" in corrections.enabled_at:
        turned, moved = found["turned_degrees"], found["moved"]
        said.append(f"cameras turned by up to {max(turned):.2f} degrees and moved by up to {max(moved):.3g}")
        if median(turned) > MAX_TURN_DEG:
            said.append(
                f"half of them by more than {median(turned):.1f} degrees, too far for all to have found their places"
            )
        if found["focal_factor"] is not None:
            said.append(f"focal length times {found['focal_factor']:.4f}")
    if "light" in corrections.enabled_at:
        said.append(f"exposure from {min(found['exposure']):.2f} to {max(found['exposure']):.2f}")
        if found["corner_brightness"] is not None:
            said.append(f"{found['corner_brightness']:.2f} of the brightness in the corners")
    for part in corrections.rates:
        if part not in corrections.enabled_at:
            share = max(0.0, corrections.last_gain.get(part, 0.0))
            said.append(f"{part} as given (corrections would lower most photos' error by {share:.1%})")
    return "refine: " + "; ".join(said)


@torch.no_grad()
def summarize_corrections(corrections: Corrections) -> dict[str, Any]:
    """Of each photo: the angle it turned by in degrees, how far it moved in world units, and its mean gain; of all, where
    that was asked for, the factor on the focal length and that on the brightness of the farthest corners."""
    turns, moves = corrections.poses.turns_and_moves()
    gains = corrections.color.gains.log().mean(1).exp()
    columns = {"turned_degrees": turns.norm(dim=1).rad2deg(), "moved": moves.norm(dim=1), "exposure": gains}
    found: dict[str, Any] = {name: [round(x, 5) for x in column.tolist()] for name, column in columns.items()}
    factors = {"focal_factor": corrections.poses.focal_factor, "corner_brightness": corrections.color.corner_brightness}
    return found | {name: None if x is None else round(float(x), 5) for name, x in factors.items()}
