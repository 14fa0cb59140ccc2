"""Small multilayer perceptrons with one or two hidden layers: all layers in one kernel, forward and backward.

Matrices are read padded to powers of two. Products round their factors to TF32 and add in float32. The first outputs, the head,
may have an activation.
"""

from collections.abc import Sequence
from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

from nerf_lightning.kernels.activation import truncated_exp
from nerf_lightning.kernels.gpu.launch import kernel

BLOCK = 64
"""Inputs per program."""
MIN_WIDTH, MAX_WIDTH = 16, 64
"""Widths of a layer: the least that tensor cores multiply, the largest whose gradient does not spill registers."""
MIN_CAPABILITY = (8, 0)
"""Compute capability of the first GPUs with TF32."""
ACTIVATIONS: dict[Any, str] = {None: "none", truncated_exp: "exp", torch.sigmoid: "sigmoid"}
"""Names of the activations that the kernels compute."""


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
def point_at_rest(rest, i, is_input, heads, outputs, C: tl.constexpr):
    """Pointers to rows `i` of the outputs behind the head, at their columns among all outputs; and which of them exist."""
    column = tl.arange(0, C)[None, :]
    is_rest = is_input[:, None] & (column >= heads) & (column < outputs)
    return rest + i[:, None] * (outputs - heads) + column - heads, is_rest


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
def exponentiate(x, scale):
    """`truncated_exp` divided by a scale."""
    return tl.exp(tl.minimum(x, 15.0, tl.PropagateNan.ALL)) / scale


@triton.jit
def exp_slope(value, scale):
    """Derivative of `exponentiate` where it has this value."""
    return tl.maximum(value, tl.exp(tl.zeros_like(value) - 15.0) / scale, tl.PropagateNan.ALL)


@triton.jit
def relu(h):
    return tl.maximum(h, 0.0, propagate_nan=tl.PropagateNan.ALL)


@triton.jit
def compute_hidden(
    x, extra, i, is_input, w1, b1, w2, b2, inputs, extras, hidden, TWO: tl.constexpr, IN: tl.constexpr,
    EX: tl.constexpr, HID: tl.constexpr,
):  # fmt: skip
    """Hidden layers [B, HID]; with one, it stands for both."""
    width, block = inputs + extras, load_block(x, i, is_input, inputs, IN)
    first = tl.dot(block, load_transposed(w1, 0, inputs, width, hidden, IN, HID), input_precision="tf32")
    if EX > 0:
        columns = load_transposed(w1, inputs, extras, width, hidden, EX, HID)
        first += tl.dot(load_block(extra, i, is_input, extras, EX), columns, input_precision="tf32")
    first = relu(first + load_bias(b1, hidden, HID))
    second = first
    if TWO:
        second = tl.dot(first, load_transposed(w2, 0, hidden, hidden, hidden, HID, HID), input_precision="tf32")
        second = relu(second + load_bias(b2, hidden, HID))
    return first, second


@kernel(num_warps=8)
def propagate(
    x, extra, w1, b1, w2, b2, w3, b3, head, rest, count, inputs, extras, hidden, outputs, heads, scale,
    ACTIVATION: tl.constexpr, TWO: tl.constexpr, IN: tl.constexpr, EX: tl.constexpr, HID: tl.constexpr,
    OUT: tl.constexpr, B: tl.constexpr,
):  # fmt: skip
    """Head and further outputs of a network with the hidden layers 1 and, if TWO, 2; layer 3 is the last."""
    i = tl.program_id(0) * B + tl.arange(0, B)
    is_input = i < count
    _, h = compute_hidden(x, extra, i, is_input, w1, b1, w2, b2, inputs, extras, hidden, TWO, IN, EX, HID)
    y = tl.dot(h, load_transposed(w3, 0, hidden, hidden, outputs, HID, OUT), input_precision="tf32")
    y += load_bias(b3, outputs, OUT)
    pointers, is_rest = point_at_rest(rest, i, is_input, heads, outputs, OUT)
    tl.store(pointers, y, is_rest)
    if ACTIVATION == "exp":
        y = exponentiate(y, scale)
    elif ACTIVATION == "sigmoid":
        y = 1 / (1 + tl.exp(tl.minimum(-y, 80.0, tl.PropagateNan.ALL)))
    store_block(head, y, i, is_input, heads, OUT)


@triton.jit
def add_bias_gradient(grad_bias, grad, outputs, OUT: tl.constexpr):
    o = tl.arange(0, OUT)
    tl.atomic_add(grad_bias + o, tl.sum(grad, axis=0), o < outputs, sem="relaxed")


@kernel(num_warps=8)
def differentiate(
    x, extra, w1, b1, w2, b2, w3, head, grad_head, grad_rest, grad_x, h1, h2, g1, g2, g3, bias_gradients,
    count, inputs, extras, hidden, outputs, heads, scale,
    ACTIVATION: tl.constexpr, TWO: tl.constexpr, IN: tl.constexpr, EX: tl.constexpr, HID: tl.constexpr,
    OUT: tl.constexpr, B: tl.constexpr,
):  # fmt: skip
    """Gradients of inputs and biases, and the factors of the matrices' gradients: inputs h and gradients g of layers."""
    i = tl.program_id(0) * B + tl.arange(0, B)
    is_input = i < count
    first, second = compute_hidden(x, extra, i, is_input, w1, b1, w2, b2, inputs, extras, hidden, TWO, IN, EX, HID)
    above, value = load_block(grad_head, i, is_input, heads, OUT), load_block(head, i, is_input, heads, OUT)
    if ACTIVATION == "exp":
        above *= exp_slope(value, scale)
    elif ACTIVATION == "sigmoid":
        above *= value * (1 - value)
    pointers, is_rest = point_at_rest(grad_rest, i, is_input, heads, outputs, OUT)
    above += tl.load(pointers, is_rest, 0.0)
    add_bias_gradient(bias_gradients + 2 * hidden, above, outputs, OUT)
    store_block(g3, above, i, is_input, outputs, OUT)
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
    def forward(
        ctx, x: Tensor, extra: Tensor, num_head: int, activation: Any, scale: float, *parameters: Tensor
    ) -> tuple[Tensor, Tensor]:
        x, extra, *layers = (p.contiguous() for p in (x, extra, *parameters))
        count, hidden, outputs = len(x), len(layers[1]), len(layers[-1])
        ctx.shape = count, x.shape[1], extra.shape[1], hidden, outputs, num_head, scale
        names = zip(("IN", "EX", "HID", "OUT"), ctx.shape[1:5], strict=True)
        ctx.constants = {"ACTIVATION": ACTIVATIONS[activation], "TWO": len(layers) == 6, "B": BLOCK}
        ctx.constants |= {name: pad_width(width) for name, width in names}
        out = x.new_empty(count, num_head), x.new_empty(count, outputs - num_head)
        # A single hidden layer stands for both.
        inputs = x, extra, *layers[:2], *layers[-4:]
        propagate((triton.cdiv(count, BLOCK),), *inputs, *out, *ctx.shape, **ctx.constants)
        ctx.save_for_backward(x, extra, out[0], *layers)
        ctx.set_materialize_grads(False)
        return out

    @staticmethod
    def backward(ctx, *grads: Tensor | None):
        x, extra, head, *layers = ctx.saved_tensors
        count, widths = len(x), (head.shape[1], len(layers[-1]) - head.shape[1])
        above = [
            grad.contiguous() if grad is not None else x.new_zeros(count, width) if width else x
            for grad, width in zip(grads, widths, strict=True)
        ]
        _, inputs, extras, hidden, outputs, *_ = ctx.shape
        grad_x, g3, biases = torch.empty_like(x), x.new_empty(count, outputs), x.new_zeros(2 * hidden + outputs)
        h2, g1, *middle = x.new_empty(4 if ctx.constants["TWO"] else 2, count, hidden)
        h1, g2 = middle or (biases, biases)  # not written with one hidden layer
        given = x, extra, *layers[:2], *layers[-4:-1], head, *above, grad_x, h1, h2, g1, g2, g3, biases
        differentiate((triton.cdiv(count, BLOCK),), *given, *ctx.shape, **ctx.constants)
        first = x.new_empty(hidden, inputs + extras)
        torch.mm(g1.T, x, out=first[:, :inputs])
        if extras:
            torch.mm(g1.T, extra, out=first[:, inputs:])
        second = [g2.T @ h1, biases[hidden : 2 * hidden]] if middle else []
        gradients = first, biases[:hidden], *second, g3.T @ h2, biases[2 * hidden :]
        return grad_x, None, None, None, None, *gradients
