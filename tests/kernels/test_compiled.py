import subprocess
import sys
from pathlib import Path

SCRIPT = """
import torch
from nerf_lightning.kernels import voxel_value

torch.manual_seed(0)
torch.set_num_threads(1)
value = voxel_value(torch.randn(9**3 + 1), torch.arange(1, 9**3 + 1, dtype=torch.int32), torch.rand(999, 3))
print([x.hex() for x in value.tolist()])
"""


def test_what_was_just_compiled_rounds_as_what_comes_from_the_cache(tmp_path: Path, monkeypatch):
    """The first run on a machine compiles, later ones load: the same seed must give the same weights in both."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    found = []
    for _ in range(2):
        found.append(subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True, check=True).stdout)
        assert list(tmp_path.rglob("*.nbc")), "nothing was cached"
    assert found[0] == found[1]
