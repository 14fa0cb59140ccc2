"""Camera paths for rendering, near the training cameras: orbit, spiral, and resampling of both."""

import math
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation, Slerp
from torch import Tensor
from torch.nn.functional import normalize

from nerf_lightning.cameras.camera_layout import CameraLayout, center_spread, find_convergence
from nerf_lightning.cameras.cameras import Cameras
from nerf_lightning.cameras.poses import estimate_up, find_typical_view, horizontal_axes, look_at, mean_up

MAX_ELEVATION_RAD = 1.4
"""Largest elevation of a path above or below the horizon."""
AZIMUTH_CONCENTRATION = 4.0
"""Concentration of the von Mises kernel that averages cameras by azimuth: a standard deviation of about 29 degrees."""
MAX_AZIMUTH_GAP_RAD = math.pi / 2
"""Widest gap between azimuths for which cameras still count as a full ring."""
LOOP_QUANTILE = 0.7
"""Quantile of the cameras' offsets that a forward-facing loop spans."""
SPIRAL_TURNS, SPIRAL_CLIMB_FRACTION = 2, 0.75
"""Turns of a spiral, and the fraction of the way to its axis that it covers."""
MIN_ONE_SIDED_MEAN = 0.1
"""Length of the mean direction from subject to views below which a path surrounds it."""


def make_orbit_path(cameras: Cameras, layout: CameraLayout, center: Float[Tensor, "3"], frames: int = 60) -> Cameras:
    """A closed camera path near the training cameras, upright, with the intrinsics of a typical one.

    Inward: a full turn around the subject at the cameras' distance and height, or a swing within the arc that they cover.
    Forward: an ellipse among the cameras, looking at the subject. Pan: a rotation on the spot, as wide as the photos'.
    Walk: along the photos, and back.

    Args:
        cameras: at least one.
        layout: from `classify_layout`.
        center: the subject, for inward and forward layouts.
        frames: number of views; the last stops one step short of the first, so that a loop is smooth.
    """
    c2w = cameras.c2w.double()
    up = estimate_up(c2w)
    centers = c2w[:, :3, 3]
    if layout == CameraLayout.WALK:
        poses = make_walk_path(c2w, up, frames)
    elif layout == CameraLayout.FORWARD:
        poses = make_forward_facing_loop(c2w, center.double(), up, frames)
    elif layout == CameraLayout.PAN:
        spot = centers.median(0).values.expand(frames, 3)
        poses = look_at(spot, spot + make_angular_loop(c2w[:, :3, 2], up, frames)[0], up)
    else:
        direction, weights = make_angular_loop(centers - center, up, frames)
        distance = weights @ (centers - center).norm(dim=1)
        poses = look_at(center + distance[:, None] * direction, center.double(), up)
    lens = cameras[find_typical_view(cameras)].to_pinhole()  # a panorama has no field of view to reuse
    K, (width, height) = lens.K[0], lens.size(0)
    right, down = (lens.c2w[0, :3, axis].double() @ up for axis in (0, 1))
    if abs(right) > abs(down):  # portrait photos, stored in landscape
        K = torch.stack([K[1, [1, 0, 2]], K[0, [1, 0, 2]], K[2]])
        width, height = height, width
    return Cameras.pinhole(K.repeat(frames, 1, 1), poses.to(cameras.c2w), width, height)


def make_angular_loop(
    offset: Float[Tensor, "V 3"], up: Float[Tensor, "3"], frames: int
) -> tuple[Float[Tensor, "frames 3"], Float[Tensor, "frames V"]]:
    """A closed loop of directions: a full turn if offsets point all around, else to and fro; at the local mean elevation.

    Returns:
        Unit vectors, and for each the kernel weights, of sum 1, of the offsets near it.
    """
    direction = normalize(offset, dim=1)
    right, backward = horizontal_axes(up)
    front = -backward
    azimuth = torch.atan2(direction @ right, direction @ front)
    elevation = torch.asin((direction @ up).clamp(-1, 1))
    cos_elevation = elevation.cos() + 1e-3  # a vertical direction has no azimuth

    def kernel_weights(angles: Float[Tensor, "A"]) -> Float[Tensor, "A V"]:
        return cos_elevation * torch.exp(AZIMUTH_CONCENTRATION * (torch.cos(angles[:, None] - azimuth) - 1))

    def mean_elevation(angles: Float[Tensor, "A"]) -> Float[Tensor, "A"]:
        return (normalize(kernel_weights(angles), p=1, dim=1) * elevation).sum(1)

    phase = torch.arange(frames, dtype=up.dtype, device=up.device) * (2 * math.pi / frames)
    ordered = azimuth.sort().values
    gaps = torch.cat([ordered[1:], ordered[:1] + 2 * math.pi]) - ordered
    if float(gaps.max()) < MAX_AZIMUTH_GAP_RAD:
        angles = azimuth[0] + phase
        pitch = mean_elevation(angles)
    else:
        first = int(gaps.argmax()) + 1
        ordered = torch.cat([ordered[first:], ordered[:first] + 2 * math.pi])
        arcs = ordered.tensor_split(((ordered.diff() >= MAX_AZIMUTH_GAP_RAD).nonzero()[:, 0] + 1).tolist())
        arc = max(arcs, key=len)
        angles = arc[0] + (arc[-1] - arc[0]) / 2 * (1 + torch.cos(phase))
        swing = (elevation - mean_elevation(azimuth)).abs().quantile(LOOP_QUANTILE)
        pitch = mean_elevation(angles) + swing * torch.sin(phase)
    pitch = pitch.clamp(-MAX_ELEVATION_RAD, MAX_ELEVATION_RAD)
    horizontal = torch.cos(angles)[:, None] * front + torch.sin(angles)[:, None] * right
    directions = torch.cos(pitch)[:, None] * horizontal + torch.sin(pitch)[:, None] * up
    return directions, normalize(kernel_weights(angles), p=1, dim=1)


def make_forward_facing_loop(
    c2w: Float[Tensor, "V 4 4"], center: Float[Tensor, "3"], up: Float[Tensor, "3"], frames: int
) -> Float[Tensor, "frames 4 4"]:
    """An ellipse in the image plane of forward-facing cameras, spanning most of their centers."""
    middle = c2w[:, :3, 3].mean(0)
    offset = c2w[:, :3, 3] - middle
    forward = normalize(c2w[:, :3, 2].mean(0), dim=0)
    right, down = look_at(middle, middle + forward, up)[:3, :2].unbind(1)
    axes = torch.stack([offset @ right, offset @ down], dim=1).abs().quantile(LOOP_QUANTILE, dim=0)
    phase = torch.arange(frames, dtype=up.dtype, device=up.device) * (2 * math.pi / frames)
    ellipse = axes * torch.stack([torch.cos(phase), torch.sin(phase)], dim=1)
    eye = middle + ellipse[:, :1] * right + ellipse[:, 1:] * down
    return look_at(eye, center, up)


def make_walk_path(c2w: Float[Tensor, "V 4 4"], up: Float[Tensor, "3"], frames: int) -> Float[Tensor, "frames 4 4"]:
    """A smooth path along the photos in their order: closed if they end where they began, else there and back."""
    count = len(c2w)
    steps = (c2w[1:, :3, 3] - c2w[:-1, :3, 3]).norm(dim=1)
    is_closed = float((c2w[0, :3, 3] - c2w[-1, :3, 3]).norm()) < 2 * float(steps.mean())
    progress = torch.arange(frames, dtype=c2w.dtype, device=c2w.device) / frames
    positions = (count - 1) * (progress if is_closed else 1 - (1 - 2 * progress).abs())
    width = max(1.0, count / 20)
    weights = torch.exp(-0.5 * ((positions[:, None] - torch.arange(count).to(positions)) / width).square())
    weights = weights / weights.sum(1, keepdim=True)
    eye, forward = weights @ c2w[:, :3, 3], weights @ c2w[:, :3, 2]
    nearest = c2w[positions.round().long(), :3, 2]  # for where opposite directions cancel out
    forward = normalize(torch.where(forward.norm(dim=1, keepdim=True) > 0.05, forward, nearest), dim=1)
    return look_at(eye, eye + forward, up)


def resample_path(cameras: Cameras, frames: int, closed: bool) -> Cameras:
    """Resamples a camera path to a number of views: a subset of its own, or interpolated ones.

    Args:
        cameras: the path.
        frames: number of views.
        closed: True if the last view connects to the first.
    """
    count = len(cameras)
    if frames <= count or count < 2:
        return cameras[((torch.arange(min(frames, count)) + 0.5) * (count / min(frames, count)) - 0.5).round().long()]
    positions = np.arange(frames) * (count / frames) if closed else np.linspace(0, count - 1, frames)
    loop = torch.arange(count + closed) % count
    c2w = cameras.c2w[loop].double().numpy()
    rotations = Slerp(np.arange(len(loop)), Rotation.from_matrix(c2w[:, :3, :3]))(positions).as_matrix()
    translations = np.stack([np.interp(positions, np.arange(len(loop)), c2w[:, i, 3]) for i in range(3)], axis=-1)
    poses = torch.eye(4).repeat(frames, 1, 1)
    poses[:, :3, :3] = torch.from_numpy(rotations)
    poses[:, :3, 3] = torch.from_numpy(translations)
    lower = torch.from_numpy(positions.astype(int))
    fraction = torch.from_numpy(positions - positions.astype(int)).float()[:, None, None]
    K = cameras.K[loop]
    upper = (lower + 1).clamp_max(len(loop) - 1)
    return Cameras.pinhole(K[lower] * (1 - fraction) + K[upper] * fraction, poses, cameras.width, cameras.height)


def find_pivot(path: Cameras) -> Float[Tensor, "3"]:
    """Pivot of a viewer that starts at a path's first view: the subject, or a point ahead if there is none."""
    c2w = path.c2w
    if (target := find_convergence(c2w)) is not None:
        return target.to(c2w)
    return c2w[0, :3, 3] + (center_spread(c2w) or 1.0) * c2w[0, :3, 2]


def start_at_middle(path: Cameras) -> Cameras:
    """Rotates a closed path to begin at its medoid: the view nearest to all others in position and direction."""
    centers = path.centers.double() / (center_spread(path.c2w) or 1.0)
    poses = torch.cat([centers, path.c2w[:, :3, 2].double()], dim=1)
    first = int(torch.cdist(poses, poses).mean(1).argmin())
    return path[(torch.arange(len(path)) + first) % len(path)]


def make_spiral_path(orbit: Cameras, frames: int = 60) -> Cameras:
    """A closed spiral from an orbit inward and back, with the orbit's size and intrinsics.

    It winds to the mean of the orbit's directions (for a circle, above the subject) at the same distance. Pans and walks
    have no subject: the orbit itself.

    Args:
        orbit: from `make_orbit_path`, or any path around a subject.
        frames: number of poses; the last stops one step short of the first.
    """
    target = find_convergence(orbit.c2w)
    if target is None:
        return resample_path(orbit, frames, closed=True)
    index = torch.arange(frames)
    loop = resample_path(orbit, frames, closed=True)[SPIRAL_TURNS * index % frames]
    up = mean_up(orbit)
    center = target.to(up)
    distance, direction = (loop.centers - center).norm(dim=1, keepdim=True), normalize(loop.centers - center, dim=1)
    mean_direction = direction.mean(0)
    axis = normalize(mean_direction, dim=0) if float(mean_direction.norm()) > MIN_ONE_SIDED_MEAN else up
    ratio = 1 - SPIRAL_CLIMB_FRACTION * (1 - torch.cos(index.to(up) * (2 * math.pi / frames)))[:, None] / 2
    blended = (1 - ratio) * axis + ratio * direction
    eye = center + normalize(blended, dim=1) * (ratio * distance + (1 - ratio) * distance.mean())
    return replace(loop, c2w=look_at(eye, center, up))
