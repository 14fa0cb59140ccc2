"""Real spherical harmonics of degrees 0 to 3 (Sloan 2013, appendix A2)."""

import numpy as np
from numba import float32, prange

from nerf_lightning.kernels.cpu.jit import kernel
from nerf_lightning.kernels.cpu.mlp import TILE, copy_columns

C0, C1 = float32(0.28209479177387814), float32(0.48860251190291987)
C2A, C2B, C2C = float32(1.0925484305920792), float32(0.31539156525252005), float32(0.5462742152960396)
C3A, C3B, C3C = float32(0.5900435899266435), float32(2.890611442640554), float32(0.4570457994644657)
C3D, C3E = float32(0.3731763325901154), float32(1.445305721320277)


@kernel
def evaluate(directions, out):
    """Fills out [16, N], in tiles, for unit directions [N, 3]."""
    one, three, five = float32(1), float32(3), float32(5)
    for index in prange((len(directions) + TILE - 1) // TILE):
        first = index * TILE
        count = min(TILE, len(directions) - first)
        axes, tile = np.zeros((3, TILE), np.float32), np.empty((16, TILE), np.float32)
        for n in range(count):
            direction = directions[first + n]
            axes[0, n], axes[1, n], axes[2, n] = direction[0], direction[1], direction[2]
        for n in range(TILE):
            x, y, z = axes[0, n], axes[1, n], axes[2, n]
            xx, yy, zz = x * x, y * y, z * z
            tile[0, n] = C0
            tile[1, n] = -C1 * y
            tile[2, n] = C1 * z
            tile[3, n] = -C1 * x
            tile[4, n] = C2A * x * y
            tile[5, n] = -C2A * y * z
            tile[6, n] = C2B * (three * zz - one)
            tile[7, n] = -C2A * x * z
            tile[8, n] = C2C * (xx - yy)
            tile[9, n] = -C3A * y * (three * xx - yy)
            tile[10, n] = C3B * x * y * z
            tile[11, n] = -C3C * y * (five * zz - one)
            tile[12, n] = C3D * z * (five * zz - three)
            tile[13, n] = -C3C * x * (five * zz - one)
            tile[14, n] = C3E * z * (xx - yy)
            tile[15, n] = -C3A * x * (xx - three * yy)
        copy_columns(tile, 0, out, first, count)
