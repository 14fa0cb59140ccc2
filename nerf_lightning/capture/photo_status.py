"""The result for each photo of a capture: where its tags were seen and where they project to, or why it was left out."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from nerf_lightning.capture.poses.solve import Solved
from nerf_lightning.capture.run import Capture
from nerf_lightning.capture.tags.detect import Mark, Sighting
from nerf_lightning.dataset.placing.photos import natural
from nerf_lightning.utils.text import subsample


@dataclass(frozen=True)
class PhotoStatus:
    """One photo."""

    number: int
    """Its place in the folder, from 1; the pictures of the report name it so."""
    path: Path
    marks: dict[int, Mark]
    """Tags found, by id; none if the photo has another size."""
    residuals: dict[int, Float[np.ndarray, "M 2"]]
    """Projected minus seen, pixels, by the tag's id; none if the photo has no pose."""
    error: float | None
    """Root mean square of the residuals' lengths, pixels."""
    reason: str
    """Why it was left out; "" if it was used."""
    by: str = ""
    """"texture" if it was placed without tags."""

    @property
    def caption(self) -> str:
        if self.reason or self.error is None:
            return f"{self.number}: {self.path.name}, left out: {self.reason}"
        how = f", by its {self.by}" if self.by else ""
        return f"{self.number}: {self.path.name}{how}, {self.error:.2f} px"


def calibration_statuses(capture: Capture) -> list[PhotoStatus]:
    """Statuses of the photos of the tags, in natural order."""
    found = capture.calibration
    folder, used = found.used[0].path.parent, {s.name for s in found.used}
    paths = [s.path for s in found.used] + [folder / name for name in found.dropped if name not in used]
    return _statuses(sorted(paths, key=natural), found.used, found.solved, found.dropped)


def photo_statuses(capture: Capture) -> list[PhotoStatus]:
    """Statuses of the photos to be placed, in the order of `capture.photos`."""
    folder = capture.sightings[0].path.parent
    reasons = {photo.name: photo.reason for photo in capture.photos}
    statuses = _statuses([folder / p.name for p in capture.photos], capture.sightings, capture.solved, reasons)
    return [
        replace(status, error=photo.reprojection_px, by=photo.by) if photo.by else status
        for status, photo in zip(statuses, capture.photos, strict=True)
    ]


def _statuses(
    paths: Sequence[Path], sightings: Sequence[Sighting], solved: Solved, reasons: Mapping[str, str]
) -> list[PhotoStatus]:
    marks, tags, refined = {s.name: s.marks for s in sightings}, list(solved.tags), solved.refined
    names = [sightings[i].name for i in solved.placed]
    errors = dict(zip(names, refined.rms.tolist(), strict=True))
    residuals = {name: {tags[row]: r for row, r in refined.by_mark(i).items()} for i, name in enumerate(names)}
    return [
        PhotoStatus(n, p, marks.get(p.name, {}), residuals.get(p.name, {}), errors.get(p.name), reasons.get(p.name, ""))
        for n, p in enumerate(paths, 1)
    ]


def subsample_photos(statuses: Sequence[PhotoStatus], most: int) -> list[PhotoStatus]:
    """At most this many photos, evenly chosen, in order; up to half of them are of those left out."""
    if len(statuses) <= most:
        return list(statuses)
    left_out, used = [s for s in statuses if s.reason], [s for s in statuses if not s.reason]
    shown = [left_out[i] for i in subsample(len(left_out), most // 2)]
    shown += [used[i] for i in subsample(len(used), most - len(shown))]
    return sorted(shown, key=lambda s: s.number)
