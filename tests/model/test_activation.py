import math

import pytest
import torch

from nerf_lightning.model import density_activation, truncated_exp


def test_truncated_exp_any_input_keeps_gradient():
    x = torch.tensor([-1e4, -20.0, -1.0, 0.0, 3.0, 15.0, 16.0, 1e4], requires_grad=True)
    y = truncated_exp(x)
    torch.testing.assert_close(y, torch.tensor([math.exp(min(v, 15)) for v in x.tolist()]))
    y.sum().backward()
    torch.testing.assert_close(x.grad, torch.tensor([math.exp(max(-15, min(v, 15))) for v in x.tolist()]))
    assert (x.grad > 0).all(), "neither vanishes"
    assert torch.autograd.gradcheck(truncated_exp, torch.linspace(-10, 10, 9).double().requires_grad_())


@pytest.mark.parametrize(
    ("name", "at_zero", "at_three"),
    [("relu", 0.0, 3.0), ("softplus", math.log1p(math.exp(-1)), math.log1p(math.exp(2))), ("exp", 1.0, math.exp(3))],
)
def test_density_activation_any_name_gives_formula(name, at_zero, at_three):
    values = density_activation(name)(torch.tensor([0.0, 3.0, -5.0]))
    torch.testing.assert_close(values[:2], torch.tensor([at_zero, at_three]))
    assert values.min() >= 0


@pytest.mark.parametrize(("name", "dtype"), [("softplus", torch.float16), ("exp", torch.bfloat16)])
def test_density_activation_half_precision_stays_finite(name: str, dtype: torch.dtype):
    x = torch.tensor([-1e4, -20.0, 0.0, 12.0, 1e4], dtype=dtype, requires_grad=True)
    values = density_activation(name)(x)
    values.float().sum().backward()
    assert values.isfinite().all() and x.grad.isfinite().all()
    assert values[3] > 0.9 * (11 if name == "softplus" else math.exp(12)), "e^12 is beyond half precision"
