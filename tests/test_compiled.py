"""Training with torch.compile: the same values, gradients and quality, and one line where it cannot be had."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from nerf_lightning.errors import InputError
from nerf_lightning.system.compiled import BACKEND, check_compiler
from nerf_lightning.utils.device import CPU
from tests.helpers.shared_fixtures import make_once

ROOT = Path(__file__).resolve().parents[1]
SOME, OTHERS = ("mlp", "voxels"), ("hashgrid", "tensorf")
"""Fields: one that the renderer is compiled with, one that grows; and the others, for `make long`."""
RUN = ("+experiment=smoke_2d", "device=cpu")


def compiling(cache: Path, *what: str) -> dict:
    """What compile_models.py found."""
    line = [sys.executable, str(ROOT / "tests" / "helpers" / "compile_models.py"), *what]
    paths = {"PYTHONPATH": str(ROOT), "TORCHINDUCTOR_CACHE_DIR": str(cache)}
    done = subprocess.run(line, env={**os.environ, **paths}, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


@pytest.fixture(scope="session")
def found(tmp_path_factory: pytest.TempPathFactory, own_cache: None) -> dict:
    return make_once(tmp_path_factory, "compiled", lambda folder: compiling(folder / "kernels", *SOME, str(folder)))


def same(field: dict) -> None:
    assert field["worst"] < 1e-4 and field["compiled"] >= 2
    assert field["again"] == 0, "a copy of it, or a batch of another size, was compiled anew"


@pytest.mark.parametrize("name", SOME)
def test_compiled_field_matches_plain_one(name: str, found: dict):
    same(found[name])


@pytest.mark.long
def test_compiled_other_fields_match_plain_ones(tmp_path: Path):
    found = compiling(tmp_path, *OTHERS)
    assert set(found) == set(OTHERS)
    for field in found.values():
        same(field)


@pytest.mark.long
def test_compiled_inductor_kernels_match_plain_field(tmp_path: Path):
    same(compiling(tmp_path, "whole"))


def test_compiled_training_is_as_good(found: dict):
    compiled, plain = found["trained"]
    assert compiled == pytest.approx(plain, abs=0.05)


@pytest.fixture
def no_compiler(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch._inductor.config.cpp, "cxx", ("no_such_compiler",))


def test_missing_compiler_is_one_line_and_writes_nothing(no_compiler: None, inside, tmp_path: Path):
    with pytest.raises(InputError, match="config: compile: found true, but .*expected a C.. compiler.*compile=false"):
        check_compiler(CPU, BACKEND)
    code, _, err = inside(*RUN, "compile=true")
    assert code == 2 and err.count("\n") == 1 and "compile: found true, but" in err, err
    assert not list(tmp_path.rglob("*"))
