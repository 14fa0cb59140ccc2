import os
import subprocess
import sys
from pathlib import Path

SCRIPT = """
import sys

import numba, torch
from nerf_lightning.kernels import voxel_value
from nerf_lightning.kernels.cpu.voxels import interpolate

torch.manual_seed(0)
torch.set_num_threads(1)
sys.executable = sys.argv[1]
value = voxel_value(torch.randn(9**3 + 1), torch.arange(1, 9**3 + 1, dtype=torch.int32), torch.rand(999, 3))
print([x.hex() for x in value.tolist()])
print(torch.get_num_threads(), numba.get_num_threads())
print(len(interpolate.stats.cache_hits), len(interpolate.stats.cache_misses))
"""


def lines(cache: Path, python: str = sys.executable) -> list[str]:
    """What the script prints with its kernels in that folder, where other processes start with that Python."""
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(cache)}
    command = [sys.executable, "-c", SCRIPT, python]
    return subprocess.run(command, capture_output=True, text=True, check=True, env=environment).stdout.splitlines()


def test_kernel_compiled_or_cached_rounds_alike(tmp_path: Path):
    """The same seed must give the same weights with both. A first run has another process compile, and then finds all kernels
    in the cache as later ones do; where no process can be started, it compiles them itself.

    Either way the first kernel takes no more threads than torch has, though numba's start sets threads for all that stands on
    OpenMP."""
    itself, apart = lines(tmp_path / "itself", "no_python"), lines(tmp_path / "apart")
    assert list((tmp_path / "itself").rglob("*.nbc")), "nothing was cached"
    assert (itself[2], apart[2]) == ("0 1", "1 0")
    assert itself[:2] == apart[:2] and itself[1] == "1 1"
