"""Which version of a kernel runs."""

from collections.abc import Callable
from contextlib import nullcontext
from importlib import import_module
from pathlib import Path

import pytest
import torch
from torch import Tensor

from nerf_lightning import kernels as k
from nerf_lightning.cameras import Bounds, Rays
from nerf_lightning.config.compose import composed
from nerf_lightning.errors import InputError
from nerf_lightning.training import train as training

RAY, OFFSETS = torch.tensor([0, 0, 1, 1]), torch.tensor([0, 2, 4])


def layers(x: Tensor) -> list[tuple[Tensor, Tensor]]:
    return [(x.new_ones(o, i), x.new_ones(o)) for i, o in ((6, 5), (5, 2))]


def box(x: Tensor) -> Bounds:
    return Bounds(torch.stack([-x.new_ones(3), x.new_ones(3)]))


def march(x: Tensor, c: Tensor):
    ends = c[:, 0]
    return k.march(Rays(x, c), box(c), 0 * ends, ends, 0 * ends, torch.ones(8, dtype=torch.bool), 4, 0.1)


def mark_cells(x: Tensor, c: Tensor):
    k.mark_cells(torch.zeros(8, dtype=torch.int32), 1, box(c), x)


# What to call with numbers x [4, 3] and c, the same as constants; the entry point it runs; whether that gives all gradients.
CASES: dict[str, tuple[Callable[[Tensor, Tensor], object], str, bool]] = {
    "tables": (lambda x, c: k.hash_interpolate(x, c, [(1, 1, 1)], [4]), "hashgrid.interpolate", True),
    "positions": (lambda x, c: k.hash_interpolate(c, x, [(1, 1, 1)], [4]), "hashgrid.interpolate", True),
    "mlp": (lambda x, c: k.mlp(x, layers(c), c), "mlp.forward", True),
    "mlp_heads": (lambda x, c: k.mlp_heads(x, layers(c), 1, c), "mlp.forward", True),
    "density": (lambda x, c: k.composite(x[:, 0], x, c[:, 1], c[:, 2], RAY, OFFSETS), "composite.forward", True),
    "distances": (lambda x, c: k.composite(c[:, 0], c, x[:, 1], c[:, 2], RAY, OFFSETS), "composite.forward", False),
    "lengths": (lambda x, c: k.composite(c[:, 0], c, c[:, 1], x[:, 2], RAY, OFFSETS), "composite.forward", False),
    "visible distances": (
        lambda x, c: k.keep_visible(c[:, 0], (x[:, 1], c[:, 2], RAY, OFFSETS), 1e-4, 0.0), "composite.visible", False,
    ),
    "visible lengths": (
        lambda x, c: k.keep_visible(c[:, 0], (c[:, 1], x[:, 2], RAY, OFFSETS), 1e-4, 0.0), "composite.visible", False,
    ),
    "merged thickness": (lambda x, c: k.merge_faint(x[:, 0], (c[:, 1], c[:, 2], RAY, OFFSETS), 0.1), "merge.pair", False),
    "march": (march, "march.walk", False),
    "mark_cells": (mark_cells, "march.mark", True),
    "points of rays": (lambda x, c: k.points(x, c, RAY, c[:, 0]), "march.points", True),
    "points at distances": (lambda x, c: k.points(c, c, RAY, x[:, 0]), "march.points", False),
    "spherical_harmonics": (lambda x, c: k.spherical_harmonics(x), "harmonics.evaluate", False),
}  # fmt: skip
EACH = pytest.mark.parametrize("case", CASES)


class Reached(Exception):
    """A compiled kernel was called."""


@pytest.fixture
def call(case: str, monkeypatch: pytest.MonkeyPatch):
    """The case's call; it raises `Reached` where the fast version is chosen."""

    def stop(*args):
        raise Reached

    run, compiled, _ = CASES[case]
    module, name = compiled.split(".")
    monkeypatch.setattr(import_module(f"nerf_lightning.kernels.cpu.{module}"), name, stop)
    return lambda x: run(x, x.detach())


@EACH
def test_the_fast_version_is_taken_in_single_precision_unless_the_reference_is_asked_for(case: str, call):
    x = 0.1 + torch.rand(4, 3)
    with pytest.raises(Reached):
        call(x)
    with torch.no_grad(), pytest.raises(Reached):
        call(x)
    call(x.double())
    k.use_kernels("reference")
    call(x)


@EACH
def test_gradients_that_the_fast_version_lacks_come_from_the_reference(case: str, call):
    x = (0.1 + torch.rand(4, 3)).requires_grad_()
    with pytest.raises(Reached) if CASES[case][2] else nullcontext():
        call(x)


@pytest.mark.parametrize("choice", ["other", "", "fast", "Auto"])
def test_other_kernels_are_refused(choice: str):
    with pytest.raises(InputError, match="kernels: found .*, expected auto or reference"):
        k.use_kernels(choice)
    assert k.fast(torch.zeros(1)), "and nothing is switched"


def test_whole_numbers_have_no_precision():
    assert k.fast(torch.zeros(1), RAY) and not k.fast(torch.zeros(1).double(), RAY)
    assert not k.fast(torch.zeros(1), torch.zeros(1, device="meta"))


@pytest.mark.parametrize("choice", ["auto", "reference"])
def test_a_run_sets_its_kernels(choice: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    class Enough(Exception):
        pass

    def stop(cfg):
        raise Enough

    monkeypatch.setattr(training, "build_data", stop)
    k.use_kernels("reference" if choice == "auto" else "auto")
    with pytest.raises(Enough):
        training.train(composed(["+experiment=smoke_3d", f"kernels={choice}"], tmp_path))
    assert k.fast(torch.zeros(1)) == (choice == "auto")


def test_a_run_refuses_other_kernels(tmp_path: Path):
    with pytest.raises(InputError, match="kernels: found 'gpu'"):
        training.train(composed(["+experiment=smoke_3d", "kernels=gpu"], tmp_path))
    assert not list(tmp_path.iterdir()), "before anything is written"
