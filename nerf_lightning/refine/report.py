"""What corrections have found, in a line and in figures."""

from collections.abc import Callable
from statistics import median
from typing import Any

import torch

from nerf_lightning.refine.corrections import FAR_PX, Corrections
from nerf_lightning.utils.text import join_truncated

FAR_OFF = 2.5
"""Degrees by which most cameras may have turned: from 2 degrees they come back, from 5 most do not."""
APART, NAMED = 4.0, 5
"""Times the median by which a photo moves far more than the others, and how many of such are named."""


def format_report(corrections: Corrections, name: Callable[[int], str] = "photo {}".format) -> str:
    """In a line, what was found; `name` gives the names of photos."""
    found, said = summarize_corrections(corrections), []
    if "poses" in corrections.enabled_at:
        turned_by, moved_by = max(found["turned_degrees"]), max(found["moved"])
        said.append(f"cameras turned by up to {turned_by:.2f} degrees and moved by up to {moved_by:.3g}")
        if apart := find_outliers(corrections):
            said.append(f"far more than the others: {join_truncated([name(i) for i in apart], NAMED)}")
        if (middle := median(found["turned_degrees"])) > FAR_OFF:
            said.append(f"half of them by more than {middle:.1f} degrees, too far for all to have found their places")
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


def find_outliers(corrections: Corrections) -> list[int]:
    """Photos whose content moved far, and many times as far as in the others; the farthest first."""
    moved = corrections.poses.motions.detach().norm(dim=1)
    limit = max(FAR_PX, APART * float(moved.median()))
    return [int(i) for i in moved.argsort(descending=True) if moved[i] > limit]


@torch.no_grad()
def summarize_corrections(corrections: Corrections) -> dict[str, Any]:
    """Of each photo: the angle it turned by in degrees, how far it moved in world units, and its mean gain; of all, where
    that was asked for, the factor on the focal length and that on the brightness of the farthest corners."""
    turns, moves = corrections.poses.turns_and_moves()
    columns = turns.norm(dim=1).rad2deg(), moves.norm(dim=1), corrections.color.gains.log().mean(1).exp()
    names = ("turned_degrees", "moved", "exposure")
    found: dict[str, Any] = {
        name: [round(x, 5) for x in column.tolist()] for name, column in zip(names, columns, strict=True)
    }
    for name, factor in (
        ("focal_factor", corrections.poses.focal_factor),
        ("corner_brightness", corrections.color.corner_brightness),
    ):
        found[name] = None if factor is None else round(float(factor), 5)
    return found
