"""Benchmark objects of six kinds, built of boxes, cylinders and ellipsoids around the origin, z up."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from numpy.random import Generator

BOX, CYLINDER, BALL = range(3)
"""Unit shapes: within [-1, 1] along each axis; a cylinder's axis is z."""
UP = (0.0, 0.0, 1.0)
Vector = Float[np.ndarray, "3"] | tuple[float, float, float]


class Material(NamedTuple):
    """Linear color; amplitude and frequency of its texture; mirrored fraction of the light, and the exponent of the mirror
    image's blur; optical depth per world unit of a translucent material, 0 for an opaque one."""

    color: tuple[float, ...]
    contrast: float = 0.0
    frequency: float = 1.0
    reflectance: float = 0.0
    sharpness: float = 60.0
    absorption: float = 0.0


class Part(NamedTuple):
    """A unit shape in the world: its center, and its axes as columns."""

    shape: int
    center: Vector
    axes: Float[np.ndarray, "3 3"]
    material: Material


def make_part(shape: int, center: Vector, half_size: Vector, material: Material, axis: Vector = UP) -> Part:
    """Makes a part whose z axis points along `axis`."""
    z = np.asarray(axis) / np.linalg.norm(axis)
    x = np.cross(np.eye(3)[1 if abs(z[1]) < 0.9 else 2], z)
    x /= np.linalg.norm(x)
    return Part(shape, center, np.stack([x, np.cross(z, x), z], axis=1) * half_size, material)


def make_wire(points: Float[np.ndarray, "N 3"] | list, radius: float, material: Material) -> list[Part]:
    """Makes a chain of cylinders."""
    ends = np.asarray(points, float)
    middles, halves = (ends[1:] + ends[:-1]) / 2, (ends[1:] - ends[:-1]) / 2
    sizes = [(radius, radius, float(np.linalg.norm(half))) for half in halves]
    return [make_part(CYLINDER, m, s, material, h) for m, s, h in zip(middles, sizes, halves, strict=True)]


def make_plant(rng: Generator) -> list[Part]:
    """Thin: twigs and leaves in a pot."""
    bark, leaf = Material((0.30, 0.20, 0.12), 0.4, 60), Material((0.16, 0.42, 0.10), 0.35, 45, 0.03, 30)
    parts = [make_part(CYLINDER, (0, 0, -0.75), (0.32, 0.32, 0.2), Material((0.55, 0.25, 0.15), 0.25, 25))]
    parts += [make_part(CYLINDER, (0, 0, -0.545), (0.35, 0.35, 0.015), Material((0.5, 0.45, 0.4), 0.5, 40))]
    for _ in range(36):
        point, direction = np.array([0, 0, -0.5]), np.append(rng.normal(0, 0.35, 2), 1.0)
        for step in range(14):
            following = point + 0.1 * direction / np.linalg.norm(direction)
            parts += make_wire([point, following], 0.014 - 0.0008 * step, bark)
            if step > 3:
                size, center = rng.uniform(0.05, 0.11), following + rng.normal(0, 0.05, 3)
                parts += [make_part(BALL, center, (size, 0.4 * size, 0.004), leaf, UP + rng.normal(0, 0.5, 3))]
            point, direction = following, direction + rng.normal(0, 1, 3) * (0.3, 0.3, 0.15)
    return parts


def make_microphone(_: Generator) -> list[Part]:
    """Porous: a ball of wire around a capsule, on a stand with a cable."""
    steel, dark = Material((0.55, 0.55, 0.6), 0, 1, 0.4, 80), Material((0.06, 0.06, 0.07), 0.5, 50, 0.04)
    top = np.array([0.0, -0.25, 0.5])
    parts = [make_part(BALL, top, (0.24, 0.24, 0.24), Material((0.55, 0.16, 0.1), 0.4, 40))]
    turn, arc, s = np.linspace(0, 2 * np.pi, 61), np.linspace(0.1, np.pi - 0.1, 19), np.linspace(0, 1, 260)
    circles = [(turn, polar + 0 * turn) for polar in np.arccos(np.linspace(-0.92, 0.92, 25))]
    for azimuth, polar in circles + [(turn + 0 * arc, arc) for turn in np.linspace(0, 2 * np.pi, 48, endpoint=False)]:
        ring = np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], axis=1)
        parts += make_wire(top + 0.42 * ring, 0.006, steel)
    coil = np.stack([0.3 * s + 0.05 * np.cos(150 * s), 0.1 + 0.6 * s + 0.05 * np.sin(150 * s), 0.1 * s - 0.9], axis=1)
    parts += make_wire(coil, 0.012, dark) + make_wire([top - [0, 0.5, 0], top - [0, 1.0, 0.2]], 0.12, dark)
    parts += make_wire([top - [0, 0.38, 0], top - [0, 0.55, 0.03]], 0.16, steel)
    parts += make_wire([(0, -0.9, 0.4), (0, -0.2, -0.9)], 0.025, steel)
    return [*parts, make_part(CYLINDER, (0, -0.2, -0.92), (0.5, 0.5, 0.03), Material((0.1, 0.11, 0.13), 0.3, 12, 0.06))]


def make_metals(rng: Generator) -> list[Part]:
    """Shiny: lacquer and metal, brushed to polished, on a glossy plate."""
    parts = [make_part(BOX, (0, 0, -0.6), (0.9, 0.9, 0.05), Material((0.22, 0.10, 0.06), 0.4, 14, 0.08, 200))]
    for number, (row, column) in enumerate(np.ndindex(3, 3)):
        mirror = (0.05, 0.5, 0.8)[row], (25.0, 100.0, 400.0)[column]
        material = Material(tuple(rng.uniform(0.15, 0.8, 3)), 0.3 * (row == 0), 25, *mirror)
        height = 0.2 if number % 2 else 0.25 + 0.05 * row
        center = 0.58 * (row - 1), 0.58 * (column - 1), height - 0.55
        parts += [make_part(CYLINDER if number % 2 else BALL, center, (0.25, 0.25, height), material)]
    return parts


def make_glasses(rng: Generator) -> list[Part]:
    """Translucent: jellies with beads inside, and tinted panes."""
    parts = [make_part(CYLINDER, (0, 0, -0.62), (1.05, 1.05, 0.025), Material((0.7, 0.68, 0.62), 0.35, 18))]
    jellies = [((0.8, 0.12, 0.1), (-0.45, -0.4, -0.25), 0.36, 1.5), ((0.1, 0.5, 0.2), (0.5, -0.3, -0.3), 0.3, 3.0)]
    for color, center, radius, absorption in [*jellies, ((0.9, 0.6, 0.1), (0.0, 0.5, -0.2), 0.4, 0.8)]:
        parts += [make_part(BALL, center, (radius,) * 3, Material(color, 0, 1, 0.04, 120, absorption))]
        for offset in rng.uniform(-0.5, 0.5, (6, 3)):
            bead = Material(tuple(rng.uniform(0.1, 0.9, 3)))
            parts += [make_part(BALL, np.array(center) + radius * offset, (0.045,) * 3, bead)]
    for azimuth, color in ((0.5, (0.2, 0.3, 0.8)), (2.6, (0.7, 0.2, 0.6)), (4.2, (0.2, 0.7, 0.7))):
        out, pane = np.array([np.cos(azimuth), np.sin(azimuth), 0.0]), Material(color, 0, 1, 0.05, 200, 18.0)
        parts += [make_part(BOX, 0.9 * out - [0, 0, 0.2], (0.4, 0.3, 0.015), pane, out)]
    return [*parts, *make_wire([(0.35, 0.15, -0.6), (0.45, 0.2, 0.6)], 0.015, Material((0.8, 0.8, 0.8), 0, 1, 0.3))]


def make_sofa(_: Generator) -> list[Part]:
    """Large and plain: smooth surfaces with little texture."""
    fabric, wood = Material((0.62, 0.56, 0.45), 0.06, 9), Material((0.35, 0.2, 0.1), 0.2, 16, 0.05, 40)
    parts = [make_part(BOX, (0, 0, -0.45), (1, 0.6, 0.12), wood), make_part(BOX, (0, 0.62, 0), (1, 0.12, 0.55), fabric)]
    for side in (-1, 1):
        parts += make_wire([(0.95 * side, -0.6, -0.1), (0.95 * side, 0.6, -0.1)], 0.2, fabric)
        parts += [make_part(BALL, (0.45 * side, 0, -0.25), (0.5, 0.58, 0.16), fabric)]
        parts += [make_part(BALL, (0.4 * side, 0.4, 0.05), (0.3, 0.12, 0.3), Material((0.25, 0.32, 0.4), 0.1, 20))]
        parts += [make_part(CYLINDER, (side, y, -0.66), (0.05, 0.05, 0.09), wood) for y in (-0.55, 0.6)]
    return parts


def make_heap(rng: Generator) -> list[Part]:
    """Many small parts: bricks, pins and beads."""
    parts = [make_part(CYLINDER, (0, 0, -0.525), (1, 1, 0.025), Material((0.4, 0.4, 0.42), 0.3, 20))]
    palette = rng.uniform(0.03, 0.85, (12, 3))
    for number in range(1100):
        ring, azimuth, kind = 0.95 * np.sqrt(rng.uniform()), rng.uniform(0, 2 * np.pi), number % 3
        height = 0.85 * rng.uniform() * (1 - ring**2) ** 1.5 - 0.48
        size = rng.uniform(0.6, 1.2) * np.array([(0.06, 0.035, 0.025), (0.012, 0.012, 0.1), (0.035,) * 3][kind])
        material = Material(tuple(palette[number % 12]), 0.3 * (kind == BOX), 60, 0.04 * (number % 2))
        center = ring * np.cos(azimuth), ring * np.sin(azimuth), height
        parts += [make_part(kind, center, size, material, rng.normal(0, 1, 3))]
    return parts


MAKERS = (make_plant, make_microphone, make_metals, make_glasses, make_sofa, make_heap)
OBJECTS = {make.__name__.removeprefix("make_"): make for make in MAKERS}
"""Functions of a random generator that make an object's parts, by its name."""
