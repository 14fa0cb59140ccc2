"""Small fused multilayer perceptrons."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import linear

from nerf_lightning.kernels import cpu, gpu
from nerf_lightning.kernels.activation import Activation, activate, truncated_exp
from nerf_lightning.kernels.backend import has_fast_kernel, has_gpu_kernel

Layers = Sequence[tuple[Float[Tensor, "_ _"], Float[Tensor, "_"]]]
"""Matrix [outputs, inputs] and bias [outputs] of each layer."""


def mlp_reference(x: Float[Tensor, "N I"], layers: Layers, extra: Float[Tensor, "N E"] | None = None) -> Tensor:
    """`mlp` in plain PyTorch, for every device and precision; `extra` may have gradients too."""
    h = x if extra is None else torch.cat([x, extra], dim=1)
    for matrix, bias in layers[:-1]:
        h = torch.relu(linear(h, matrix, bias))
    return linear(h, *layers[-1])


def _pad(width: int) -> int:
    return -(-width // 4) * 4


def _blocks(shapes: list[tuple[int, int]], row: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Views of matrices and biases in a flat array with all widths padded to multiples of 4."""
    blocks, start = [], 0
    for outputs, inputs in shapes:
        o, i = _pad(outputs), _pad(inputs)
        matrix = row[start : start + o * i].reshape(o, i)[:outputs, :inputs]
        blocks.append((matrix, row[start + o * i :][:outputs]))
        start += o * i + o
    return blocks


class _MLP(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x: Tensor, extra: Tensor, num_head: int, *flat: Tensor) -> tuple[Tensor, Tensor]:
        shapes = [(len(matrix), matrix.shape[1]) for matrix in flat[::2]]
        widths = np.array([_pad(n) for n in (shapes[0][1], *(outputs for outputs, _ in shapes))])
        row = np.zeros((widths[1:] * (widths[:-1] + 1)).sum(), np.float32)
        for block, matrix, bias in zip(_blocks(shapes, row), flat[::2], flat[1::2], strict=True):
            block[0][:], block[1][:] = matrix.detach().numpy(), bias.detach().numpy()
        x, extra = x.T.contiguous(), extra.T.contiguous()
        out = torch.empty(shapes[-1][0], x.shape[1])
        cpu.mlp.forward(row, widths, x, extra, out)
        ctx.save_for_backward(x, extra)
        ctx.network = shapes, widths, row
        return out[:num_head].T, out[num_head:].T

    @staticmethod
    def backward(ctx, *grads: Tensor) -> tuple[Tensor | None, ...]:
        x, extra = ctx.saved_tensors
        shapes, widths, row = ctx.network
        grad_x, sums = torch.empty_like(x), np.empty((cpu.jit.sync_num_threads(), len(row)), np.float32)
        cpu.mlp.backward(row, widths, x, extra, torch.cat([grad.T for grad in grads]), grad_x, sums)
        return grad_x.T, None, None, *(torch.tensor(part) for block in _blocks(shapes, sums.sum(0)) for part in block)


def mlp_heads(
    x: Float[Tensor, "N I"], layers: Layers, num_head: int, extra: Float[Tensor, "N E"] | None = None,
    activation: Activation = None, scale: float = 1.0,
) -> tuple[Float[Tensor, "N first"], Float[Tensor, "N rest"]]:  # fmt: skip
    """`mlp` that returns the first `num_head` outputs, with an activation divided by `scale`, and the rest separately."""
    parameters = [parameter for layer in layers for parameter in layer]
    rest = x.new_empty(len(x), 0) if extra is None else extra.detach()
    if has_fast_kernel(x, *parameters, rest):
        head, others = _MLP.apply(x, rest, num_head, *parameters)
    elif has_gpu_kernel(x, *parameters, rest) and gpu.mlp.is_supported(layers, rest.shape[1], x.device):
        if activation in gpu.mlp.ACTIVATIONS and (scale == 1 or activation is truncated_exp):
            return gpu.mlp.MLP.apply(x, rest, num_head, activation, scale, *parameters)
        head, others = gpu.mlp.MLP.apply(x, rest, num_head, None, 1.0, *parameters)
    else:
        out = mlp_reference(x, layers, rest)
        head, others = out[:, :num_head], out[:, num_head:]
    return activate(head, activation, scale), others


def mlp(
    x: Float[Tensor, "N I"], layers: Layers, extra: Float[Tensor, "N E"] | None = None, activation: Activation = None
) -> Float[Tensor, "N O"]:
    """Linear layers with ReLU between them.

    Args:
        x: inputs.
        layers: matrix [outputs, inputs] and bias of each layer.
        extra: further inputs after `x`, without gradient.
        activation: of the outputs.
    """
    return mlp_heads(x, layers, len(layers[-1][1]), extra, activation)[0]
