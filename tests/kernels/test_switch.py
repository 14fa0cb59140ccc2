"""Which version of a kernel runs."""

import pytest
import torch

from nerf_lightning.errors import InputError
from nerf_lightning.kernels import composite, has_fast, keep_visible, merge_faint, spherical_harmonics, use_kernels

RAY, OFFSETS = torch.tensor([0, 0, 1, 1]), torch.tensor([0, 2, 4])


def test_has_fast_single_precision_of_cpu_and_allowed():
    x = torch.zeros(3)
    assert has_fast(x, torch.zeros(2, dtype=torch.int64)) and has_fast(x.clone().requires_grad_(), constants=(x,))
    assert not has_fast(x, x.double()) and not has_fast(x.to("meta")) and not has_fast(constants=(x.half(),))
    assert not has_fast(x, constants=(x.clone().requires_grad_(),))
    with pytest.raises(InputError, match="kernels: found"):
        use_kernels("Auto")
    assert has_fast(x), "and nothing is switched"
    use_kernels("reference")
    assert not has_fast(x)


def test_kernels_input_without_fast_gradient_gets_gradient():
    x = torch.rand(4).requires_grad_()
    c, rgb = torch.rand(4), torch.rand(4, 3)
    for out in (
        composite(c, rgb, c, x, RAY, OFFSETS)[0],
        keep_visible(c, (c, x, RAY, OFFSETS), 1e-4, 0.0)[1][1],
        merge_faint(x, (c, c, RAY, OFFSETS), 0.1)[0],
        spherical_harmonics(x[:3, None].T),
    ):
        assert torch.autograd.grad(out.sum(), x)[0].any()
