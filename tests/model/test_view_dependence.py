"""How finely colours depend on the direction: what each degree can tell apart."""

import pytest
import torch
from torch.nn.functional import normalize

from nerf_lightning.cameras import Bounds
from nerf_lightning.model import HashGridField, TensoRFField

BOX = Bounds(torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]]))


@pytest.mark.parametrize("degree", [0, 1, 3])
@pytest.mark.parametrize("kind", [TensoRFField, HashGridField])
def test_colours_vary_with_direction_up_to_degree(kind: type, degree: int, kernels: str):
    """Where every ReLU stays open, the logits of a colour are a polynomial of that degree in the direction: around a circle
    their Fourier series ends there."""
    field = kind(BOX, degree=degree, width=8)
    first, *others = field.colour_net
    first.bias.data += 4.0
    for layer in others:
        layer.weight.data -= layer.weight.data.mean(1, keepdim=True)  # so that the 4 is not seen behind it
        layer.bias.data.fill_(4.0 if layer is not others[-1] else 0.0)
    turn = torch.arange(16) * (2 * torch.pi / 16)
    plane = torch.linalg.qr(torch.randn(3, 2)).Q
    directions = normalize(torch.stack([turn.cos(), turn.sin()], dim=1) @ plane.T, dim=1)
    logits = torch.special.logit(field(torch.full((16, 3), 0.3), directions)[1].double())
    waves = torch.fft.rfft(logits - logits.mean(0), dim=0).abs()
    assert waves[degree + 1 :].max() < 1e-3
    assert degree == 0 or waves[degree].max() > 1e-2
