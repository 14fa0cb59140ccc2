"""Camera paths to show a scene along, which stay where photos were taken."""

import math

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation, Slerp
from torch import Tensor
from torch.nn.functional import normalize

from nerf_lightning.cameras.cameras import Cameras
from nerf_lightning.cameras.layout import Layout, centre_spread, classify_layout, find_convergence
from nerf_lightning.cameras.orbit import look_at, typical_view, upward
from nerf_lightning.cameras.upright import held

MAX_STEEPNESS = 1.4
"""Largest angle of a path above or below the horizon, radians."""
AZIMUTH_SHARPNESS = 4.0
"""Concentration of the kernel (von Mises) that averages cameras by azimuth: a standard deviation of about 29 degrees."""
MIN_DENSITY = 0.15
"""An azimuth was photographed where the kernel density is at least this share of its mean: gaps of 90 degrees do."""
INSIDE = 0.7
"""Share of the views that lie within a loop before the subject."""
MAX_DETOUR = 2.0
"""Photos are not in the order of a walk where it is that many times longer than going to the nearest one each time."""
WALK_SAMPLES = 512
SPIRAL_TURNS, SPIRAL_CLIMB = 2, 0.75
"""Turns of a spiral, and how much of the way to its axis it climbs."""
ONE_SIDED = 0.35
"""Mean of the unit vectors from a subject to a path's views above which they are all on one side of it."""


def orbit_like(
    cameras: Cameras, frames: int = 60, layout: Layout | None = None, centre: Float[Tensor, "3"] | None = None
) -> Cameras:
    """A closed path that shows what `cameras` show from where they stood, upright, with the lens of a typical one.

    Inward: a full turn at the cameras' distance and height, looking at the subject, or a swing within the arc that they cover.
    Forward: an ellipse among the cameras, looking at the subject. Pan: a turn on the spot, as far as the photos. Walk: along
    the photos, and back.

    Args:
        cameras: at least one.
        frames: number of views; the last stops one step short of the first, so that a loop is smooth.
        layout: of the cameras; None classifies them.
        centre: the subject, for inward and forward cameras; None takes what they gaze at.
    """
    c2w = cameras.c2w.double()
    layout = classify_layout(c2w) if layout is None else layout
    up, sides = held(c2w)
    if layout == Layout.WALK:
        poses = walk_along(c2w, up, frames)
    elif layout == Layout.PAN:
        poses = turn_on_spot(c2w, up, frames)
    else:
        if centre is None:
            ahead = c2w[:, :3, 3].mean(0) + (4 * centre_spread(c2w) or 1.0) * normalize(c2w[:, :3, 2].mean(0), dim=0)
            target = find_convergence(c2w)
            centre = ahead if target is None else target
        build = turn_around if layout == Layout.INWARD else loop_before
        poses = build(c2w, centre.double(), up, frames)
    typical = typical_view(cameras)
    one = cameras[typical].as_pinholes()  # photos of all directions have no view to repeat
    K, (width, height) = one.K[0], one.size(0)
    if int(sides[typical]) % 2 == 1:  # it lies on its side
        K, width, height = on_its_side(K, width, height), height, width
    return Cameras.of_size(K.repeat(frames, 1, 1), poses.to(cameras.c2w), width, height)


def turn_around(
    c2w: Float[Tensor, "V 4 4"], centre: Float[Tensor, "3"], up: Float[Tensor, "3"], frames: int
) -> Float[Tensor, "frames 4 4"]:
    """Around a subject, or along an arc before it, at the distance and height of the cameras on that side."""
    offset = c2w[:, :3, 3] - centre
    direction, weights = angular_loop(offset, up, frames)
    distance = weights @ offset.norm(dim=1)
    return look_at(centre + distance[:, None] * direction, centre, up)


def turn_on_spot(c2w: Float[Tensor, "V 4 4"], up: Float[Tensor, "3"], frames: int) -> Float[Tensor, "frames 4 4"]:
    """From the median of the cameras' centres, all around or as far as the photos look."""
    spot = c2w[:, :3, 3].median(0).values.expand(frames, 3)
    direction, _ = angular_loop(c2w[:, :3, 2], up, frames)
    return look_at(spot, spot + direction, up)


def angular_loop(
    offset: Float[Tensor, "V 3"], up: Float[Tensor, "3"], frames: int
) -> tuple[Float[Tensor, "frames 3"], Float[Tensor, "frames V"]]:
    """A closed loop of directions: a full turn where vectors point all around, else to and fro between the outermost, at the
    mean elevation of those around.

    Returns:
        Unit vectors; and for each the weights, of sum 1, of the vectors that are around it.
    """
    direction = normalize(offset, dim=1)
    helper = torch.eye(3, dtype=up.dtype, device=up.device)[int(up.abs().argmin())]
    right = normalize(torch.linalg.cross(up, helper), dim=0)
    front = torch.linalg.cross(right, up)
    azimuth = torch.atan2(direction @ right, direction @ front)
    elevation = torch.asin((direction @ up).clamp(-1, 1))
    level = elevation.cos() + 1e-3  # what points straight up has no azimuth

    def around(at: Float[Tensor, "A"]) -> Float[Tensor, "A V"]:
        return level * torch.exp(AZIMUTH_SHARPNESS * (torch.cos(at[:, None] - azimuth) - 1))

    def mean_elevation(at: Float[Tensor, "A"]) -> Float[Tensor, "A"]:
        return (normalize(around(at), p=1, dim=1) * elevation).sum(1)

    turn = torch.arange(frames, dtype=up.dtype, device=up.device) * (2 * math.pi / frames)
    compass = torch.arange(360, dtype=up.dtype, device=up.device) * (2 * math.pi / 360)
    density = around(compass).sum(1)
    seen = density >= MIN_DENSITY * density.mean()
    if bool(seen.all()):
        at = azimuth[0] + turn
        above = mean_elevation(at)
    else:
        middle = compass[density.argmax()]
        dark, off = _wrapped(compass[~seen] - middle), _wrapped(azimuth - middle)
        start = max([-math.pi, *dark[dark < 0].tolist()])
        end = min([math.pi, *dark[dark > 0].tolist()])
        within = off[(off > start) & (off < end)]
        low, high = within.min(), within.max()
        at = middle + (low + high) / 2 + (high - low) / 2 * torch.cos(turn)
        above = mean_elevation(at) + (elevation - mean_elevation(azimuth)).abs().quantile(INSIDE) * torch.sin(turn)
    above = above.clamp(-MAX_STEEPNESS, MAX_STEEPNESS)
    flat = torch.cos(at)[:, None] * front + torch.sin(at)[:, None] * right
    return torch.cos(above)[:, None] * flat + torch.sin(above)[:, None] * up, normalize(around(at), p=1, dim=1)


def _wrapped(angle: Float[Tensor, "N"]) -> Float[Tensor, "N"]:
    """The same angles from -pi to pi."""
    return torch.remainder(angle + math.pi, 2 * math.pi) - math.pi


def loop_before(
    c2w: Float[Tensor, "V 4 4"], centre: Float[Tensor, "3"], up: Float[Tensor, "3"], frames: int
) -> Float[Tensor, "frames 4 4"]:
    """An ellipse across the view of forward-facing cameras, around most of their centres."""
    middle = c2w[:, :3, 3].mean(0)
    offset = c2w[:, :3, 3] - middle
    ahead = normalize(c2w[:, :3, 2].mean(0), dim=0)
    flat = offset - (offset @ ahead)[:, None] * ahead
    first = torch.linalg.svd(flat).Vh[0]
    first = (
        normalize(first - (first @ ahead) * ahead, dim=0) if float(flat.norm()) > 0 else normalize(c2w[0, :3, 0], dim=0)
    )
    second = torch.linalg.cross(ahead, first)
    places = torch.stack([flat @ first, flat @ second], dim=1)
    axes = places.abs().quantile(INSIDE, dim=0)
    turn = torch.arange(frames, dtype=up.dtype, device=up.device) * (2 * math.pi / frames)
    at = axes * torch.stack([torch.cos(turn), torch.sin(turn)], dim=1)
    eye = middle + at[:, :1] * first + at[:, 1:] * second
    return look_at(eye, centre, up)


def walk_along(c2w: Float[Tensor, "V 4 4"], up: Float[Tensor, "3"], frames: int) -> Float[Tensor, "frames 4 4"]:
    """Smoothly from photo to photo, in their order or, where that jumps, to the nearest each time; round, or there and back."""
    c2w = c2w[walking_order(c2w[:, :3, 3])]
    count = len(c2w)
    at = torch.linspace(0, count - 1, WALK_SAMPLES, dtype=c2w.dtype, device=c2w.device)
    width = max(1.0, count / 20)
    weights = torch.exp(-0.5 * ((at[:, None] - torch.arange(count).to(at)) / width).square())
    weights = weights / weights.sum(1, keepdim=True)
    place, ahead = weights @ c2w[:, :3, 3], weights @ c2w[:, :3, 2]
    nearest = c2w[at.round().long(), :3, 2]  # where opposite directions cancel out
    ahead = normalize(torch.where(ahead.norm(dim=1, keepdim=True) > 0.05, ahead, nearest), dim=1)
    step = (place[1:] - place[:-1]).norm(dim=1)
    turn = torch.acos((ahead[1:] * ahead[:-1]).sum(1).clamp(-1, 1))
    passed = torch.cat([step.new_zeros(1), (step / step.sum().clamp_min(1e-12) + turn / 20).cumsum(0)])
    steps = (c2w[1:, :3, 3] - c2w[:-1, :3, 3]).norm(dim=1)
    is_round = float((c2w[0, :3, 3] - c2w[-1, :3, 3]).norm()) < 2 * float(steps.mean())
    share = torch.arange(frames, dtype=at.dtype, device=at.device) / frames
    share = share if is_round else 1 - (1 - 2 * share).abs()
    which = torch.searchsorted(passed, share * passed[-1]).clamp_max(WALK_SAMPLES - 1)
    return look_at(place[which], place[which] + ahead[which], up)


def walking_order(centres: Float[Tensor, "V 3"]) -> list[int]:
    """The given order, or from each place to the nearest that is left, where that is far shorter."""
    distance = torch.cdist(centres, centres)
    order = [int(distance.sum(1).argmax())]
    left = distance.clone()
    for _ in range(len(centres) - 1):
        left[:, order[-1]] = math.inf
        order.append(int(left[order[-1]].argmin()))
    given, shortest = distance.diagonal(1).sum(), distance[order[:-1], order[1:]].sum()
    return order if float(given) > MAX_DETOUR * float(shortest) else list(range(len(centres)))


def on_its_side(K: Float[Tensor, "3 3"], width: int, height: int) -> Float[Tensor, "3 3"]:
    """Intrinsics of a photo turned by a quarter, with its principal point in the middle."""
    turned = torch.eye(3, dtype=K.dtype, device=K.device)
    turned[0, 0], turned[1, 1], turned[0, 2], turned[1, 2] = K[1, 1], K[0, 0], height / 2, width / 2
    return turned


def resample_path(cameras: Cameras, frames: int, closed: bool) -> Cameras:
    """As many views as asked for along a path: some of its own, or more between them.

    Args:
        cameras: the path.
        frames: how many.
        closed: whether the path goes on from its last view to its first.
    """
    count = len(cameras)
    if frames <= count or count < 2:
        return cameras[((torch.arange(min(frames, count)) + 0.5) * (count / min(frames, count)) - 0.5).round().long()]
    at = np.arange(frames) * (count / frames) if closed else np.linspace(0, count - 1, frames)
    loop = torch.arange(count + closed) % count
    c2w = cameras.c2w[loop].double().numpy()
    turned = Slerp(np.arange(len(loop)), Rotation.from_matrix(c2w[:, :3, :3]))(at).as_matrix()
    moved = np.stack([np.interp(at, np.arange(len(loop)), c2w[:, i, 3]) for i in range(3)], axis=-1)
    poses = torch.eye(4).repeat(frames, 1, 1)
    poses[:, :3, :3] = torch.from_numpy(turned)
    poses[:, :3, 3] = torch.from_numpy(moved)
    below = torch.from_numpy(at.astype(int))
    part = torch.from_numpy(at - at.astype(int)).float()[:, None, None]
    K = cameras.K[loop]
    after = (below + 1).clamp_max(len(loop) - 1)
    return Cameras.of_size(K[below] * (1 - part) + K[after] * part, poses, cameras.width, cameras.height)


def pivot_of(path: Cameras) -> Float[Tensor, "3"]:
    """What a viewer turns about that starts at a path's first view: the subject, or a place ahead where there is none."""
    c2w = path.c2w
    if (target := find_convergence(c2w)) is not None:
        return target.to(c2w)
    return c2w[0, :3, 3] + (centre_spread(c2w) or 1.0) * c2w[0, :3, 2]


def spiral_like(orbit: Cameras, frames: int = 60) -> Cameras:
    """A closed path that winds from an orbit inward and back, with the same size and intrinsics.

    From a circle it winds up to the circle's axis, at the same distance; from a loop or an arc on one side of the subject, in
    to its middle. A pan and a walk have nothing to wind about: the orbit itself.

    Args:
        orbit: as `orbit_like` gives; a path of another shape around a subject counts as the circle it resembles.
        frames: number of poses; the last stops one step short of the first.
    """
    layout = classify_layout(orbit.c2w)
    target = find_convergence(orbit.c2w)
    if layout in (Layout.PAN, Layout.WALK) or target is None:
        return resample_path(orbit, frames, closed=True)
    up = upward(orbit)
    centre = target.to(up)
    offset = orbit.centres - centre
    flat = normalize(offset - (offset @ up)[:, None] * up, dim=1)
    build = wind_up if float(flat.mean(0).norm()) < ONE_SIDED else wind_in
    poses = build(offset, up, frames)
    poses[:, :3, 3] += centre
    return Cameras.of_size(orbit.K[:1].repeat(frames, 1, 1), poses, orbit.width, orbit.height)


def wind_up(offset: Float[Tensor, "V 3"], up: Float[Tensor, "3"], frames: int) -> Float[Tensor, "frames 4 4"]:
    """From a circle around the origin up to its axis and back; looking at the origin."""
    radius = offset.norm(dim=-1).mean()
    mean = offset.mean(0)
    axis = torch.linalg.svd(offset - mean).Vh[2]  # across the circle's plane
    side = mean if mean.norm() > 1e-3 * radius else up  # a circle at the subject's own height has no mean offset
    axis = axis * torch.where(axis @ side < 0, -1.0, 1.0)
    angle = torch.acos((normalize(offset, dim=-1) @ axis).clamp(-1, 1)).mean()
    first = normalize(offset[0] - (offset[0] @ axis) * axis, dim=-1)
    second = torch.linalg.cross(axis, first)
    turn, share = _winding(frames, up)
    slope = angle * share
    around = torch.cos(SPIRAL_TURNS * turn) * first + torch.sin(SPIRAL_TURNS * turn) * second
    return look_at(radius * (torch.sin(slope) * around + torch.cos(slope) * axis), torch.zeros_like(up), up)


def wind_in(offset: Float[Tensor, "V 3"], up: Float[Tensor, "3"], frames: int) -> Float[Tensor, "frames 4 4"]:
    """From a loop on one side of the origin in to its middle and back, at the loop's distance; looking at the origin."""
    middle = normalize(offset, dim=1).mean(0)
    turn, share = _winding(frames, up)
    which = (turn[:, 0] * (SPIRAL_TURNS * len(offset) / (2 * math.pi))).round().long() % len(offset)
    direction = normalize(middle + share * (normalize(offset, dim=1)[which] - middle), dim=1)
    distance = offset.norm(dim=1)[which, None] * share + offset.norm(dim=1).mean() * (1 - share)
    return look_at(distance * direction, torch.zeros_like(up), up)


def _winding(frames: int, like: Tensor) -> tuple[Float[Tensor, "frames 1"], Float[Tensor, "frames 1"]]:
    """Angles of one turn, and how much of the way from the axis to the loop is left at each."""
    turn = torch.arange(frames, dtype=like.dtype, device=like.device)[:, None] * (2 * math.pi / frames)
    return turn, 1 - SPIRAL_CLIMB * (1 - torch.cos(turn)) / 2
