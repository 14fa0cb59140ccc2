"""Renders benchmark objects: textured, mirroring and translucent parts under a sky, with shadows."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from numba import prange

from benchmarks.synthetic.parts import BALL, BOX, CYLINDER, Part
from nerf_lightning.cameras import Cameras, look_at
from nerf_lightning.kernels.cpu.jit import jit, kernel
from nerf_lightning.kernels.cpu.solids import dot, entry_distance, subtract, transform
from nerf_lightning.synthetic.objects import make_hemisphere_cameras, make_pinhole_cameras

SUPERSAMPLING = 3  # rays along each side of a pixel
NUM_LIGHTS, SHADOW_MAP_SIZE_PX, SHADOW_BIAS = 32, 640, 0.015
"""Directions that light comes from besides the sun's, each with a shadow map; bias in world units."""
LIGHT_DISTANCE, REACH = 40.0, 1.75
"""Distance of the lights from the origin, and half-size of what their maps cover, world units."""
SUN = torch.tensor([0.45, -0.35, 0.82])
SUN_RADIANCE, SKY_RADIANCE, AMBIENT = (0.75, 0.72, 0.66), 0.45, 0.08
LAMPS = (((0.45, -0.35, 0.82), 90, 6), ((-0.8, 0.3, 0.5), 25, 1.4), ((0.2, 0.9, 0.3), 60, 1.4))
"""Lamps in the sky that mirrors show: spherical Gaussians with direction, sharpness and radiance."""


class Layer(NamedTuple):
    """Nearest part at each pixel (-1: none), and where its ray enters and leaves it, along the camera's z axis."""

    part: Int[np.ndarray, "H W"]
    near: Float[np.ndarray, "H W"]
    far: Float[np.ndarray, "H W"]


@jit
def enter(shape, o, d):
    """Entry distance of the ray o + t * d into a unit shape, from outside; inf for a miss."""
    if shape != BALL:
        return entry_distance(shape == CYLINDER, o, d)
    a, b = dot(d, d), dot(o, d)
    root = b * b - a * (dot(o, o) - 1)
    return (-b - np.sqrt(root)) / a if root > 0 else np.inf


@kernel
def rasterize(shape, chosen, origin, lift, first, last, index, near, far, workers):
    """Writes a `Layer` of the chosen parts; `lift` maps (u, v, 1) to directions in each unit frame."""
    height = len(near)
    for worker in prange(workers):
        top, bottom = height * worker // workers, height * (worker + 1) // workers
        for k in chosen:
            o = (origin[k, 0], origin[k, 1], origin[k, 2])
            for row in range(max(top, first[k, 1]), min(bottom, last[k, 1])):
                for col in range(first[k, 0], last[k, 0]):
                    x, y, z = transform(lift[k], (col + 0.5, row + 0.5, 1.0))
                    t = enter(shape[k], o, (x, y, z))
                    if t < near[row, col]:
                        s = 2 * LIGHT_DISTANCE  # from beyond the part back to it
                        back = enter(shape[k], (o[0] + s * x, o[1] + s * y, o[2] + s * z), (-x, -y, -z))
                        index[row, col], near[row, col], far[row, col] = k, t, s - back


@kernel
def gather_light(points, normals, mirrors, K, c2w, radiance, depth, light, openness, workers):
    """Adds the lights seen from points to `light`, and writes how much of the sky the mirror directions see."""
    for worker in prange(workers):
        for i in range(len(points) * worker // workers, len(points) * (worker + 1) // workers):
            seen, total = 0.0, 1e-9
            for k in range(len(radiance)):
                eye = (c2w[k, 0, 3], c2w[k, 1, 3], c2w[k, 2, 3])
                x, y, z = transform(c2w[k].T, subtract(points[i], eye))
                row, col = int(K[1, 2] + K[1, 1] * y / z), int(K[0, 2] + K[0, 0] * x / z)
                is_lit = z <= depth[k, row, col] + SHADOW_BIAS
                lambert = max(dot(normals[i], eye) / LIGHT_DISTANCE, 0.0) * is_lit
                for channel in range(3):
                    light[i, channel] += lambert * radiance[k, channel]
                weight = np.exp(10 * (dot(mirrors[i], eye) / LIGHT_DISTANCE - 1))
                seen, total = seen + weight * is_lit, total + weight
            openness[i] = seen / total


def look_up_sky(d: Float[np.ndarray, "N 3"], sharpness: Float[np.ndarray, "N"]) -> Float[np.ndarray, "N 3"]:
    """Radiance from a direction, blurred by a spherical Gaussian."""
    up = 1 / (1 + np.exp(-12 * sharpness / (12 + sharpness) * d[:, 2]))
    radiance = 0.12 + up[:, None] * np.array([0.30, 0.34, 0.42])
    for axis, peak, strength in LAMPS:
        blurred = peak * sharpness / (peak + sharpness)
        radiance += (strength * blurred / peak * np.exp(blurred * (d @ axis / np.linalg.norm(axis) - 1)))[:, None]
    return radiance


class Tracer:
    """Traces parts in the light of the upper hemisphere and of a sun."""

    def __init__(self, parts: Sequence[Part]):
        shape, center, axes, materials = zip(*parts, strict=True)
        self.shape, self.center, self.axes = np.array(shape), np.array(center, float), np.array(axes, float)
        self.to_unit = np.linalg.inv(self.axes)
        self.color = np.array([material.color for material in materials])
        self.surface = np.array([material[1:5] for material in materials]).T
        self.absorption = np.array([material.absorption for material in materials])
        sky = make_hemisphere_cameras(NUM_LIGHTS, 1, distance=LIGHT_DISTANCE).c2w
        sun = look_at(LIGHT_DISTANCE * SUN[None] / SUN.norm(), torch.zeros(3), torch.tensor([0.0, 0.0, 1.0]))
        size = SHADOW_MAP_SIZE_PX
        self.lights = make_pinhole_cameras(torch.cat([sky, sun]), size, size, 2 * REACH / LIGHT_DISTANCE)
        eyes = sky[:, :3, 3].double().numpy() / LIGHT_DISTANCE
        self.radiance = np.append(look_up_sky(eyes, np.full(NUM_LIGHTS, 4.0)), [SUN_RADIANCE], axis=0)
        self.radiance[:-1] *= SKY_RADIANCE / (self.radiance[:-1, 0] * eyes[:, 2]).sum()
        opaque = self.absorption == 0
        self.shadows = np.stack([self.find_layer(opaque, self.lights, k).near for k in range(NUM_LIGHTS + 1)])

    def find_layer(self, chosen: Bool[np.ndarray, "P"], cameras: Cameras, view: int) -> Layer:
        """Rasterizes the chosen parts."""
        K, c2w = cameras.K[view].double().numpy(), cameras.c2w[view].double().numpy()
        signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, 8)
        pixels = K @ c2w[:3, :3].T @ (self.center[:, :, None] + self.axes @ signs - c2w[:3, 3:])
        pixels, size = pixels[:, :2] / pixels[:, 2:], (cameras.width, cameras.height)
        box = np.floor(pixels.min(2)).clip(0, size).astype(int), np.ceil(pixels.max(2)).clip(0, size).astype(int)
        origin = np.einsum("pij,pj->pi", self.to_unit, c2w[:3, 3] - self.center)
        lift = self.to_unit @ c2w[:3, :3] @ np.linalg.inv(K)
        layer = Layer(np.full(size[::-1], -1), np.full(size[::-1], np.inf), np.full(size[::-1], np.inf))
        rasterize(self.shape, np.flatnonzero(chosen), origin, lift, *box, *layer)
        return layer

    def shade(
        self, k: Int[np.ndarray, "N"], points: Float[np.ndarray, "N 3"], d: Float[np.ndarray, "N 3"]
    ) -> Float[np.ndarray, "N 3"]:
        """Linear colors of points on parts k in unit viewing directions."""
        unit, shape = np.einsum("nij,nj->ni", self.to_unit[k], points - self.center[k]), self.shape[k, None]
        is_cap = np.abs(unit[:, 2:]) > np.linalg.norm(unit[:, :2], axis=1, keepdims=True)
        is_face = np.abs(unit) == np.abs(unit).max(1, keepdims=True)
        kept = np.where(shape == BALL, 1, np.where(shape == BOX, is_face, np.where(is_cap, [0, 0, 1], [1, 1, 0])))
        normals = np.einsum("nji,nj->ni", self.to_unit[k], unit * kept)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        facing = (normals * d).sum(1, keepdims=True)
        mirrors, light, openness = d - 2 * facing * normals, np.full(points.shape, AMBIENT), np.zeros(len(points))
        lights = self.lights.K[0].numpy(), self.lights.c2w[:, :3].numpy(), self.radiance, self.shadows
        gather_light(points, normals, mirrors, *lights, light, openness)
        contrast, frequency, reflectance, sharpness = self.surface[:, k]
        x, y, z = frequency * points.T
        wave = np.sin(x + 2 * np.sin(0.7 * y)) * np.sin(y + 2 * np.sin(0.6 * z)) + 0.5 * np.sin(z + 1)
        light *= 1 + (contrast * (3 * wave).clip(-1, 1))[:, None]
        metal, tint = ((reflectance - 0.1) / 0.2).clip(0, 1)[:, None], self.color[k]
        fresnel = (reflectance + (1 - reflectance) * (1 + facing[:, 0].clip(-1, 0)) ** 5) * (reflectance > 0)
        gloss = (fresnel * (0.25 + 0.75 * openness))[:, None] * look_up_sky(mirrors, sharpness)
        return (1 - metal) * tint * light + (1 - metal + metal * tint) * gloss

    def render(self, cameras: Cameras, view: int) -> UInt8[np.ndarray, "H W 4"]:
        """Renders a view: sRGB and straight alpha; pixels are means in sRGB, as the volume renderer composites."""
        fine, n = cameras.rescale(SUPERSAMPLING), SUPERSAMPLING
        eye = fine.c2w[view, :3, 3].double().numpy()
        lift = fine.c2w[view, :3, :3].double().numpy() @ np.linalg.inv(fine.K[view].double().numpy())
        opaque, number = self.find_layer(self.absorption == 0, fine, view), np.arange(len(self.shape))
        translucent = sorted(np.flatnonzero(self.absorption), key=lambda k: np.linalg.norm(self.center[k] - eye))
        layers = [*(self.find_layer(number == k, fine, view) for k in translucent), opaque]  # front to back
        rgba, passed = np.zeros((fine.height, fine.width, 4)), np.ones((fine.height, fine.width))
        for layer in layers:
            pixel = np.nonzero((layer.part >= 0) & (layer.near <= opaque.near))
            k, t, far = (image[pixel] for image in layer)
            rays = np.stack([pixel[1] + 0.5, pixel[0] + 0.5, np.ones(len(k))], axis=1) @ lift.T
            length = np.linalg.norm(rays, axis=1)
            depth = self.absorption[k] * (np.minimum(far, opaque.near[pixel]) - t) * length
            weight = passed[pixel] * np.where(self.absorption[k] > 0, 1 - np.exp(-depth), 1)
            color = np.sqrt(self.shade(k, eye + t[:, None] * rays, rays / length[:, None]).clip(0, 1))
            rgba[pixel] += weight[:, None] * np.append(color, np.ones((len(k), 1)), axis=1)
            passed[pixel] -= weight
        mean = rgba.reshape(cameras.height, n, cameras.width, n, 4).mean((1, 3))
        mean[..., :3] /= mean[..., 3:].clip(1e-6)
        return np.rint(255 * mean.clip(0, 1)).astype(np.uint8)
