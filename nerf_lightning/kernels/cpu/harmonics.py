"""Real spherical harmonics of degrees 0 to 3 (Sloan 2013, appendix A2)."""

from numba import float32, prange

from nerf_lightning.kernels.cpu.jit import kernel

C0, C1 = float32(0.28209479177387814), float32(0.48860251190291987)
C2A, C2B, C2C = float32(1.0925484305920792), float32(0.31539156525252005), float32(0.5462742152960396)
C3A, C3B, C3C = float32(0.5900435899266435), float32(2.890611442640554), float32(0.4570457994644657)
C3D, C3E = float32(0.3731763325901154), float32(1.445305721320277)


@kernel
def evaluate(directions, out):
    """Fills out [16, N] for unit directions [N, 3]."""
    one, three, five = float32(1), float32(3), float32(5)
    for n in prange(len(directions)):
        x, y, z = directions[n, 0], directions[n, 1], directions[n, 2]
        xx, yy, zz = x * x, y * y, z * z
        out[0, n] = C0
        out[1, n] = -C1 * y
        out[2, n] = C1 * z
        out[3, n] = -C1 * x
        out[4, n] = C2A * x * y
        out[5, n] = -C2A * y * z
        out[6, n] = C2B * (three * zz - one)
        out[7, n] = -C2A * x * z
        out[8, n] = C2C * (xx - yy)
        out[9, n] = -C3A * y * (three * xx - yy)
        out[10, n] = C3B * x * y * z
        out[11, n] = -C3C * y * (five * zz - one)
        out[12, n] = C3D * z * (five * zz - three)
        out[13, n] = -C3C * x * (five * zz - one)
        out[14, n] = C3E * z * (xx - yy)
        out[15, n] = -C3A * x * (xx - three * yy)
