from itertools import pairwise

import pytest
import torch
from torch import Tensor

from nerf_lightning.kernels import mlp
from tests.helpers.kernel_comparison import run_with_threads, values_and_gradients


def network(widths: tuple[int, ...], further: int = 0) -> list[Tensor]:
    """Random matrices and biases of all layers, flat; the first layer has `further` extra inputs."""
    flat: list[Tensor] = []
    for index, (i, o) in enumerate(pairwise(widths)):
        i += further if index == 0 else 0
        flat += [torch.randn(o, i) / i**0.5, 0.3 * torch.randn(o)]
    return flat


def pairs(flat: tuple[Tensor, ...] | list[Tensor]) -> list[tuple[Tensor, Tensor]]:
    return list(zip(flat[::2], flat[1::2], strict=True))


def brute_force(x: list[float], flat: list[Tensor]) -> list[float]:
    layers = pairs(flat)
    for index, (matrix, bias) in enumerate(layers):
        rows = zip(matrix.tolist(), bias.tolist(), strict=True)
        x = [sum(w * v for w, v in zip(row, x, strict=True)) + b for row, b in rows]
        x = [max(v, 0.0) for v in x] if index < len(layers) - 1 else x
    return x


@pytest.mark.parametrize(
    ("widths", "further"), [((4, 4), 3), ((31, 3, 5), 0), ((1, 1, 1), 3), ((5, 31, 3, 7), 0), ((12, 32, 32, 31, 3), 3)]
)
def test_mlp_any_widths_match_loop_over_neurons(widths: tuple[int, ...], further: int, kernels: str):
    flat, x, extra = network(widths, further), torch.randn(6, widths[0]), torch.randn(6, further)
    expected = torch.tensor([brute_force(a + b, flat) for a, b in zip(x.tolist(), extra.tolist(), strict=True)])
    torch.testing.assert_close(mlp(x, pairs(flat), extra), expected, rtol=1e-4, atol=1e-5)
    if not further:
        assert torch.equal(mlp(x, pairs(flat)), mlp(x, pairs(flat), extra))


def test_mlp_one_and_two_threads_agree():
    inputs = [torch.randn(1000, 12), *network((12, 32, 32, 7))]
    one, two = (
        run_with_threads(lambda: values_and_gradients(lambda x, *flat: mlp(x, pairs(flat)), inputs), n) for n in (1, 2)
    )
    assert torch.equal(one[0], two[0]) and torch.equal(one[1], two[1]), "sums depend on threads"
    for a, b in zip(one, two, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-4)
