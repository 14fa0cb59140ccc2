"""Camera paths to show a scene along, which stay where photos were taken."""

import math
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation, Slerp
from torch import Tensor
from torch.nn.functional import normalize

from nerf_lightning.cameras.camera_layout import CameraLayout, centre_spread, find_convergence
from nerf_lightning.cameras.cameras import Cameras
from nerf_lightning.cameras.poses import estimate_up, find_typical_view, horizontal_axes, look_at, mean_up

MAX_ELEVATION_RAD = 1.4
"""Largest angle of a path above or below the horizon, radians."""
AZIMUTH_CONCENTRATION = 4.0
"""Concentration of the kernel (von Mises) that averages cameras by azimuth: a standard deviation of about 29 degrees."""
MAX_AZIMUTH_GAP_RAD = math.pi / 2
"""Widest gap between the azimuths of cameras all around, radians."""
LOOP_QUANTILE = 0.7
"""Share of the views that lie within a loop before the subject."""
SPIRAL_TURNS, SPIRAL_CLIMB_FRACTION = 2, 0.75
"""Turns of a spiral, and how much of the way to its axis it climbs."""
MIN_ONE_SIDED_MEAN = 0.1
"""Mean of the unit vectors from a subject to a path's views below which they are all around it."""


def make_orbit_path(cameras: Cameras, layout: CameraLayout, centre: Float[Tensor, "3"], frames: int = 60) -> Cameras:
    """A closed path that shows what `cameras` show from where they stood, upright, with the lens of a typical one.

    Inward: a full turn at the cameras' distance and height, looking at the subject, or a swing within the arc that they cover.
    Forward: an ellipse among the cameras, looking at the subject. Pan: a turn on the spot, as far as the photos. Walk: along
    the photos, and back.

    Args:
        cameras: at least one.
        layout: of the cameras.
        centre: the subject, for inward and forward cameras.
        frames: number of views; the last stops one step short of the first, so that a loop is smooth.
    """
    c2w = cameras.c2w.double()
    up = estimate_up(c2w)
    centres = c2w[:, :3, 3]
    if layout == CameraLayout.WALK:
        poses = make_walk_path(c2w, up, frames)
    elif layout == CameraLayout.FORWARD:
        poses = make_forward_facing_loop(c2w, centre.double(), up, frames)
    elif layout == CameraLayout.PAN:
        spot = centres.median(0).values.expand(frames, 3)
        poses = look_at(spot, spot + make_angular_loop(c2w[:, :3, 2], up, frames)[0], up)
    else:
        direction, weights = make_angular_loop(centres - centre, up, frames)
        distance = weights @ (centres - centre).norm(dim=1)
        poses = look_at(centre + distance[:, None] * direction, centre.double(), up)
    lens = cameras[find_typical_view(cameras)].to_pinhole()  # photos of all directions have no view to repeat
    K, (width, height) = lens.K[0], lens.size(0)
    right, down = (lens.c2w[0, :3, axis].double() @ up for axis in (0, 1))
    if abs(right) > abs(down):  # the camera was held on its side, and the photo is stored so
        K = torch.stack([K[1, [1, 0, 2]], K[0, [1, 0, 2]], K[2]])
        width, height = height, width
    return Cameras.pinhole(K.repeat(frames, 1, 1), poses.to(cameras.c2w), width, height)


def make_angular_loop(
    offset: Float[Tensor, "V 3"], up: Float[Tensor, "3"], frames: int
) -> tuple[Float[Tensor, "frames 3"], Float[Tensor, "frames V"]]:
    """A closed loop of directions: a full turn where vectors point all around, else to and fro between the outermost, at the
    mean elevation of those around.

    Returns:
        Unit vectors; and for each the weights, of sum 1, of the vectors that are around it.
    """
    direction = normalize(offset, dim=1)
    right, backward = horizontal_axes(up)
    front = -backward
    azimuth = torch.atan2(direction @ right, direction @ front)
    elevation = torch.asin((direction @ up).clamp(-1, 1))
    level = elevation.cos() + 1e-3  # what points straight up has no azimuth

    def kernel_weights(at: Float[Tensor, "A"]) -> Float[Tensor, "A V"]:
        return level * torch.exp(AZIMUTH_CONCENTRATION * (torch.cos(at[:, None] - azimuth) - 1))

    def mean_elevation(at: Float[Tensor, "A"]) -> Float[Tensor, "A"]:
        return (normalize(kernel_weights(at), p=1, dim=1) * elevation).sum(1)

    turn = torch.arange(frames, dtype=up.dtype, device=up.device) * (2 * math.pi / frames)
    in_order = azimuth.sort().values
    gaps = torch.cat([in_order[1:], in_order[:1] + 2 * math.pi]) - in_order
    if float(gaps.max()) < MAX_AZIMUTH_GAP_RAD:
        at = azimuth[0] + turn
        above = mean_elevation(at)
    else:
        first = int(gaps.argmax()) + 1
        in_order = torch.cat([in_order[first:], in_order[:first] + 2 * math.pi])
        arcs = in_order.tensor_split(((in_order.diff() >= MAX_AZIMUTH_GAP_RAD).nonzero()[:, 0] + 1).tolist())
        arc = max(arcs, key=len)
        at = arc[0] + (arc[-1] - arc[0]) / 2 * (1 + torch.cos(turn))
        above = mean_elevation(at) + (elevation - mean_elevation(azimuth)).abs().quantile(LOOP_QUANTILE) * torch.sin(
            turn
        )
    above = above.clamp(-MAX_ELEVATION_RAD, MAX_ELEVATION_RAD)
    flat = torch.cos(at)[:, None] * front + torch.sin(at)[:, None] * right
    return torch.cos(above)[:, None] * flat + torch.sin(above)[:, None] * up, normalize(kernel_weights(at), p=1, dim=1)


def make_forward_facing_loop(
    c2w: Float[Tensor, "V 4 4"], centre: Float[Tensor, "3"], up: Float[Tensor, "3"], frames: int
) -> Float[Tensor, "frames 4 4"]:
    """An ellipse across the view of forward-facing cameras, around most of their centres."""
    middle = c2w[:, :3, 3].mean(0)
    offset = c2w[:, :3, 3] - middle
    ahead = normalize(c2w[:, :3, 2].mean(0), dim=0)
    first, second = look_at(middle, middle + ahead, up)[:3, :2].unbind(1)  # to the right and down
    axes = torch.stack([offset @ first, offset @ second], dim=1).abs().quantile(LOOP_QUANTILE, dim=0)
    turn = torch.arange(frames, dtype=up.dtype, device=up.device) * (2 * math.pi / frames)
    at = axes * torch.stack([torch.cos(turn), torch.sin(turn)], dim=1)
    eye = middle + at[:, :1] * first + at[:, 1:] * second
    return look_at(eye, centre, up)


def make_walk_path(c2w: Float[Tensor, "V 4 4"], up: Float[Tensor, "3"], frames: int) -> Float[Tensor, "frames 4 4"]:
    """Smoothly from photo to photo in their order; round, or there and back."""
    count = len(c2w)
    steps = (c2w[1:, :3, 3] - c2w[:-1, :3, 3]).norm(dim=1)
    is_round = float((c2w[0, :3, 3] - c2w[-1, :3, 3]).norm()) < 2 * float(steps.mean())
    progress = torch.arange(frames, dtype=c2w.dtype, device=c2w.device) / frames
    at = (count - 1) * (progress if is_round else 1 - (1 - 2 * progress).abs())
    width = max(1.0, count / 20)
    weights = torch.exp(-0.5 * ((at[:, None] - torch.arange(count).to(at)) / width).square())
    weights = weights / weights.sum(1, keepdim=True)
    eye, ahead = weights @ c2w[:, :3, 3], weights @ c2w[:, :3, 2]
    nearest = c2w[at.round().long(), :3, 2]  # where opposite directions cancel out
    ahead = normalize(torch.where(ahead.norm(dim=1, keepdim=True) > 0.05, ahead, nearest), dim=1)
    return look_at(eye, eye + ahead, up)


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
    return Cameras.pinhole(K[below] * (1 - part) + K[after] * part, poses, cameras.width, cameras.height)


def find_pivot(path: Cameras) -> Float[Tensor, "3"]:
    """What a viewer turns about that starts at a path's first view: the subject, or a place ahead where there is none."""
    c2w = path.c2w
    if (target := find_convergence(c2w)) is not None:
        return target.to(c2w)
    return c2w[0, :3, 3] + (centre_spread(c2w) or 1.0) * c2w[0, :3, 2]


def make_spiral_path(orbit: Cameras, frames: int = 60) -> Cameras:
    """A closed path that winds from an orbit inward and back, with the same size and intrinsics.

    It winds to the middle of the orbit's directions, which is above the subject for a circle, at the same distance. A pan and
    a walk have nothing to wind about: the orbit itself.

    Args:
        orbit: as `make_orbit_path` gives; a path of another shape around a subject counts as the circle it resembles.
        frames: number of poses; the last stops one step short of the first.
    """
    target = find_convergence(orbit.c2w)
    if target is None:
        return resample_path(orbit, frames, closed=True)
    number = torch.arange(frames)
    loop = resample_path(orbit, frames, closed=True)[SPIRAL_TURNS * number % frames]
    up = mean_up(orbit)
    centre = target.to(up)
    distance, direction = (loop.centres - centre).norm(dim=1, keepdim=True), normalize(loop.centres - centre, dim=1)
    middle = direction.mean(0)
    axis = normalize(middle, dim=0) if float(middle.norm()) > MIN_ONE_SIDED_MEAN else up
    ratio = 1 - SPIRAL_CLIMB_FRACTION * (1 - torch.cos(number.to(up) * (2 * math.pi / frames)))[:, None] / 2
    between = (1 - ratio) * axis + ratio * direction
    eye = centre + normalize(between, dim=1) * (ratio * distance + (1 - ratio) * distance.mean())
    return replace(loop, c2w=look_at(eye, centre, up))
