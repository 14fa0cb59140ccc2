"""Kernel selection."""

import pytest
import torch

from nerf_lightning.errors import InputError
from nerf_lightning.kernels import (
    composite,
    filter_visible,
    has_fast_kernel,
    merge_low_weight,
    set_kernels,
    spherical_harmonics,
)

RAY, OFFSETS = torch.tensor([0, 0, 1, 1]), torch.tensor([0, 2, 4])


def test_has_fast_kernel_requires_float32_on_cpu():
    x = torch.zeros(3)
    assert has_fast_kernel(x, torch.zeros(2, dtype=torch.int64))
    assert has_fast_kernel(x.clone().requires_grad_(), constants=(x,))
    assert (
        not has_fast_kernel(x, x.double())
        and not has_fast_kernel(x.to("meta"))
        and not has_fast_kernel(constants=(x.half(),))
    )
    assert not has_fast_kernel(x, constants=(x.clone().requires_grad_(),))
    with pytest.raises(InputError, match="kernels: found"):
        set_kernels("Auto")
    assert has_fast_kernel(x), "and nothing is switched"
    set_kernels("reference")
    assert not has_fast_kernel(x)


def test_kernels_input_without_fast_gradient_gets_gradient():
    x = torch.rand(4).requires_grad_()
    c, rgb = torch.rand(4), torch.rand(4, 3)
    for out in (
        composite(c, rgb, c, x, RAY, OFFSETS)[0],
        filter_visible(c, (c, x, RAY, OFFSETS), 1e-4, 0.0)[1][1],
        merge_low_weight(x, (c, c, RAY, OFFSETS), 0.1)[0],
        spherical_harmonics(x[:3, None].T),
    ):
        assert torch.autograd.grad(out.sum(), x)[0].any()
