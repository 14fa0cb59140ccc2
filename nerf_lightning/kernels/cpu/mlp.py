"""A whole small network on one tile of samples at a time, so that its activations never leave the core's cache.

Weights come as one flat array, layer after layer [O, I] then bias [O], every width padded with zeros to a multiple of four:
the loops handle four rows by four columns at once, in registers.
"""

import numpy as np
from numba import float32, prange

from nerf_lightning.kernels.cpu.compile import inner, kernel
from nerf_lightning.kernels.cpu.lanes import fused, load, total, zeros

TILE = 128
"""Samples worked on together; a constant, so that the inner loops need no remainder."""
RUN = (0,) * 8
"""Samples of a tile that are summed side by side."""


@inner(inline="always")
def sum4(w, a0, a1, a2, a3, start):
    """start + w0 a0 + w1 a1 + w2 a2 + w3 a3, from the last to the first."""
    return fused(w[0], a0, fused(w[1], a1, fused(w[2], a2, fused(w[3], a3, start))))


@inner(inline="always")
def add_product(w0, w1, w2, w3, x, i, y, o):
    """Adds to four rows of y, from o on, what four rows of weights make of the rows of x from i on."""
    for n in range(TILE):
        x0, x1, x2, x3 = x[i, n], x[i + 1, n], x[i + 2, n], x[i + 3, n]
        y[o, n] = sum4(w0, x0, x1, x2, x3, y[o, n])
        y[o + 1, n] = sum4(w1, x0, x1, x2, x3, y[o + 1, n])
        y[o + 2, n] = sum4(w2, x0, x1, x2, x3, y[o + 2, n])
        y[o + 3, n] = sum4(w3, x0, x1, x2, x3, y[o + 3, n])


@inner(inline="always")
def row4(W, o, i):
    return W[o, i], W[o, i + 1], W[o, i + 2], W[o, i + 3]


@inner(inline="always")
def column4(W, o, i):
    return W[o, i], W[o + 1, i], W[o + 2, i], W[o + 3, i]


@inner
def affine(W, b, x, y, relu):
    """y = W x + b, or its ReLU."""
    outputs, inputs = W.shape
    for o in range(0, outputs, 4):
        for k in range(o, o + 4):
            for n in range(TILE):
                y[k, n] = b[k]
        for i in range(0, inputs, 4):
            add_product(row4(W, o, i), row4(W, o + 1, i), row4(W, o + 2, i), row4(W, o + 3, i), x, i, y, o)
        if relu:
            for k in range(o, o + 4):
                for n in range(TILE):
                    y[k, n] = float32(0) if y[k, n] < float32(0) else y[k, n]  # keeps NaN


@inner
def back_input(W, dy, dx):
    """dx = W^T dy."""
    outputs, inputs = W.shape
    for i in range(0, inputs, 4):
        dx[i : i + 4] = float32(0)
        for o in range(0, outputs, 4):
            w0, w1, w2, w3 = column4(W, o, i), column4(W, o, i + 1), column4(W, o, i + 2), column4(W, o, i + 3)
            add_product(w0, w1, w2, w3, dy, o, dx, i)


@inner
def back_weight(dW, db, dy, x):
    """dW += dy x^T, db += the sum of dy."""
    outputs, inputs = dW.shape
    zero = zeros(RUN)
    for o in range(0, outputs, 4):
        for k in range(o, o + 4):
            s = zero
            for n in range(0, TILE, len(RUN)):
                s = s + load(dy, k, n, RUN)
            db[k] += total(s)
        for i in range(0, inputs, 4):
            s00, s01, s02, s03 = zero, zero, zero, zero
            s10, s11, s12, s13 = zero, zero, zero, zero
            s20, s21, s22, s23 = zero, zero, zero, zero
            s30, s31, s32, s33 = zero, zero, zero, zero
            for n in range(0, TILE, len(RUN)):
                x0, x1 = load(x, i, n, RUN), load(x, i + 1, n, RUN)
                x2, x3 = load(x, i + 2, n, RUN), load(x, i + 3, n, RUN)
                y = load(dy, o, n, RUN)
                s00, s01, s02, s03 = fused(y, x0, s00), fused(y, x1, s01), fused(y, x2, s02), fused(y, x3, s03)
                y = load(dy, o + 1, n, RUN)
                s10, s11, s12, s13 = fused(y, x0, s10), fused(y, x1, s11), fused(y, x2, s12), fused(y, x3, s13)
                y = load(dy, o + 2, n, RUN)
                s20, s21, s22, s23 = fused(y, x0, s20), fused(y, x1, s21), fused(y, x2, s22), fused(y, x3, s23)
                y = load(dy, o + 3, n, RUN)
                s30, s31, s32, s33 = fused(y, x0, s30), fused(y, x1, s31), fused(y, x2, s32), fused(y, x3, s33)
            for k, sums in enumerate(
                ((s00, s01, s02, s03), (s10, s11, s12, s13), (s20, s21, s22, s23), (s30, s31, s32, s33))
            ):
                for m in range(4):
                    dW[o + k, i + m] += total(sums[m])


@inner
def fill(x, extra, first, count, tile):
    """Copies columns first : first + count of x, then of extra, into a tile; zeros fill the rest of it."""
    rows = len(x)
    tile[rows + len(extra) :] = float32(0)
    for i in range(rows):
        tile[i, :count] = x[i, first : first + count]
    for i in range(len(extra)):
        tile[rows + i, :count] = extra[i, first : first + count]
    if count < TILE:
        tile[:, count:] = float32(0)


@inner
def layer(weights, start, inputs, outputs):
    """The matrix [O, I] and the bias [O] of the layer that begins at `start`."""
    end = start + outputs * inputs
    return weights[start:end].reshape(outputs, inputs), weights[end : end + outputs]


@inner
def run_tile(weights, widths, activations):
    """Runs the network on the tile in the first rows of `activations`; each layer's output follows its input.

    Returns the rows where the last output begins and the length of `weights`.
    """
    start, row, layers = 0, 0, len(widths) - 1
    for index in range(layers):
        inputs, outputs = widths[index], widths[index + 1]
        matrix, bias = layer(weights, start, inputs, outputs)
        below, above = row + inputs, row + inputs + outputs
        affine(matrix, bias, activations[row:below], activations[below:above], index < layers - 1)
        start += outputs * inputs + outputs
        row = below
    return row, start


@kernel
def forward(weights, widths, x, extra, out, workers):
    """out [O, N] from x [I, N] and extra [E, N]."""
    samples = x.shape[1]
    tiles = (samples + TILE - 1) // TILE
    for worker in prange(workers):
        activations = np.empty((widths.sum(), TILE), np.float32)
        for tile in range(tiles * worker // workers, tiles * (worker + 1) // workers):
            first = tile * TILE
            count = min(TILE, samples - first)
            fill(x, extra, first, count, activations[: widths[0]])
            row, _ = run_tile(weights, widths, activations)
            for o in range(len(out)):
                out[o, first : first + count] = activations[row + o, :count]


@kernel
def backward(weights, widths, x, extra, above, grad_x, grad_weights, workers):
    """Fills grad_x [I, N] and one row of grad_weights [workers, W] a worker, running each tile's forward pass again."""
    samples = x.shape[1]
    tiles, layers = (samples + TILE - 1) // TILE, len(widths) - 1
    nothing = np.empty((0, samples), np.float32)
    for worker in prange(workers):
        activations = np.empty((widths.sum(), TILE), np.float32)
        grad_out = np.empty((widths.max(), TILE), np.float32)
        grad_in = np.empty((widths.max(), TILE), np.float32)
        sums = grad_weights[worker]
        sums[:] = float32(0)
        for tile in range(tiles * worker // workers, tiles * (worker + 1) // workers):
            first = tile * TILE
            count = min(TILE, samples - first)
            fill(x, extra, first, count, activations[: widths[0]])
            row, start = run_tile(weights, widths, activations)
            fill(above, nothing, first, count, grad_out[: widths[layers]])
            for index in range(layers - 1, -1, -1):
                inputs, outputs = widths[index], widths[index + 1]
                start -= outputs * inputs + outputs
                row -= inputs
                matrix, _ = layer(weights, start, inputs, outputs)
                grad_matrix, grad_bias = layer(sums, start, inputs, outputs)
                entered = activations[row : row + inputs]
                back_weight(grad_matrix, grad_bias, grad_out[:outputs], entered)
                back_input(matrix, grad_out[:outputs], grad_in[:inputs])
                if index > 0:
                    for i in range(inputs):
                        for n in range(TILE):
                            grad_out[i, n] = grad_in[i, n] if entered[i, n] > float32(0) else float32(0)
            for i in range(len(grad_x)):
                grad_x[i, first : first + count] = grad_in[i, :count]
