"""Which version of a kernel runs."""

from collections.abc import Callable
from contextlib import nullcontext
from importlib import import_module

import pytest
import torch
from torch import Tensor

from nerf_lightning import kernels as k
from nerf_lightning.cameras import Bounds, Rays
from nerf_lightning.errors import InputError

RAY, OFFSETS = torch.tensor([0, 0, 1, 1]), torch.tensor([0, 2, 4])


def layers(x: Tensor) -> list[tuple[Tensor, Tensor]]:
    return [(x.new_ones(o, i), x.new_ones(o)) for i, o in ((6, 5), (5, 2))]


def box(x: Tensor) -> Bounds:
    return Bounds(torch.stack([-x.new_ones(3), x.new_ones(3)]))


def march(x: Tensor, c: Tensor):
    ends = c[:, 0]
    return k.march(Rays(x, c), box(c), 0 * ends, ends, 0 * ends, torch.ones(8, dtype=torch.bool), 4, 0.1)


# What to call with numbers x [4, 3] and c, the same as constants; the entry point it runs; whether that gives all gradients.
CASES: dict[str, tuple[Callable[[Tensor, Tensor], object], str, bool]] = {
    "tables": (lambda x, c: k.hash_interpolate(x, c, [(1, 1, 1)], [4]), "hashgrid.interpolate", True),
    "positions": (lambda x, c: k.hash_interpolate(c, x, [(1, 1, 1)], [4]), "hashgrid.interpolate", True),
    "mlp_heads": (lambda x, c: k.mlp_heads(x, layers(c), 1, c), "mlp.forward", True),
    "density": (lambda x, c: k.composite(x[:, 0], x, c[:, 1], c[:, 2], RAY, OFFSETS), "composite.forward", True),
    "lengths": (lambda x, c: k.composite(c[:, 0], c, c[:, 1], x[:, 2], RAY, OFFSETS), "composite.forward", False),
    "visible": (
        lambda x, c: k.keep_visible(c[:, 0], (x[:, 1], c[:, 2], RAY, OFFSETS), 1e-4, 0.0), "composite.visible", False,
    ),
    "merge_faint": (lambda x, c: k.merge_faint(x[:, 0], (c[:, 1], c[:, 2], RAY, OFFSETS), 0.1), "merge.pair", False),
    "march": (march, "march.walk", False),
    "points": (lambda x, c: k.points(x, c, RAY, c[:, 0]), "march.points", True),
    "spherical_harmonics": (lambda x, c: k.spherical_harmonics(x), "harmonics.evaluate", False),
}  # fmt: skip


class Reached(Exception):
    """A compiled kernel was called."""


@pytest.mark.parametrize("case", CASES)
def test_kernel_precision_and_choice_select_version(case: str, monkeypatch: pytest.MonkeyPatch):
    """The fast one in single precision, unless it lacks the gradient or the reference is asked for."""

    def stop(*args):
        raise Reached

    run, compiled, has_gradient = CASES[case]
    module, name = compiled.split(".")
    monkeypatch.setattr(import_module(f"nerf_lightning.kernels.cpu.{module}"), name, stop)
    x = 0.1 + torch.rand(4, 3)
    with pytest.raises(Reached):
        run(x, x)
    with pytest.raises(Reached) if has_gradient else nullcontext():
        run(x.clone().requires_grad_(), x)
    run(x.double(), x.double())
    k.use_kernels("reference")
    run(x, x)


def test_use_kernels_unknown_choice_is_refused():
    with pytest.raises(InputError, match="kernels: found"):
        k.use_kernels("Auto")
    assert k.fast(torch.zeros(1)), "and nothing is switched"
