"""A forward-facing capture: fronds of thin leaflets at several depths before a far wall, made of solids."""

import math
from pathlib import Path

import numpy as np
import torch

from benchmarks.synthetic.rooms import write_capture
from nerf_lightning.cameras import Cameras, look_at
from nerf_lightning.synthetic.objects import make_pinhole_cameras
from nerf_lightning.synthetic.solids import PATTERNS, Solids
from nerf_lightning.synthetic.tracer import make_shadow_map, render_view

WIDTH, HEIGHT, VIEWS, FIELD_OF_VIEW_RAD = 504, 378, 24, 1.05
CAMERA_DISTANCE, WALL_DISTANCE, CAMERA_REACH = 4.0, 10.0, (0.55, 0.4)
"""Cameras look along -y, from a plane at a distance from the origin; the wall's distance from that plane; half its sides."""
BOARDS, FRONDS, JOINTS = 70, 48, 13
"""Number of boards before the wall, of fronds, and of joints of each frond with a pair of leaflets."""
Part = tuple[bool, np.ndarray, tuple[float, float, float], np.ndarray, str, bool]
"""A solid without its colors: whether it is a cylinder, center, half-size, axes, pattern, and whether it is a leaflet."""


def make_foliage(seed: int = 0) -> Solids:
    """Makes fronds between 1.6 and 6 units before the cameras, a floor, a wall, and boards before it."""
    rng, wall, axes = np.random.default_rng(seed), CAMERA_DISTANCE - WALL_DISTANCE, np.eye(3)
    parts: list[Part] = [(False, np.array([0.0, wall - 0.5, 0.0]), (14.0, 0.5, 9.0), axes, "brickwork", False)]
    parts.append((False, np.array([0.0, wall / 2 + 0.5, -2.6]), (9.0, -wall / 2 + 0.5, 0.1), axes, "checker", False))
    for _ in range(BOARDS):
        size = rng.uniform(0.15, 0.9, 2)
        center = np.array([rng.uniform(-6, 6), rng.uniform(wall, wall + 2.5), rng.uniform(-2.4, 4)])
        board = size[0], 0.08, size[1]
        parts.append((bool(rng.random() < 0.3), center, board, axes, str(rng.choice(PATTERNS)), False))
    for _ in range(FRONDS):
        parts += make_frond(rng)
    cylinder, centers, half_size, frames, patterns, leaf = map(np.array, zip(*parts, strict=True))
    count, greens = len(parts), ((0.05, 0.35), (0.25, 0.6), (0.03, 0.15))
    green = np.stack([rng.uniform(low, high, count) for low, high in greens], axis=1)
    color = np.where(leaf[:, None], green, rng.uniform(0.1, 0.8, (count, 3)))
    accent, period = color * rng.uniform(0.3, 0.8, (count, 1)), rng.uniform(0.12, 0.5, count)
    pattern, gloss = np.array([PATTERNS.index(name) for name in patterns]), np.where(leaf, 0.25, 0.05)
    colors = color.astype(np.float32), accent.astype(np.float32), pattern, period.astype(np.float32)
    return Solids(cylinder, centers, half_size, frames, *colors, gloss.astype(np.float32))


def make_frond(rng: np.random.Generator) -> list[Part]:
    """Makes a drooping stem with a pair of thin elliptic leaflets at each joint."""
    depth = rng.uniform(1.6, 6.0)
    x, z = rng.uniform(-0.7, 0.7) * (depth + 0.5), rng.uniform(-0.45, 0.2) * depth
    root, parts = np.array([x, CAMERA_DISTANCE - depth, z]), []
    heading, pitch, length = rng.uniform(0, 2 * math.pi), rng.uniform(0.5, 1.4), rng.uniform(0.07, 0.13)
    forward, side = (np.array([math.cos(a), math.sin(a), 0.0]) for a in (heading, heading + math.pi / 2))
    for joint in range(JOINTS):
        ahead = math.cos(pitch) * forward + np.array([0.0, 0.0, math.sin(pitch)])
        normal = np.cross(ahead, side)
        stem = np.stack([side, normal, ahead])
        parts.append((True, root + ahead * length / 2, (0.012, 0.012, length * 0.52), stem, "plain", False))
        reach = 0.34 * math.sin(math.pi * (joint + 1.2) / (JOINTS + 1.5))
        for sign in (-1.0, 1.0):
            along = sign * side * 0.9 + ahead * 0.43 + normal * rng.normal(0, 0.15)
            along /= np.linalg.norm(along)
            flat = normal - along * (normal @ along) + np.cross(along, normal) * rng.normal(0, 0.3)
            flat /= np.linalg.norm(flat)
            leaf = np.stack([along, np.cross(flat, along), flat])
            parts.append((True, root + along * reach / 2, (reach / 2, 0.035, 0.004), leaf, "plain", True))
        root = root + ahead * length
        pitch -= rng.uniform(0.05, 0.16)
    return parts


def make_forward_cameras(width: int, height: int, seed: int = 0) -> Cameras:
    """Handheld cameras on a plane, looking the same way."""
    rng = np.random.default_rng(seed)
    # Multiples of powers of the plastic number, modulo 1, cover a square evenly.
    place = 2 * (np.outer(np.arange(VIEWS), (0.7548776662, 0.5698402910)) % 1) - 1
    distance = CAMERA_DISTANCE + rng.normal(0, 0.05, VIEWS)
    eye = np.stack([place[:, 0] * CAMERA_REACH[0], distance, place[:, 1] * CAMERA_REACH[1]])
    target = eye * [[0.3], [0.0], [0.3]] + rng.normal(0, 0.08, (3, VIEWS))
    up = np.array([0.0, 0.0, 1.0]) + rng.normal(0, 0.02, (VIEWS, 3))
    poses = [look_at(*map(torch.from_numpy, it)) for it in zip(eye.T[:, None], target.T, up, strict=True)]
    return make_pinhole_cameras(torch.cat(poses).float(), width, height, FIELD_OF_VIEW_RAD)


def write_foliage(folder: Path, width: int = WIDTH, height: int = HEIGHT) -> Path:
    """Renders the photos into a folder, if it does not exist, as a capture of which every 8th photo is held out."""
    if not folder.exists():
        solids, cameras = make_foliage(), make_forward_cameras(width, height)
        shadow = make_shadow_map(solids, radius=4.5)
        photos = [render_view(cameras, view, solids, shadow)[..., :3] for view in range(len(cameras))]
        write_capture(cameras, np.stack(photos), folder)
    return folder
