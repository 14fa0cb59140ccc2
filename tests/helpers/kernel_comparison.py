"""Comparing a fast kernel with its reference: values, and gradients where there are any."""

from collections.abc import Callable
from typing import TypeVar

import torch
from torch import Tensor

from nerf_lightning.kernels import set_kernels

T = TypeVar("T")


def values_and_gradients(
    call: Callable[..., object], inputs: list[Tensor], constants: tuple[int, ...] = ()
) -> list[Tensor]:
    """What `call` returns, then the gradient of a random sum of it with respect to each floating input.

    Args:
        constants: numbers of inputs that take no gradient.
    """
    copies = [x.detach().clone() for x in inputs]
    free = [x.requires_grad_() for i, x in enumerate(copies) if x.is_floating_point() and i not in constants]
    values = call(*copies)
    outputs = [values] if isinstance(values, Tensor) else list(values)
    above = torch.Generator().manual_seed(7)
    sums = [(x * torch.randn(x.shape, generator=above)).sum() for x in outputs if x.requires_grad]
    return [x.detach() for x in outputs] + (list(torch.autograd.grad(sum(sums), free)) if sums else [])


def assert_matches_reference(
    call: Callable[..., object], inputs: list[Tensor], constants: tuple[int, ...] = (), rtol: float = 1e-4,
    atol: float = 1e-6, same_with_any_threads: bool = True,
) -> None:  # fmt: skip
    """The fast version gives what the reference gives, in each of its values and gradients, and twice the same bits.

    Args:
        atol: share of each tensor's largest value, or of one: single precision adds up in another order.
        same_with_any_threads: whether the bits are also the same with another number of threads.
    """
    set_kernels("reference")
    expected = values_and_gradients(call, inputs, constants)
    set_kernels("auto")
    threads = torch.get_num_threads()
    other = threads if not same_with_any_threads else 2 if threads == 1 else 1
    first = values_and_gradients(call, inputs, constants)
    again = run_with_threads(lambda: values_and_gradients(call, inputs, constants), other)
    assert len(first) == len(expected)
    for number, (got, repeated, wanted) in enumerate(zip(first, again, expected, strict=True)):
        assert got.dtype == wanted.dtype and got.shape == wanted.shape, number
        assert torch.equal(got, repeated), f"{number}: not the same bits"
        scale = max(float(wanted.abs().max()), 1.0) if wanted.numel() else 1.0
        torch.testing.assert_close(got, wanted, rtol=rtol, atol=atol * scale, msg=lambda m, n=number: f"{n}: {m}")


def run_with_threads(call: Callable[[], T], threads: int) -> T:
    """What `call` gives with this number of threads."""
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        return call()
    finally:
        torch.set_num_threads(before)
