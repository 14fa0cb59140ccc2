"""Small multilayer perceptrons with one or two hidden layers: all layers in one kernel, forward and backward.

Matrices are read padded to powers of two. Products round their factors to TF32 and add in float32.
"""

from collections.abc import Sequence

import torch
import triton
import triton.language as tl
from torch import Tensor

from nerf_lightning.kernels.gpu.launch import kernel

BLOCK = 64
"""Inputs per program."""
MIN_WIDTH, MAX_WIDTH = 16, 64
"""Widths of a layer: the least that tensor cores multiply, the largest whose gradient does not spill registers."""
MIN_CAPABILITY = (8, 0)
"""Compute capability of the first GPUs with TF32."""


@triton.jit
def load_block(x, i, is_input, width, C: tl.constexpr):
    """Rows `i` of a matrix [_, width], padded with zeros to C columns."""
    column = tl.arange(0, C)[None, :]
    return tl.load(x + i[:, None] * width + column, is_input[:, None] & (column < width), 0.0)


@triton.jit
def store_block(x, block, i, is_input, width, C: tl.constexpr):
    """Writes the first columns of a block [B, C] to rows `i` of a matrix [_, width]."""
    column = tl.arange(0, C)[None, :]
    tl.store(x + i[:, None] * width + column, block, is_input[:, None] & (column < width))


@triton.jit
def load_transposed(weight, first, inputs, width, outputs, IN: tl.constexpr, OUT: tl.constexpr):
    """Columns first : first + inputs of a matrix [outputs, width], transposed and padded to [IN, OUT]."""
    i, o = tl.arange(0, IN)[:, None], tl.arange(0, OUT)[None, :]
    return tl.load(weight + o * width + first + i, (i < inputs) & (o < outputs), 0.0)


@triton.jit
def load_bias(bias, outputs, OUT: tl.constexpr):
    o = tl.arange(0, OUT)
    return tl.load(bias + o, o < outputs, 0.0)[None, :]


@triton.jit
def relu(h):
    return tl.maximum(h, 0.0, propagate_nan=tl.PropagateNan.ALL)


@triton.jit
def compute_hidden(
    x, extra, w1, b1, w2, b2, inputs, extras, hidden, TWO: tl.constexpr, IN: tl.constexpr, EX: tl.constexpr,
    HID: tl.constexpr,
):  # fmt: skip
    """Hidden layers [B, HID]; with one, it stands for both."""
    width = inputs + extras
    first = tl.dot(x, load_transposed(w1, 0, inputs, width, hidden, IN, HID), input_precision="tf32")
    if EX > 0:
        first += tl.dot(extra, load_transposed(w1, inputs, extras, width, hidden, EX, HID), input_precision="tf32")
    first = relu(first + load_bias(b1, hidden, HID))
    second = first
    if TWO:
        second = tl.dot(first, load_transposed(w2, 0, hidden, hidden, hidden, HID, HID), input_precision="tf32")
        second = relu(second + load_bias(b2, hidden, HID))
    return first, second


@triton.jit
def load_inputs(x, extra, i, is_input, inputs, extras, IN: tl.constexpr, EX: tl.constexpr):
    """Blocks of both inputs; the first stands for missing extra inputs."""
    block = load_block(x, i, is_input, inputs, IN)
    extra_block = block
    if EX > 0:
        extra_block = load_block(extra, i, is_input, extras, EX)
    return block, extra_block


@kernel(num_warps=8)
def propagate(
    x, extra, w1, b1, w2, b2, w3, b3, out, count, inputs, extras, hidden, outputs,
    TWO: tl.constexpr, IN: tl.constexpr, EX: tl.constexpr, HID: tl.constexpr, OUT: tl.constexpr, B: tl.constexpr,
):  # fmt: skip
    """Outputs of a network with the hidden layers 1 and, if TWO, 2; layer 3 is the last."""
    i = tl.program_id(0) * B + tl.arange(0, B)
    is_input = i < count
    block, extra_block = load_inputs(x, extra, i, is_input, inputs, extras, IN, EX)
    _, h = compute_hidden(block, extra_block, w1, b1, w2, b2, inputs, extras, hidden, TWO, IN, EX, HID)
    y = tl.dot(h, load_transposed(w3, 0, hidden, hidden, outputs, HID, OUT), input_precision="tf32")
    store_block(out, y + load_bias(b3, outputs, OUT), i, is_input, outputs, OUT)


@triton.jit
def add_bias_gradient(grad_bias, grad, outputs, OUT: tl.constexpr):
    o = tl.arange(0, OUT)
    tl.atomic_add(grad_bias + o, tl.sum(grad, axis=0), o < outputs, sem="relaxed")


@kernel(num_warps=8)
def differentiate(
    x, extra, w1, b1, w2, b2, w3, grad, grad_x, h1, h2, g1, g2, bias_gradients, count, inputs, extras, hidden, outputs,
    TWO: tl.constexpr, IN: tl.constexpr, EX: tl.constexpr, HID: tl.constexpr, OUT: tl.constexpr, B: tl.constexpr,
):  # fmt: skip
    """Gradients of inputs and biases, and the factors of the matrices' gradients: inputs h and gradients g of hidden layers."""
    i = tl.program_id(0) * B + tl.arange(0, B)
    is_input = i < count
    block, extra_block = load_inputs(x, extra, i, is_input, inputs, extras, IN, EX)
    first, second = compute_hidden(block, extra_block, w1, b1, w2, b2, inputs, extras, hidden, TWO, IN, EX, HID)
    above = load_block(grad, i, is_input, outputs, OUT)
    add_bias_gradient(bias_gradients + 2 * hidden, above, outputs, OUT)
    store_block(h2, second, i, is_input, hidden, HID)
    last = tl.trans(load_transposed(w3, 0, hidden, hidden, outputs, HID, OUT))
    above = tl.where(second <= 0, 0.0, tl.dot(above, last, input_precision="tf32"))
    if TWO:
        above = tl.where(is_input[:, None], above, 0.0)
        add_bias_gradient(bias_gradients + hidden, above, hidden, HID)
        store_block(g2, above, i, is_input, hidden, HID)
        store_block(h1, first, i, is_input, hidden, HID)
        middle = tl.trans(load_transposed(w2, 0, hidden, hidden, hidden, HID, HID))
        above = tl.where(first <= 0, 0.0, tl.dot(above, middle, input_precision="tf32"))
    above = tl.where(is_input[:, None], above, 0.0)
    add_bias_gradient(bias_gradients, above, hidden, HID)
    store_block(g1, above, i, is_input, hidden, HID)
    matrix = tl.trans(load_transposed(w1, 0, inputs, inputs + extras, hidden, IN, HID))
    store_block(grad_x, tl.dot(above, matrix, input_precision="tf32"), i, is_input, inputs, IN)


def pad_width(width: int) -> int:
    """Power of two that holds a layer's width; 0 for none."""
    return max(MIN_WIDTH, triton.next_power_of_2(width)) if width else 0


def is_supported(layers: Sequence[tuple[Tensor, Tensor]], num_extra: int, device: torch.device) -> bool:
    """Whether the kernel computes networks of these layers on a device."""
    hidden = len(layers[0][1])
    widths = layers[0][0].shape[1] - num_extra, num_extra, *(len(bias) for _, bias in layers)
    is_small = len(layers) in (2, 3) and max(widths) <= MAX_WIDTH and len(layers[-2][1]) == hidden
    return is_small and (device.type != "cuda" or torch.cuda.get_device_capability(device) >= MIN_CAPABILITY)


class MLP(torch.autograd.Function):
    """`kernels.mlp_heads`; parameters are each layer's matrix and bias."""

    @staticmethod
    def forward(ctx, x: Tensor, extra: Tensor, num_head: int, *parameters: Tensor):
        x, extra = x.contiguous(), extra.contiguous()
        parameters = tuple(p.contiguous() for p in parameters)
        hidden, outputs, is_deep = len(parameters[1]), len(parameters[-1]), len(parameters) == 6
        ctx.shape = len(x), x.shape[1], extra.shape[1], hidden, outputs
        names = zip(("IN", "EX", "HID", "OUT"), ctx.shape[1:], strict=True)
        ctx.constants = {"TWO": is_deep, **{name: pad_width(width) for name, width in names}, "B": BLOCK}
        out, middle = x.new_empty(len(x), outputs), parameters[2:4] if is_deep else parameters[:2]
        weights = *parameters[:2], *middle, *parameters[-2:]
        propagate((triton.cdiv(len(x), BLOCK),), x, extra, *weights, out, *ctx.shape, **ctx.constants)
        ctx.save_for_backward(x, extra, *weights[:5], parameters[-1])
        return out[:, :num_head], out[:, num_head:]

    @staticmethod
    def backward(ctx, *grads: Tensor):
        x, extra, *weights, last_bias = ctx.saved_tensors
        grad, (count, inputs, extras, hidden, outputs) = torch.cat(grads, dim=1), ctx.shape
        grad_x, (h1, h2, g1, g2) = torch.empty_like(x), x.new_empty(4, count, hidden)
        biases = x.new_zeros(2 * hidden + outputs)
        buffers = grad, grad_x, h1, h2, g1, g2, biases
        differentiate((triton.cdiv(count, BLOCK),), x, extra, *weights, *buffers, *ctx.shape, **ctx.constants)
        first = x.new_empty(hidden, inputs + extras)
        torch.mm(g1.T, x, out=first[:, :inputs])
        if extras:
            torch.mm(g1.T, extra, out=first[:, inputs:])
        middle = [g2.T @ h1, biases[hidden : 2 * hidden]] if ctx.constants["TWO"] else []
        return grad_x, None, None, first, biases[:hidden], *middle, grad.T @ h2, biases[2 * hidden :]
