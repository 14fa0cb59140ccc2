"""What became of each photo of a capture: where its tags were seen, where they should be, or why it was left out."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from nerf_lightning.capture.photos import natural
from nerf_lightning.capture.poses.solve import Solved
from nerf_lightning.capture.run import Capture
from nerf_lightning.capture.tags.detect import Mark, Sighting


@dataclass(frozen=True)
class Outcome:
    """One photo."""

    number: int
    """Its place in the folder, from 1; what all pictures of the report call it by."""
    path: Path
    marks: dict[int, Mark]
    """Tags found, by id; none where the photo was of another size."""
    residuals: dict[int, Float[np.ndarray, "M 2"]]
    """Projected minus seen, pixels, by the tag's id; none where the photo has no pose."""
    error: float | None
    """Root mean square of the residuals' lengths, pixels."""
    reason: str
    """Why it was left out; "" where it was not."""

    @property
    def caption(self) -> str:
        if self.reason or self.error is None:
            return f"{self.number}: {self.path.name}, left out: {self.reason}"
        return f"{self.number}: {self.path.name}, {self.error:.2f} px"


def calibration_outcomes(capture: Capture) -> list[Outcome]:
    """Of the photos of the tags, in natural order."""
    found = capture.calibration
    folder, used = found.used[0].path.parent, {s.name for s in found.used}
    paths = [s.path for s in found.used] + [folder / name for name in found.dropped if name not in used]
    return _outcomes(sorted(paths, key=natural), found.used, found.solved, found.dropped)


def photo_outcomes(capture: Capture) -> list[Outcome]:
    """Of the photos to be placed, in the order of `capture.photos`."""
    folder = capture.sightings[0].path.parent
    reasons = {photo.name: photo.reason for photo in capture.photos}
    return _outcomes([folder / photo.name for photo in capture.photos], capture.sightings, capture.solved, reasons)


def _outcomes(
    paths: Sequence[Path], sightings: Sequence[Sighting], solved: Solved, reasons: Mapping[str, str]
) -> list[Outcome]:
    marks, tags, refined = {s.name: s.marks for s in sightings}, list(solved.tags), solved.refined
    residuals: dict[str, dict[int, Float[np.ndarray, "M 2"]]] = {}
    errors: dict[str, float] = {}
    for i, seen, rest, error in zip(solved.placed, refined.bundle.marks, refined.residuals, refined.rms, strict=True):
        ends = np.cumsum([len(mark.pixels) for mark in seen.values()])[:-1]
        parts = zip(seen, np.split(rest, ends), strict=True)
        residuals[sightings[i].name] = {tags[row]: part for row, part in parts}
        errors[sightings[i].name] = float(error)
    return [
        Outcome(
            number,
            path,
            marks.get(path.name, {}),
            residuals.get(path.name, {}),
            errors.get(path.name),
            reasons.get(path.name, ""),
        )
        for number, path in enumerate(paths, 1)
    ]


def thinned(outcomes: Sequence[Outcome], most: int) -> list[Outcome]:
    """So many photos, evenly chosen, in order; those left out come first, up to half of them."""
    if len(outcomes) <= most:
        return list(outcomes)
    left_out = _evenly([o for o in outcomes if o.reason], most // 2)
    kept = _evenly([o for o in outcomes if not o.reason], most - len(left_out))
    return sorted(left_out + kept, key=lambda o: o.number)


def _evenly(outcomes: list[Outcome], most: int) -> list[Outcome]:
    if len(outcomes) <= most:
        return outcomes
    return [outcomes[i] for i in np.linspace(0, len(outcomes) - 1, most).round().astype(int)]
