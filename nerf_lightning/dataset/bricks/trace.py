"""The ray tracer of the built-in scene: exact colour, alpha and depth of convex solids.

Pictures are traced solid by solid: only the rectangle of pixels that a solid's bounding box projects to is intersected,
and the nearest hit of each pixel wins. `trace` takes any rays and serves as ground truth.
"""

import functools

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from nerf_lightning.cameras import Cameras, Rays, look_at
from nerf_lightning.dataset.bricks.model import bulldozer
from nerf_lightning.dataset.bricks.shading import LIGHT, Lit, shade
from nerf_lightning.dataset.bricks.solids import Solids

SUPERSAMPLING = 3
"""Samples a pixel along each side."""
BATCH = 1 << 15
"""Ray-solid pairs intersected at once: as many as stay in a core's cache."""
SHADOW_SIZE = 1536
SHADOW_BIAS = 0.01
"""World units a surface may lie behind the shadow map: more than the slope of a texel, less than a stud."""


def trace(rays: Rays) -> tuple[Float[Tensor, "R 3"], Bool[Tensor, "R"], Float[Tensor, "R"]]:
    """Traces any rays against the bulldozer.

    A surface counts where a ray enters a solid; a ray that starts inside one does not see that one.

    Returns:
        sRGB in [0, 1] (black where missed), whether anything was hit, and the distance along the unit ray (inf where
        missed).
    """
    solids = bulldozer()
    rgb = torch.zeros(len(rays), 3)
    depth = torch.full((len(rays),), torch.inf)
    for part in torch.arange(len(rays)).split(BATCH):
        origins, directions = (x[part].double().cpu().numpy() for x in (rays.origins, rays.directions))
        solid, t = nearest(solids, origins, directions)
        hit = np.flatnonzero(solid >= 0)
        points = origins[hit] + t[hit, None] * directions[hit]
        rgb[part[hit]] = torch.from_numpy(shade(solids, solid[hit], points, directions[hit], shadow()))
        depth[part] = torch.from_numpy(t).float()
    rgb, depth = rgb.to(rays.origins.device), depth.to(rays.origins.device)
    return rgb, depth.isfinite(), depth


def nearest(
    solids: Solids, origins: Float[np.ndarray, "R 3"], directions: Float[np.ndarray, "R 3"], cull: bool = True
) -> tuple[Int[np.ndarray, "R"], Float[np.ndarray, "R"]]:
    """The first solid each ray enters (-1 for none) and the distance to it in lengths of `directions` (inf for none).

    `cull` tests each solid's bounding sphere first; the answer is the same without, but slower.
    """
    solid = np.full(len(origins), -1)
    t = np.full(len(origins), np.inf)
    to_unit = solids.to_unit
    squares = (directions**2).sum(-1)
    reach = (solids.half**2).sum(-1) * 1.0001
    for k in range(len(solids)):
        offset = origins - solids.centre[k]
        ray = np.arange(len(origins))
        if cull:
            gap = (offset**2).sum(-1) - (offset * directions).sum(-1) ** 2 / squares
            ray = np.flatnonzero(gap <= reach[k])
        distance = _enter(to_unit[k] @ offset[ray].T, to_unit[k] @ directions[ray].T, bool(solids.cylinder[k]))
        closer = distance < t[ray]
        solid[ray[closer]], t[ray[closer]] = k, distance[closer]
    return solid, t


def _enter(
    o: Float[np.ndarray, "3 *#batch"], d: Float[np.ndarray, "3 *#batch"], cylinder: bool
) -> Float[np.ndarray, "*batch"]:
    """The t at which rays o + t * d, in the solid's own frame, enter the unit cube or cylinder; inf where they do not."""
    # A ray along a face divides by zero: infinities do the right thing, and the nan of one inside a face compares false.
    with np.errstate(divide="ignore", invalid="ignore"):
        near, far = _slab(o[2], d[2])
        if cylinder:
            # A ray along the axis has no crossing to solve for: tilt it by less than single precision can see.
            dx, dy = np.where(np.abs(d[0]) + np.abs(d[1]) < 1e-6, d.dtype.type(1e-6), d[0]), d[1]
            a = dx * dx + dy * dy
            # Distance from the axis by the cross product: small numbers stay small where b^2 - ac would cancel.
            cross = o[0] * dy - o[1] * dx
            chord = np.sqrt(a - cross * cross)  # nan, hence a miss, where the ray passes by
            middle = -(o[0] * dx + o[1] * dy)
            near = np.maximum(near, (middle - chord) / a)
            far = np.minimum(far, (middle + chord) / a)
        else:
            for k in range(2):
                low, high = _slab(o[k], d[k])
                near, far = np.maximum(near, low), np.minimum(far, high)
        return np.where((near < far) & (near > 0), near, np.inf)


def _slab(o: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Distances at which rays cross -1 and 1 along one axis, the nearer first."""
    inverse = 1 / d
    low, high = (-1 - o) * inverse, (1 - o) * inverse
    return np.minimum(low, high), np.maximum(low, high)


def visible(
    solids: Solids, cameras: Cameras, view: int, cull: bool = True
) -> tuple[Int[np.ndarray, "H W"], Float[np.ndarray, "H W"]]:
    """The solid seen at each pixel centre of a view (-1 for none) and its depth along the camera's z axis (inf for none).

    `cull` intersects each solid only where its bounding box projects to; all of it must lie before the camera.
    """
    width, height = cameras.width, cameras.height
    K = cameras.K[view].double().numpy()
    c2w = cameras.c2w[view].double().numpy()
    # A solid's own frame sees pixel (u, v) along lift @ (u, v, 1), so that rows and columns just add up.
    lift = (solids.to_unit @ c2w[:3, :3] @ np.linalg.inv(K)).astype(np.float32)
    eye = np.einsum("pij,pj->pi", solids.to_unit, c2w[:3, 3] - solids.centre).astype(np.float32)
    left, top, wide, high = _rectangles(solids, K, c2w, width, height)
    if not cull:
        left, top, wide, high = 0 * left, 0 * top, 0 * wide + width, 0 * high + height

    # One integer a pixel: the depth's bits above the solid's number. Positive floats sort like their bits, so the least
    # integer is the nearest hit, and ties go to the lower number whatever the order.
    nearest_key = np.full(height * width, np.iinfo(np.int64).max)
    groups, member = np.unique(np.stack([solids.cylinder, wide, high]), axis=1, return_inverse=True)
    for g, (cylinder, w, h) in enumerate(groups.T):
        members, length = np.flatnonzero(member == g), max(1, BATCH // (w * h))
        for some in (members[k : k + length] for k in range(0, len(members), length)):
            u = (left[some, None] + np.arange(w) + 0.5).astype(np.float32)
            v = (top[some, None] + np.arange(h) + 0.5).astype(np.float32)
            m = lift[some].transpose(1, 2, 0)[..., None]
            d = (m[:, 0] * u)[:, :, None, :] + (m[:, 1] * v + m[:, 2])[:, :, :, None]
            depth = _enter(eye[some].T[:, :, None, None], d, bool(cylinder))
            hit = np.flatnonzero(depth < np.inf)
            which, row, col = np.unravel_index(hit, depth.shape)
            pixel = (top[some][which] + row) * width + left[some][which] + col
            key = (depth.reshape(-1)[hit].view(np.int32).astype(np.int64) << 32) | some[which]
            np.minimum.at(nearest_key, pixel, key)
    seen = nearest_key != np.iinfo(np.int64).max
    solid = np.where(seen, nearest_key & 0xFFFFFFFF, -1)
    depth = np.where(seen, (nearest_key >> 32).astype(np.int32).view(np.float32), np.float32(np.inf))
    return solid.reshape(height, width), depth.reshape(height, width)


def _rectangles(solids: Solids, K: np.ndarray, c2w: np.ndarray, width: int, height: int) -> tuple[np.ndarray, ...]:
    """Left, top, width and height [P] of the pixels each solid may cover; sizes are rounded up to a few, to batch them."""
    corners = (solids.corners - c2w[:3, 3]) @ c2w[:3, :3] @ K.T
    place = corners[..., :2] / corners[..., 2:]
    sides = []
    for low, high, limit in zip(place.min(1).T, place.max(1).T, (width, height), strict=True):
        low = np.clip(np.floor(low - 0.5), 0, limit - 1).astype(int)
        high = np.clip(np.ceil(high + 0.5), 1, limit).astype(int)
        size = np.maximum(high - low, 1)
        step = np.where(size > 48, 16, 4)
        size = np.minimum(-(-size // step) * step, limit)
        sides.append((np.minimum(low, limit - size), size))
    (left, wide), (top, high) = sides
    return left, top, wide, high


@functools.cache
def shadow() -> Lit:
    """The shadow test of the key light, by a depth map seen from it."""
    solids = bulldozer()
    light = torch.from_numpy(LIGHT).float()
    c2w = look_at(light, torch.zeros(3), torch.tensor([0.0, 0.0, 1.0]))
    reach = float(np.linalg.norm(solids.aabb, axis=1).max())
    focal = SHADOW_SIZE / 2 * float(np.sqrt(LIGHT @ LIGHT - reach**2)) / reach
    centre = SHADOW_SIZE / 2
    K = torch.tensor([[focal, 0, centre], [0, focal, centre], [0, 0, 1]])
    first, depth = visible(solids, Cameras.of_size(K[None], c2w[None], SHADOW_SIZE, SHADOW_SIZE), 0)
    rotation = c2w[:3, :3].numpy()

    def lit(solid: Int[np.ndarray, "N"], points: Float[np.ndarray, "N 3"]) -> Bool[np.ndarray, "N"]:
        offset = points - LIGHT.astype(points.dtype)
        x, y, z = (offset[:, 0] * a[0] + offset[:, 1] * a[1] + offset[:, 2] * a[2] for a in rotation.T)
        col = np.clip(focal * x / z + centre, 0, SHADOW_SIZE - 1).astype(np.int64)
        row = np.clip(focal * y / z + centre, 0, SHADOW_SIZE - 1).astype(np.int64)
        # A convex solid never shadows its own lit side, so the same solid in the map needs no bias at all.
        return (first[row, col] == solid) | (z <= depth[row, col] + SHADOW_BIAS)

    return lit


def picture(cameras: Cameras, view: int) -> UInt8[np.ndarray, "H W 4"]:
    """One view of the bulldozer: sRGB and straight alpha, each pixel the mean of a grid of samples."""
    solids, n = bulldozer(), SUPERSAMPLING
    width, height = cameras.width, cameras.height
    fine = cameras.scaled(n)
    solid, depth = (x.reshape(-1) for x in visible(solids, fine, view))
    hit = np.flatnonzero(solid >= 0)
    K, c2w = fine.K[view].numpy(), fine.c2w[view].numpy()
    x = (hit % fine.width + np.float32(0.5) - K[0, 2]) / K[0, 0]
    y = (hit // fine.width + np.float32(0.5) - K[1, 2]) / K[1, 1]
    rays = np.stack([x * c2w[k, 0] + y * c2w[k, 1] + c2w[k, 2] for k in range(3)], axis=-1).astype(np.float32)
    points = c2w[:3, 3] + depth[hit, None] * rays
    directions = rays / np.sqrt(x * x + y * y + 1).astype(np.float32)[:, None]
    rgb = shade(solids, solid[hit], points, directions, shadow())

    # Averaged in sRGB, as a field's renderer composites it, over the samples that hit: alpha says how many did.
    pixel = (hit // fine.width // n) * width + hit % fine.width // n
    count = np.bincount(pixel, minlength=height * width)
    total = np.stack([np.bincount(pixel, rgb[:, k], minlength=height * width) for k in range(3)], axis=-1)
    mean = total / np.maximum(count, 1)[:, None]
    rgba = np.concatenate([mean, count[:, None] / n**2], axis=-1)
    return np.round(rgba * 255).astype(np.uint8).reshape(height, width, 4)
