"""The bulldozer: what the built-in scene shows. Front is +y, up is +z; 1.3 x 2.2 x 1.5 world units.

The parts are written in a frame of their own, with studs 0.1 apart and the baseplate on z = -0.6; `bulldozer` moves and
scales the whole.
"""

import functools
import itertools
import math

from nerf_lightning.dataset.bricks.solids import (
    BRICK_HEIGHT,
    BRICKWORK,
    CHEQUER,
    STRIPES,
    STUD_HEIGHT,
    STUD_PITCH,
    Builder,
    Material,
    Solids,
)

YELLOW_RGB, BLACK_RGB = (0.90, 0.52, 0.02), (0.012, 0.012, 0.014)
YELLOW = Material(YELLOW_RGB)
BRICKS = Material(YELLOW_RGB, (0.42, 0.20, 0.005), BRICKWORK, BRICK_HEIGHT)
HAZARD = Material(YELLOW_RGB, BLACK_RGB, STRIPES, 0.07)
CHECKED = Material((0.80, 0.80, 0.78), BLACK_RGB, CHEQUER, 0.05)
BLACK = Material((0.02, 0.02, 0.023), gloss=0.25)
RUBBER = Material((0.035, 0.035, 0.04), gloss=0.12)
DARK = Material((0.09, 0.095, 0.105), gloss=0.25)
GREY = Material((0.30, 0.31, 0.33))
SILVER = Material((0.55, 0.56, 0.58), gloss=0.7)
PLATE = Material((0.20, 0.30, 0.13), gloss=0.15)
RED = Material((0.60, 0.03, 0.02))
BLUE = Material((0.03, 0.12, 0.45))
SKIN = Material((0.95, 0.60, 0.05))
ORANGE = Material((1.0, 0.22, 0.01), gloss=0.8)
LAMP = Material((1.0, 0.95, 0.70), gloss=0.8)
BROWN = Material((0.16, 0.06, 0.025), gloss=0.2)

GROUND = -0.56
"""Height of the baseplate's upper face."""


@functools.cache
def bulldozer() -> Solids:
    """All solids of the model, always in the same order."""
    builder = Builder()
    for part in (_baseplate, _tracks, _hull, _hood, _cab, _driver, _blade, _rear):
        part(builder)
    # As large as cameras at the NeRF paper's distance see from every side without cutting a corner off.
    return builder.build(scale=0.92, shift=(0.0, 0.0, 0.12))


def _baseplate(b: Builder) -> None:
    b.box((-0.7, -1.2, -0.6), (0.7, 1.2, GROUND), PLATE)
    # No studs under the bulldozer, where nothing sees them.
    b.studs((-0.7, -1.2), (0.7, -0.8), GROUND, PLATE)
    b.studs((-0.7, 0.6), (0.7, 1.2), GROUND, PLATE)
    for x in (-0.7, 0.6):
        b.studs((x, -0.8), (x + 0.1, 0.6), GROUND, PLATE)


def _tracks(b: Builder) -> None:
    radius, front, back = 0.185, 0.40, -0.56
    z = GROUND + radius + 0.025
    for side in (-1, 1):

        def wheel(y: float, height: float, r: float, inner: float, outer: float, material: Material, side=side):
            b.cylinder((side * inner, y, height), (side * outer, y, height), r, material)

        b.box((side * 0.48 - 0.06, back, z - 0.07), (side * 0.48 + 0.06, front, z + 0.07), DARK)
        for y in (back, front):
            wheel(y, z, 0.15, 0.39, 0.575, GREY)
            wheel(y, z, 0.105, 0.40, 0.585, DARK)
            wheel(y, z, 0.05, 0.40, 0.605, YELLOW)
            for k in range(6):
                angle = k * math.pi / 3
                dy, dz = 0.078 * math.cos(angle), 0.078 * math.sin(angle)
                b.cylinder((side * 0.5, y + dy, z + dz), (side * 0.592, y + dy, z + dz), 0.014, SILVER)
        for k in range(4):
            y = back + (k + 1) * (front - back) / 5
            wheel(y, z - 0.09, 0.075, 0.39, 0.575, GREY)
            wheel(y, z - 0.09, 0.03, 0.40, 0.59, RED)
        for k in (1, 2):
            wheel(back + k * (front - back) / 3, z + 0.11, 0.045, 0.39, 0.57, GREY)
        _links(b, side, front, back, z, radius)


def _links(b: Builder, side: int, front: float, back: float, z: float, radius: float) -> None:
    """Plates with a raised bar each, spaced evenly along the loop around the two end wheels."""
    straight, bend = front - back, math.pi * radius
    count = round((2 * straight + 2 * bend) / 0.082)
    for k in range(count):
        s = (k + 0.5) * (2 * straight + 2 * bend) / count
        if s < straight:
            y, height, angle = front - s, z - radius, -math.pi / 2
        elif s < straight + bend:
            angle = -math.pi / 2 - (s - straight) / radius
            y, height = back + radius * math.cos(angle), z + radius * math.sin(angle)
        elif s < 2 * straight + bend:
            y, height, angle = back + (s - straight - bend), z + radius, math.pi / 2
        else:
            angle = math.pi / 2 - (s - 2 * straight - bend) / radius
            y, height = front + radius * math.cos(angle), z + radius * math.sin(angle)
        along = (-math.sin(angle), math.cos(angle))
        out = (math.cos(angle), math.sin(angle))
        for reach, length, width, thickness, material in (
            (0.0, 0.068, 0.25, 0.03, RUBBER),
            (0.016, 0.022, 0.24, 0.03, DARK),
        ):
            cy, cz = y + reach * out[0], height + reach * out[1]
            start = (side * 0.485, cy - along[0] * length / 2, cz - along[1] * length / 2)
            end = (side * 0.485, cy + along[0] * length / 2, cz + along[1] * length / 2)
            b.bar(start, end, width, thickness, material)


def _hull(b: Builder) -> None:
    b.box((-0.36, -0.74, -0.46), (0.36, 0.62, -0.2), BLACK)
    b.box((-0.36, -0.80, -0.2), (0.36, 0.66, 0.04), BRICKS)
    for side in (-1, 1):
        # Mudguards over the tracks.
        b.box((side * 0.36, -0.76, -0.12), (side * 0.62, 0.30, -0.08), YELLOW)
        b.studs((side * 0.36, -0.76), (side * 0.62, 0.30), -0.08, YELLOW)
        b.box((side * 0.36, -0.80, -0.18), (side * 0.62, -0.76, -0.08), HAZARD)
        # Fuel tank and toolbox on them.
        b.cylinder((side * 0.49, -0.66, 0.01), (side * 0.49, -0.34, 0.01), 0.085, SILVER if side > 0 else GREY)
        toolbox = RED if side > 0 else CHECKED
        b.box((side * 0.49 - 0.09, -0.26, -0.08), (side * 0.49 + 0.09, -0.02, 0.04), toolbox)
        b.cylinder((side * 0.49, -0.53, 0.08), (side * 0.49, -0.53, 0.115), 0.03, BLACK)
    b.studs((-0.36, -0.80), (0.36, -0.56), 0.04, YELLOW)


def _hood(b: Builder) -> None:
    b.box((-0.27, 0.02, 0.04), (0.27, 0.64, 0.36), BRICKS)
    b.studs((-0.2, 0.04), (0.2, 0.64), 0.36, YELLOW)
    # The grille: slats before a black recess, in a frame.
    b.box((-0.24, 0.63, -0.16), (0.24, 0.67, 0.34), BLACK)
    for k in range(8):
        z = -0.12 + k * 0.058
        b.box((-0.2, 0.67, z), (0.2, 0.69, z + 0.026), GREY)
    for side in (-1, 1):
        b.box((side * 0.225 - 0.025, 0.64, -0.18), (side * 0.225 + 0.025, 0.70, 0.36), YELLOW)
        b.cylinder((side * 0.29, 0.56, 0.30), (side * 0.29, 0.67, 0.30), 0.05, DARK)
        b.cylinder((side * 0.29, 0.67, 0.30), (side * 0.29, 0.68, 0.30), 0.04, LAMP)
        # Louvres and a coloured band on the engine's flanks.
        for k in range(6):
            y = 0.10 + k * 0.065
            b.box((side * 0.27, y, 0.12), (side * 0.283, y + 0.03, 0.30), BLACK)
        b.box((side * 0.27, 0.04, 0.055), (side * 0.283, 0.62, 0.095), HAZARD)
    b.box((-0.245, 0.64, 0.34), (0.245, 0.70, 0.38), YELLOW)
    # Exhaust: muffler, pipe, rain collar and the dark hole in its end; a short air intake beside it.
    b.cylinder((0.13, 0.40, 0.36), (0.13, 0.40, 0.56), 0.06, DARK)
    b.cylinder((0.13, 0.40, 0.56), (0.13, 0.40, 0.84), 0.033, SILVER)
    b.cylinder((0.13, 0.40, 0.80), (0.13, 0.40, 0.86), 0.045, DARK)
    b.cylinder((0.13, 0.40, 0.86), (0.13, 0.40, 0.862), 0.032, BLACK)
    b.cylinder((-0.13, 0.22, 0.36), (-0.13, 0.22, 0.52), 0.035, GREY)
    b.cylinder((-0.13, 0.22, 0.52), (-0.13, 0.22, 0.57), 0.065, BLACK)


def _cab(b: Builder) -> None:
    b.box((-0.30, -0.52, 0.04), (0.30, -0.02, 0.07), DARK)
    for side in (-1, 1):
        b.box((side * 0.34, -0.52, 0.04), (side * 0.30, -0.20, 0.28), BRICKS)
        b.box((side * 0.34, -0.52, 0.28), (side * 0.30, -0.20, 0.30), BLACK)
        for y in (-0.56, -0.02):
            b.box((side * 0.34, y, 0.04), (side * 0.30, y + 0.04, 0.78), BLACK)
        b.box((side * 0.34, -0.22, 0.30), (side * 0.30, -0.19, 0.78), BLACK)
        # Work lights on the roof's front corners.
        b.cylinder((side * 0.28, 0.02, 0.72), (side * 0.28, 0.09, 0.72), 0.04, DARK)
        b.cylinder((side * 0.28, 0.09, 0.72), (side * 0.28, 0.10, 0.72), 0.032, LAMP)
    b.box((-0.30, -0.56, 0.04), (0.30, -0.52, 0.34), BRICKS)
    b.box((-0.30, -0.02, 0.04), (0.30, 0.02, 0.40), BRICKS)
    for post in (-0.16, 0.13):
        b.box((post, -0.555, 0.34), (post + 0.03, -0.53, 0.78), BLACK)
    b.box((-0.39, -0.61, 0.78), (0.39, 0.08, 0.82), DARK)
    b.box((-0.37, -0.59, 0.82), (0.37, 0.06, 0.90), BRICKS)
    b.studs((-0.35, -0.56), (0.35, 0.04), 0.90, YELLOW)
    b.cylinder((-0.15, -0.41, 0.90), (-0.15, -0.41, 0.95), 0.055, BLACK)
    b.cylinder((-0.15, -0.41, 0.95), (-0.15, -0.41, 1.04), 0.045, ORANGE)


def _driver(b: Builder) -> None:
    """The seat, the controls and whoever sits there."""
    b.box((-0.14, -0.46, 0.07), (0.14, -0.22, 0.17), BROWN)
    b.box((-0.14, -0.50, 0.07), (0.14, -0.44, 0.44), BROWN)
    b.box((-0.09, -0.43, 0.17), (0.09, -0.31, 0.40), BLUE)
    for side in (-1, 1):
        b.bar((side * 0.05, -0.34, 0.20), (side * 0.05, -0.14, 0.19), 0.07, 0.07, BLACK)
        b.bar((side * 0.125, -0.37, 0.36), (side * 0.125, -0.20, 0.26), 0.05, 0.05, BLUE)
        b.bar((side * 0.20, -0.20, 0.07), (side * 0.20, -0.12, 0.34), 0.02, 0.02, SILVER)
        b.cylinder((side * 0.20, -0.12, 0.33), (side * 0.20, -0.12, 0.37), 0.022, RED)
    b.cylinder((0, -0.37, 0.40), (0, -0.37, 0.53), 0.07, SKIN)
    b.cylinder((0, -0.37, 0.53), (0, -0.37, 0.60), 0.08, RED)
    b.box((-0.06, -0.34, 0.53), (0.06, -0.25, 0.545), RED)
    for x in (-0.025, 0.025):
        b.cylinder((x, -0.305, 0.48), (x, -0.298, 0.48), 0.01, BLACK)
    b.bar((0, -0.04, 0.25), (0, -0.13, 0.31), 0.03, 0.03, DARK)
    b.cylinder((0, -0.13, 0.30), (0, -0.142, 0.314), 0.075, BLACK)


def _blade(b: Builder) -> None:
    """A curved shield of flat staves, carried by two push arms and two lift cylinders."""
    centre_y, centre_z, radius, staves = 1.40, -0.16, 0.46, 6
    edge = [math.radians(-52 + 104 * k / staves) for k in range(staves + 1)]
    rim = [(centre_y - radius * math.cos(a), centre_z + radius * math.sin(a)) for a in edge]
    for k, (start, end) in enumerate(itertools.pairwise(rim)):
        b.bar((0, *start), (0, *end), 1.30, 0.045, HAZARD if k == staves - 1 else GREY if k == 0 else YELLOW)
    for side in (-1, 1):
        for start, end in itertools.pairwise(rim):
            b.bar((side * 0.665, *start), (side * 0.665, *end), 0.03, 0.09, DARK)
        # Ribs on the back of the shield.
        for x in (0.14, 0.42):
            b.box((side * x - 0.02, 0.86, -0.40), (side * x + 0.02, 0.95, 0.06), DARK)
        b.bar((side * 0.645, -0.15, -0.34), (side * 0.645, 0.92, -0.36), 0.06, 0.075, YELLOW)
        b.cylinder((side * 0.60, -0.15, -0.34), (side * 0.69, -0.15, -0.34), 0.06, DARK)
        b.cylinder((side * 0.31, 0.40, 0.14), (side * 0.31, 0.68, 0.085), 0.042, DARK)
        b.cylinder((side * 0.31, 0.66, 0.089), (side * 0.31, 0.97, 0.027), 0.022, SILVER)
        b.cylinder((side * 0.27, 0.42, 0.136), (side * 0.36, 0.42, 0.136), 0.05, GREY)
    b.box((-0.60, 0.875, -0.20), (0.60, 0.93, -0.12), GREY)
    b.bar((0, 1.085, -0.515), (0, 1.16, -0.55), 1.33, 0.02, SILVER)
    # Bolts along the shield, one row of small high-contrast dots.
    for k in range(12):
        x = (k - 5.5) * 1.1 * STUD_PITCH
        b.cylinder((x, 0.95, -0.16), (x, 0.975, -0.16), 0.02, BLACK)


def _rear(b: Builder) -> None:
    b.box((-0.34, -0.98, -0.22), (0.34, -0.80, 0.02), DARK)
    b.studs((-0.34, -1.0), (0.34, -0.80), 0.02, DARK)
    b.box((-0.34, -0.995, -0.20), (0.34, -0.98, -0.06), HAZARD)
    b.box((-0.10, -0.992, -0.05), (0.10, -0.98, 0.01), CHECKED)
    for side in (-1, 1):
        b.cylinder((side * 0.22, -0.98, -0.02), (side * 0.22, -0.995, -0.02), 0.028, RED)
        # The ripper: an arm and a tooth on each side, joined by a beam.
        b.bar((side * 0.22, -0.94, -0.25), (side * 0.22, -1.12, -0.30), 0.05, 0.06, YELLOW)
        b.bar((side * 0.22, -1.10, -0.22), (side * 0.22, -1.07, -0.44), 0.045, 0.06, GREY)
        b.bar((side * 0.22, -1.07, -0.43), (side * 0.22, -1.01, -0.54 + STUD_HEIGHT), 0.04, 0.04, SILVER)
    b.box((-0.32, -1.14, -0.30), (0.32, -1.07, -0.24), BLACK)
    # Rear wall of the hull: a radiator screen.
    for k in range(5):
        b.box((-0.30, -0.75, -0.43 + k * 0.045), (0.30, -0.735, -0.41 + k * 0.045), GREY)
