"""Kernels keep to the threads that were asked for."""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PROBE = """
import numba, torch
from nerf_lightning.kernels import spherical_harmonics
torch.set_num_threads(1)
spherical_harmonics(torch.randn(100, 3))
print(torch.get_num_threads(), numba.get_num_threads())
"""


def test_the_first_kernel_takes_no_more_threads_than_torch_has():
    """In a process of its own: it is numba's first start that sets threads for all that stands on the same OpenMP."""
    done = subprocess.run([sys.executable, "-c", PROBE], cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert done.stdout.split() == ["1", "1"], done.stderr
