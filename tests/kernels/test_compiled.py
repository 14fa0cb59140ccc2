import subprocess
import sys
from pathlib import Path

SCRIPT = """
import numba, torch
from nerf_lightning.kernels import voxel_value

torch.manual_seed(0)
torch.set_num_threads(1)
value = voxel_value(torch.randn(9**3 + 1), torch.arange(1, 9**3 + 1, dtype=torch.int32), torch.rand(999, 3))
print([x.hex() for x in value.tolist()])
print(torch.get_num_threads(), numba.get_num_threads())
"""


def test_what_was_just_compiled_rounds_as_what_comes_from_the_cache(tmp_path: Path, monkeypatch):
    """The first run on a machine compiles, later ones load: the same seed must give the same weights in both. Either way
    the first kernel takes no more threads than torch has, though numba's start sets threads for all that stands on OpenMP."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    found = []
    for _ in range(2):
        done = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True, check=True)
        found.append(done.stdout.splitlines())
        assert list(tmp_path.rglob("*.nbc")), "nothing was cached"
    assert found[0] == found[1] and found[0][1].split() == ["1", "1"]
