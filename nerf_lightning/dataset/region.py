"""The region of detail: where a capture's photos look at once, and the unit of length that fits it."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import normalize

from nerf_lightning.cameras import CameraLayout, classify_layout
from nerf_lightning.cameras.camera_layout import MAX_POINTS, axis_cosines, centre_spread, find_convergence, median_depth

MAX_VIEWS = 128
"""Evenly chosen views that tell where points are looked at."""
MIN_POINTS = 16
"""Fewer points than this say nothing about depth."""
MAX_MEAN_DIRECTION = 0.5
"""Mean of the unit vectors from the centre to cameras up to which they stand all around it: poses tell the centre."""
MIN_VIEW_COSINE = 0.8
"""Cosine of half the angle of the cone in which a camera counts as looking at a point."""
MIN_SCORE = 0.5
"""Points count that photos look at at least so much as at most others, see `find_overlap_centre`."""
PAN_DEPTH = 4.0
"""Units from a pan's camera to what it sees. Nothing is near the camera, so the box need not reach what it sees: in a room seen
from its middle, held-out views were 24.1, 26.1 and 22.2 dB at 0.8, 4 and 20 units."""
FORWARD_DEPTH, PAN_UNIT, WALK_UNIT = 4.0, 10.0, 2.0
"""Depth of a forward-facing scene and units of a pan and of a walk, in spreads of the cameras' centres, where nothing tells."""
CAMERA_QUANTILE = 0.9
"""Share of a walk's cameras that the box holds."""


@dataclass(frozen=True)
class Region:
    """A cube that deserves full detail, in the poses' frame and unit."""

    layout: CameraLayout
    centre: Float[Tensor, "3"]
    """Double precision."""
    unit: float
    """Half the cube's edge: the cameras' median distance to the centre where they look at it, else that of what they see."""
    has_depth: bool = True
    """Whether poses or points tell how deep the scene is; else `unit` is a guess from how far apart the cameras are."""
    points: Float[Tensor, "P 3"] | None = None
    """On surfaces, given or found by matching."""

    @property
    def has_subject(self) -> bool:
        """Whether all cameras look at the centre from outside."""
        return self.has_depth and self.layout in (CameraLayout.INWARD, CameraLayout.FORWARD)


def find_region(
    c2w: Float[Tensor, "V 4 4"],
    points: Float[Tensor, "P 3"] | None = None,
    match: Callable[[], Float[Tensor, "M 3"] | None] | None = None,
) -> Region:
    """Finds the region that photos show, by how their cameras are laid out.

    Inward: where the axes converge, all around it; from one side only, where the points are that most photos look at from
    the most different directions. Forward: likewise, or where axes converge. Pan: around the camera, a share of the way to
    what it sees. Walk: around the cameras, or as wide as what they see is far.

    Args:
        c2w: OpenCV, any frame; at least one.
        points: on surfaces, in that frame, where a file brings them.
        match: finds points between photos; called only where poses alone do not tell the depth.
    """
    origin = c2w[:, :3, 3].double().median(0).values
    moves = centre_spread(c2w) > 0
    local = c2w.double().clone()
    local[:, :3, 3] = (local[:, :3, 3] - origin) * moves  # what is left of one place is rounding
    target = find_convergence(local)
    if (points is None or len(points) < MIN_POINTS) and moves and target is None and match is not None:
        points = match()
    known = None if points is None or len(points) < MIN_POINTS else points.double() - origin
    layout = classify_layout(local, known)
    if layout in (CameraLayout.INWARD, CameraLayout.FORWARD):
        region = _make_subject_region(local, layout, target, known)
    else:
        region = _make_surroundings_region(local, layout, known)
    return replace(region, centre=region.centre + origin, points=None if known is None else known + origin)


def _make_subject_region(
    c2w: Float[Tensor, "V 4 4"],
    layout: CameraLayout,
    target: Float[Tensor, "3"] | None,
    points: Float[Tensor, "P 3"] | None,
) -> Region:
    """What cameras look at together; `target` is where their axes converge, if they do."""
    centres = c2w[:, :3, 3]
    centre = target
    one_sided = target is None or float(normalize(centres - target, dim=1).mean(0).norm()) > MAX_MEAN_DIRECTION
    if points is not None and one_sided:
        found = find_overlap_centre(c2w, points)
        centre = target if found is None else found
    known = centre is not None
    if centre is None:
        centre = centres.mean(0) + FORWARD_DEPTH * centre_spread(c2w) * normalize(c2w[:, :3, 2].mean(0), dim=0)
    return Region(layout, centre, float((centres - centre).norm(dim=1).median()), known)


def _make_surroundings_region(
    c2w: Float[Tensor, "V 4 4"], layout: CameraLayout, points: Float[Tensor, "P 3"] | None
) -> Region:
    """What is around cameras that look at no one thing."""
    centres, spread = c2w[:, :3, 3], centre_spread(c2w)
    depth = None if points is None else median_depth(c2w, points)
    if layout != CameraLayout.WALK:
        unit = PAN_UNIT * spread or 1.0 if depth is None else depth / PAN_DEPTH
        return Region(layout, centres.median(0).values, unit, depth is not None or spread == 0)
    low, high = centres.quantile(1 - CAMERA_QUANTILE, dim=0), centres.quantile(CAMERA_QUANTILE, dim=0)
    centre = (low + high) / 2
    reach = float((centres - centre).abs().amax(1).quantile(CAMERA_QUANTILE))
    unit = WALK_UNIT * reach if depth is None else max(depth, reach)
    return Region(layout, centre, unit, depth is not None)


def find_overlap_centre(c2w: Float[Tensor, "V 4 4"], points: Float[Tensor, "P 3"]) -> Float[Tensor, "3"] | None:
    """The middle of the points that most photos look at, from the most different directions; None where none is looked at.

    A point's score is the sum over pairs of cameras of how well it is in view of both, times 1 - cos of the angle between
    their directions to it: what is triangulated well.
    """
    some, c2w = points[:: -(-len(points) // MAX_POINTS)], c2w[:: -(-len(c2w) // MAX_VIEWS)]
    seen = ((axis_cosines(c2w, some) - MIN_VIEW_COSINE) / (1 - MIN_VIEW_COSINE)).clamp_min(0)
    toward = normalize(some[:, None] - c2w[:, :3, 3], dim=2)
    score = seen.sum(1).square() - torch.einsum("pv,pvk->pk", seen, toward).square().sum(1)
    best = score >= MIN_SCORE * score.quantile(0.95)
    if not bool((best & (score > 0)).any()):
        return None
    return some[best].median(0).values
