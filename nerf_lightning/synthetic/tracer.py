"""Ray tracer of solids: exact color, alpha and depth."""

import functools
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8

from nerf_lightning.cameras import Cameras, look_at
from nerf_lightning.kernels.cpu import solids as fast
from nerf_lightning.synthetic.solids import Solids, load_bulldozer

SUPERSAMPLING = 3  # samples along each side of a pixel
SHADOW_MAP_SIZE_PX = 1536


def rasterize(solids: Solids, cameras: Cameras, view: int) -> tuple[Int[np.ndarray, "H W"], Float[np.ndarray, "H W"]]:
    """Index of the first solid at each pixel center (-1 for none) and its depth along the camera's z axis (inf for none).

    Each solid is intersected only within its projected bounding box; all of it must lie in front of the camera.
    """
    K, c2w = (matrix[view].double().numpy() for matrix in (cameras.K, cameras.c2w))
    # In a solid's frame pixel (u, v) has direction lift @ (u, v, 1): linear in rows and columns.
    lift = (solids.to_unit @ c2w[:3, :3] @ np.linalg.inv(K)).astype(np.float32)
    eye = np.einsum("pij,pj->pi", solids.to_unit, c2w[:3, 3] - solids.center).astype(np.float32)
    signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, 8).T
    corners = solids.center[:, None] + (signs * solids.half_size[:, None]) @ solids.axes
    corners = (corners - c2w[:3, 3]) @ c2w[:3, :3] @ K.T
    pixels = corners[..., :2] / corners[..., 2:]
    size = cameras.width, cameras.height
    first, last = np.floor(pixels.min(1) - 0.5).clip(0, size), np.ceil(pixels.max(1) + 0.5).clip(0, size)
    solid = np.full(size[::-1], -1, np.int32)
    depth = np.full(size[::-1], np.inf, np.float32)
    fast.rasterize(solids.is_cylinder, lift, eye, first.astype(int), last.astype(int), solid, depth)
    return solid, depth


class ShadowMap(NamedTuple):
    """First solid and depth as seen from the key light."""

    rotation: Float[np.ndarray, "3 3"]
    focal: float
    solid: Int[np.ndarray, "S S"]
    depth: Float[np.ndarray, "S S"]


def make_shadow_map(solids: Solids, radius: float) -> ShadowMap:
    """Makes the shadow map that covers a sphere around the origin, world units."""
    light = np.array(fast.LIGHT_POSITION, float)
    c2w = look_at(torch.from_numpy(light).float(), torch.zeros(3), torch.tensor([0.0, 0.0, 1.0]))
    focal = SHADOW_MAP_SIZE_PX / 2 * float(np.sqrt(light @ light - radius**2)) / radius
    center = SHADOW_MAP_SIZE_PX / 2
    K = torch.tensor([[focal, 0, center], [0, focal, center], [0, 0, 1]])
    cameras = Cameras.pinhole(K[None], c2w[None], SHADOW_MAP_SIZE_PX, SHADOW_MAP_SIZE_PX)
    return ShadowMap(c2w[:3, :3].numpy(), focal, *rasterize(solids, cameras, 0))


@functools.cache
def render_shadow_map() -> ShadowMap:
    """Renders the bulldozer's shadow map."""
    solids = load_bulldozer()
    return make_shadow_map(solids, float(np.linalg.norm(solids.aabb, axis=1).max()))


def render_view(
    cameras: Cameras, view: int, solids: Solids | None = None, shadow: ShadowMap | None = None
) -> UInt8[np.ndarray, "H W 4"]:
    """Renders a view of solids with their shadow map, by default the bulldozer: sRGB and straight alpha, supersampled."""
    fine, solids, shadow = cameras.rescale(SUPERSAMPLING), solids or load_bulldozer(), shadow or render_shadow_map()
    rgba = np.zeros((cameras.height, cameras.width, 4), np.uint8)
    K, c2w = fine.K[view].numpy(), fine.c2w[view].numpy()
    fast.shade(solids.to_float32(), shadow, K, c2w, *rasterize(solids, fine, view), rgba)
    return rgba
