from itertools import pairwise

import pytest
import torch
from torch import Tensor

from nerf_lightning.kernels import mlp, mlp_heads
from tests.helpers.assert_close import assert_agrees, run_with_threads, values_and_gradients

WIDTHS = [(4, 4), (3, 5), (31, 3, 5), (16, 32, 16), (1, 1, 1), (5, 31, 3, 7), (12, 32, 32, 31, 3)]
"""Of input, hidden layers and output: one to four layers, filled up to fours and not."""


def network(widths: tuple[int, ...], further: int = 0) -> list[Tensor]:
    """Random matrix and bias of each layer, one after the other; the first also reads `further` inputs."""
    flat: list[Tensor] = []
    for index, (i, o) in enumerate(pairwise(widths)):
        i += further if index == 0 else 0
        flat += [torch.randn(o, i) / i**0.5, 0.3 * torch.randn(o)]
    return flat


def pairs(flat: tuple[Tensor, ...] | list[Tensor]) -> list[tuple[Tensor, Tensor]]:
    return list(zip(flat[::2], flat[1::2], strict=True))


def by_hand(x: list[float], flat: list[Tensor]) -> list[float]:
    layers = pairs(flat)
    for index, (matrix, bias) in enumerate(layers):
        rows = zip(matrix.tolist(), bias.tolist(), strict=True)
        x = [sum(w * v for w, v in zip(row, x, strict=True)) + b for row, b in rows]
        x = [max(v, 0.0) for v in x] if index < len(layers) - 1 else x
    return x


@pytest.mark.parametrize("widths", WIDTHS)
@pytest.mark.parametrize("further", [0, 3])
def test_a_network_agrees_with_a_loop_over_neurons(widths: tuple[int, ...], further: int, kernels: str):
    flat, x, extra = network(widths, further), torch.randn(6, widths[0]), torch.randn(6, further)
    expected = torch.tensor([by_hand(a + b, flat) for a, b in zip(x.tolist(), extra.tolist(), strict=True)])
    torch.testing.assert_close(mlp(x, pairs(flat), extra), expected, rtol=1e-4, atol=1e-5)
    if not further:
        assert torch.equal(mlp(x, pairs(flat)), mlp(x, pairs(flat), extra))


@pytest.mark.parametrize("widths", WIDTHS)
@pytest.mark.parametrize("further", [0, 3])
@pytest.mark.parametrize("samples", [0, 1, 128, 1000])
def test_a_network_agrees_with_the_reference(widths: tuple[int, ...], further: int, samples: int):
    inputs = [torch.randn(samples, further), torch.randn(samples, widths[0]), *network(widths, further)]
    assert_agrees(
        lambda extra, x, *flat: mlp(x, pairs(flat), extra if further else None),
        inputs,
        constants=(0,),
        atol=1e-5,
        any_threads=False,
    )


@pytest.mark.parametrize("first", [0, 1, 3])
def test_heads_are_the_outputs_taken_apart(first: int, kernels: str):
    flat, x, extra = network((12, 32, 7), 2), torch.randn(200, 12), torch.randn(200, 2)
    whole, (head, rest) = mlp(x, pairs(flat), extra), mlp_heads(x, pairs(flat), first, extra)
    assert head.shape == (200, first) and torch.equal(torch.cat([head, rest], dim=1), whole)


@pytest.mark.parametrize("samples", [0, 300])
def test_gradients_of_heads_agree_with_the_reference(samples: int):
    inputs = [torch.randn(samples, 12), *network((12, 32, 7))]
    assert_agrees(lambda x, *flat: mlp_heads(x, pairs(flat), 3), inputs, atol=1e-5, any_threads=False)
    # One of them alone: the other has no gradient to hand down.
    assert_agrees(lambda x, *flat: mlp_heads(x, pairs(flat), 3)[0], inputs, atol=1e-5, any_threads=False)
    assert_agrees(lambda x, *flat: mlp_heads(x, pairs(flat), 3)[1], inputs, atol=1e-5, any_threads=False)


def test_strides_do_not_matter(kernels: str):
    flat, x, extra = network((12, 32, 7), 2), torch.randn(12, 200), torch.randn(2, 200)
    copied = mlp(x.T.contiguous(), pairs(flat), extra.T.contiguous())
    torch.testing.assert_close(mlp(x.T, pairs(flat), extra.T), copied)
    torch.testing.assert_close(mlp(x.T, [(m.T.contiguous().T, b) for m, b in pairs(flat)], extra.T), copied)


def test_each_sample_is_its_own(kernels: str):
    """Wherever in a batch it stands, and whatever stands beside it."""
    flat, x = network((12, 32, 7)), torch.randn(300, 12)
    whole = mlp(x, pairs(flat))
    for part in (slice(0, 1), slice(100, 170), slice(200, 300)):
        torch.testing.assert_close(mlp(x[part], pairs(flat)), whole[part])


def test_further_inputs_are_constants(kernels: str):
    flat, x = network((4, 8, 2), 3), torch.randn(20, 4, requires_grad=True)
    extra = torch.randn(20, 3, requires_grad=True)
    mlp(x, pairs(flat), extra).sum().backward()
    assert extra.grad is None and x.grad.abs().max() > 0


def test_one_and_two_threads_agree_to_rounding():
    inputs = [torch.randn(1000, 12), *network((12, 32, 32, 7))]
    one, two = (
        run_with_threads(lambda: values_and_gradients(lambda x, *flat: mlp(x, pairs(flat)), inputs), n) for n in (1, 2)
    )
    assert torch.equal(one[0], two[0]) and torch.equal(one[1], two[1]), "samples do not share sums"
    for a, b in zip(one, two, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("widths", WIDTHS)
def test_an_input_that_is_not_a_number_shows(widths: tuple[int, ...], kernels: str):
    flat, x = [p.requires_grad_() for p in network(widths)], torch.randn(200, widths[0])
    usual = mlp(x, pairs(flat)).detach()
    x[[3, 150], -1] = float("nan")
    out = mlp(x, pairs(flat))
    assert out[[3, 150]].isnan().all()
    others = torch.ones(200, dtype=torch.bool)
    others[[3, 150]] = False
    assert torch.equal(out[others], usual[others])
    out.sum().backward()
    assert flat[0].grad[:, -1].isnan().any()


@pytest.mark.parametrize("which", range(4))
def test_a_weight_that_is_not_a_number_shows(which: int, kernels: str):
    flat = network((5, 6, 3))
    flat[which].view(-1)[-1] = float("nan")
    assert mlp(torch.randn(10, 5), pairs(flat)).isnan().any(1).all()
