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
def add_gradients(
    grad_weight, grad_bias, above, below, first, inputs, width, outputs, IN: tl.constexpr, OUT: tl.constexpr
):
    """Adds the gradients of a bias, and of columns first : first + inputs of a matrix [outputs, width]."""
    i, o = tl.arange(0, IN)[None, :], tl.arange(0, OUT)
    product = tl.dot(tl.trans(above), below, input_precision="tf32")
    is_entry = (o < outputs)[:, None] & (i < inputs)
    tl.atomic_add(grad_weight + o[:, None] * width + first + i, product, is_entry, sem="relaxed")
    if grad_bias is not None:
        tl.atomic_add(grad_bias + o, tl.sum(above, axis=0), o < outputs, sem="relaxed")
    tl.debug_barrier()  # else the compiler loads what comes next too early, and spills registers


@kernel(num_warps=8)
def differentiate(
    x, extra, w1, b1, w2, b2, w3, head, grad_head, grad_rest, grad_x, g_w1, g_b1, g_w2, g_b2, g_w3, g_b3,
    count, inputs, extras, hidden, outputs, heads, scale,
    ACTIVATION: tl.constexpr, TWO: tl.constexpr, IN: tl.constexpr, EX: tl.constexpr, HID: tl.constexpr,
    OUT: tl.constexpr, B: tl.constexpr,
):  # fmt: skip
    """Gradients of inputs, and those of all parameters, added up."""
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
    add_gradients(g_w3, g_b3, above, second, 0, hidden, hidden, outputs, HID, OUT)
    last = tl.trans(load_transposed(w3, 0, hidden, hidden, outputs, HID, OUT))
    above = tl.where(second <= 0, 0.0, tl.dot(above, last, input_precision="tf32"))
    if TWO:
        above = tl.where(is_input[:, None], above, 0.0)
        add_gradients(g_w2, g_b2, above, first, 0, hidden, hidden, hidden, HID, HID)
        middle = tl.trans(load_transposed(w2, 0, hidden, hidden, hidden, HID, HID))
        above = tl.where(first <= 0, 0.0, tl.dot(above, middle, input_precision="tf32"))
    above = tl.where(is_input[:, None], above, 0.0)
    block = load_block(x, i, is_input, inputs, IN)  # once more: it would occupy registers all along
    add_gradients(g_w1, g_b1, above, block, 0, inputs, inputs + extras, hidden, IN, HID)
    if EX > 0:
        block = load_block(extra, i, is_input, extras, EX)
        add_gradients(g_w1, None, above, block, inputs, extras, inputs + extras, hidden, EX, HID)
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
        grad_x, sizes = torch.empty_like(x), [p.numel() for p in layers]
        gradients = [part.view_as(p) for part, p in zip(x.new_zeros(sum(sizes)).split(sizes), layers, strict=True)]
        inputs = x, extra, *layers[:2], *layers[-4:-1], head, *above
        outputs = grad_x, *gradients[:2], *gradients[-4:]
        differentiate((triton.cdiv(count, BLOCK),), *inputs, *outputs, *ctx.shape, **ctx.constants)
        return grad_x, None, None, None, None, *gradients
