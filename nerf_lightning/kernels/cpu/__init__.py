"""Fast versions for CPUs, compiled by numba on first use and kept on disk; see the modules one level up for what each does.

Here features and coordinates come first and samples last ([F, N]), so that loops over samples are long and contiguous.
Work is cut by the number of threads alone, never by chance or by load: the same seed and threads give the same bits.
"""

from nerf_lightning.kernels.cpu.compile import workers

__all__ = ["workers"]
