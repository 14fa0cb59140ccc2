"""Training with torch.compile: the same values, gradients and quality, and a one-line error if unavailable."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from nerf_lightning.errors import InputError
from nerf_lightning.system.torch_compile import COMPILE_BACKEND, check_compiler
from nerf_lightning.utils.device import CPU

ROOT = Path(__file__).resolve().parents[1]
HELPER = ROOT / "tests" / "helpers" / "compile_models.py"


@pytest.mark.parametrize(
    ("backend", "names"),
    [
        ("aot_eager", ["mlp", "voxels"]),  # with the compiled renderer, and growing
        pytest.param("aot_eager", ["hashgrid", "tensorf"], marks=pytest.mark.long),
        pytest.param(COMPILE_BACKEND, ["voxels"], marks=pytest.mark.long),
    ],
)
def test_compiled_fields_and_training_match_plain_ones(backend: str, names: list[str], tmp_path: Path):
    paths = {"PYTHONPATH": str(ROOT), "TORCHINDUCTOR_CACHE_DIR": str(tmp_path)}
    line = [sys.executable, str(HELPER), backend, str(tmp_path), *names]
    done = subprocess.run(line, env={**os.environ, **paths}, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout.splitlines()[-1])
    assert list(found["fields"]) == names
    for name, field in found["fields"].items():
        assert field["worst"] < 1e-4 and field["compiled"] >= 2, name
        assert field["again"] == 0, f"{name}: a copy of it, or a batch of another size, was compiled anew"
    compiled, plain = found["trained"]
    assert compiled == pytest.approx(plain, abs=0.05)


def test_missing_compiler_is_one_line_and_writes_nothing(run_cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(torch._inductor.config.cpp, "cxx", ("no_such_compiler",))
    with pytest.raises(InputError, match="config: compile: a C.. compiler is missing .*compile=false"):
        check_compiler(CPU, COMPILE_BACKEND)
    code, _, err = run_cli("+experiment=smoke_2d", "device=cpu", "compile=true")
    assert code == 2 and err.count("\n") == 1 and "compile: a C++ compiler is missing" in err, err
    assert not list(tmp_path.rglob("*"))
