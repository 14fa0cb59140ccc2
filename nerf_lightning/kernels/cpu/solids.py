"""Rasterization and shading of boxes and cylinders, for `nerf_lightning.synthetic.tracer`.

Only + - * / and sqrt, which IEEE 754 fixes to the last bit, so that images are the same on every machine. Constants are
float32: one float64 would promote all results.
"""

import numpy as np
from numba import prange

from nerf_lightning.kernels.cpu.jit import jit, kernel

single = np.float32
ZERO, HALF, ONE, TWO, EPSILON, INF = (single(number) for number in (0, 0.5, 1, 2, 1e-6, np.inf))
CHEQUER, STRIPES, BRICKWORK = 1, 2, 3
LIGHT_POSITION = (single(4.5), single(5.0), single(10.0))
"""Position of the key light, world frame; without distance attenuation."""
FILL_DIRECTION = tuple(single(part) / single(np.sqrt(0.985)) for part in (-0.65, -0.60, 0.45))
"""Unit direction towards the fill light, which casts no shadow."""
SKY, FLOOR = np.array([0.30, 0.32, 0.36], np.float32), np.array([0.13, 0.12, 0.10], np.float32)
KEY_LIGHT_WEIGHT, FILL_LIGHT_WEIGHT, JOINT = single(0.80), single(0.32), single(0.09)
SHADOW_BIAS = single(0.01)
"""Shadow-map bias, world units: more than the slope of a texel, less than a stud."""


@jit
def dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@jit
def subtract(a, b):
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@jit
def transform(m, v):
    return dot(m[0], v), dot(m[1], v), dot(m[2], v)


@jit
def normalize(v):
    length = np.sqrt(dot(v, v))
    return v[0] / length, v[1] / length, v[2] / length


@jit
def cross_slab(o, d):
    """Entry and exit distance of a ray through the slab [-1, 1] along one axis."""
    inverse = ONE / d
    low, high = (-ONE - o) * inverse, (ONE - o) * inverse
    return np.minimum(low, high), np.maximum(low, high)


@jit
def entry_distance(cylinder, o, d):
    """Entry distance t of a ray o + t * d into the cube [-1, 1]^3 or its cylinder (axis z), from outside; inf for a miss."""
    # A ray along a face divides by zero: infinities are correct, and the NaN of a ray inside a face compares false.
    near, far = cross_slab(o[2], d[2])
    if cylinder:
        # A ray along the axis has no crossing: tilt it by less than float32 resolves.
        dx, dy = EPSILON if abs(d[0]) + abs(d[1]) < EPSILON else d[0], d[1]
        a = dx * dx + dy * dy
        # Distance from the axis by the cross product, as b^2 - ac would cancel.
        cross = o[0] * dy - o[1] * dx
        if a < cross * cross:
            return INF
        chord, middle = np.sqrt(a - cross * cross), -(o[0] * dx + o[1] * dy)
        near, far = np.maximum(near, (middle - chord) / a), np.minimum(far, (middle + chord) / a)
    else:
        for k in range(2):
            low, high = cross_slab(o[k], d[k])
            near, far = np.maximum(near, low), np.minimum(far, high)
    return near if near < far and near > 0 else INF


@kernel
def rasterize(cylinder, lift, eye, first, last, solid, depth, workers):
    """Writes the nearest solid and its t at each pixel [H, W].

    Args:
        lift: [P, 3, 3], from (u, v, 1) in pixels to a ray's direction in each solid's frame.
        eye: [P, 3], camera position in each solid's frame.
        first, last: [P, 2], column and row bounds of each solid's pixels.
    """
    height = len(depth)
    for worker in prange(workers):
        top, bottom = height * worker // workers, height * (worker + 1) // workers
        for k in range(len(cylinder)):
            m, o = lift[k], (eye[k, 0], eye[k, 1], eye[k, 2])
            for row in range(max(top, first[k, 1]), min(bottom, last[k, 1])):
                v = single(row) + HALF
                x, y, z = m[0, 1] * v + m[0, 2], m[1, 1] * v + m[1, 2], m[2, 1] * v + m[2, 2]
                for col in range(first[k, 0], last[k, 0]):
                    u = single(col) + HALF
                    t = entry_distance(cylinder[k], o, (m[0, 0] * u + x, m[1, 0] * u + y, m[2, 0] * u + z))
                    if t < depth[row, col]:
                        solid[row, col], depth[row, col] = k, t


@jit
def find_normal(cylinder, unit):
    """Outward normal at a point of the unit cube or cylinder, and the axis of its face (0 for the curved side)."""
    x, y, z = unit
    radius = np.sqrt(x * x + y * y) if cylinder else abs(x)
    if abs(z) > radius and (cylinder or abs(z) > abs(y)):
        return (ZERO, ZERO, np.sign(z)), 2
    if cylinder:
        return (x / radius, y / radius, ZERO), 0
    return ((ZERO, np.sign(y), ZERO), 1) if abs(y) > radius else ((np.sign(x), ZERO, ZERO), 0)


@jit
def has_accent(pattern, period, x, y, z, face):
    """Whether a pattern shows its accent color at a point (relative to the solid's lower corner) of a face."""
    # Face coordinates: u horizontal and v vertical on a side; x and y on top.
    u, v = y if face == 0 else x, y if face == 2 else z
    if pattern == CHEQUER:
        return (np.floor(u / period) + np.floor(v / period)) % 2 == 1
    if pattern == STRIPES:
        return np.floor((u + v) / period) % 2 == 1
    if pattern == BRICKWORK:
        # Courses one period high, bricks three periods long, every other course shifted by half a brick.
        course, length = np.floor(v / period), period * single(3)
        along = (u + (course % TWO) * length / TWO) % length
        return min(along, v - course * period) < JOINT * period
    return False


@jit
def is_unshadowed(shadow, solid, point):
    """Whether a point (world frame) on a solid (-1: none) is lit by the key light."""
    x, y, z = transform(shadow.rotation.T, subtract(point, LIGHT_POSITION))
    size, focal = len(shadow.depth), single(shadow.focal)
    col = int(min(max(focal * x / z + single(size / 2), ZERO), single(size - 1)))
    row = int(min(max(focal * y / z + single(size / 2), ZERO), single(size - 1)))
    # A convex solid never shadows its lit side, so the same solid in the map needs no bias.
    return shadow.solid[row, col] == solid or z <= shadow.depth[row, col] + SHADOW_BIAS


@jit
def add_color(solids, shadow, k, point, direction, out):
    """Adds the sRGB color of a point on solid k in a unit viewing direction to out [3]: Lambert, ambient, Blinn-Phong."""
    local, half = transform(solids.axes[k], subtract(point, solids.center[k])), solids.half_size[k]
    unit = local[0] / half[0], local[1] / half[1], local[2] / half[2]
    local_normal, face = find_normal(solids.is_cylinder[k], unit)
    corner = (local[0] + half[0], local[1] + half[1], local[2] + half[2])
    accent = has_accent(solids.pattern[k], solids.period[k], corner[0], corner[1], corner[2], face)
    albedo = solids.accent[k] if accent else solids.color[k]
    normal = transform(solids.axes[k].T, local_normal)
    light = normalize(subtract(LIGHT_POSITION, point))
    key = max(dot(normal, light), ZERO) * single(is_unshadowed(shadow, k, point))
    fill = max(dot(normal, FILL_DIRECTION), ZERO)
    highlight = max(dot(normal, normalize(subtract(light, direction))), ZERO)
    for _ in range(5):  # to the power 32
        highlight = highlight * highlight
    highlight = highlight * single(key > 0) * solids.gloss[k]
    up = (normal[2] + ONE) / TWO
    for channel in range(3):
        ambient = FLOOR[channel] + (SKY[channel] - FLOOR[channel]) * up
        # Square root approximates the sRGB curve.
        diffuse = ambient + KEY_LIGHT_WEIGHT * key + FILL_LIGHT_WEIGHT * fill
        out[channel] += np.sqrt(min(albedo[channel] * diffuse + highlight, ONE))


@kernel
def shade(solids, shadow, K, c2w, solid, depth, rgba, workers):
    """Writes an image [H, W, 4] in bytes with straight alpha, each pixel the mean of n x n samples.

    Args:
        solids, shadow: see `nerf_lightning.synthetic`.
        K, c2w: camera with n times the resolution.
        solid, depth: output of `rasterize` for it.
    """
    height, width = rgba.shape[:2]
    n = len(solid) // height
    for worker in prange(workers):
        total = np.zeros(3)
        for row in range(height * worker // workers, height * (worker + 1) // workers):
            for col in range(width):
                count = 0
                total[:] = 0
                for i in range(row * n, row * n + n):
                    for j in range(col * n, col * n + n):
                        if solid[i, j] < 0:
                            continue
                        x, y = (j + 0.5 - K[0, 2]) / K[0, 0], (i + 0.5 - K[1, 2]) / K[1, 1]
                        ray = transform(c2w, (x, y, 1.0))
                        offset, t = (single(ray[0]), single(ray[1]), single(ray[2])), depth[i, j]
                        point = (c2w[0, 3] + t * offset[0], c2w[1, 3] + t * offset[1], c2w[2, 3] + t * offset[2])
                        length = single(np.sqrt(x * x + y * y + 1))
                        direction = (offset[0] / length, offset[1] / length, offset[2] / length)
                        add_color(solids, shadow, solid[i, j], point, direction, total)
                        count += 1
                # Averaged in sRGB, as the volume renderer composites, over the samples that hit; alpha is their fraction.
                for channel in range(3):
                    rgba[row, col, channel] = np.rint(total[channel] / max(count, 1) * 255)
                rgba[row, col, 3] = np.rint(count / (n * n) * 255)
