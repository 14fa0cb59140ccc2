"""A whole small network on one tile of samples at a time, so that its activations never leave the core's cache.

Weights come as one flat array, layer after layer [O, I] then bias [O], every width padded with zeros to a multiple of four:
the loops handle blocks of rows and samples at once, whose sums stay in registers.
"""

import numpy as np
from numba import float32, prange

from nerf_lightning.kernels.cpu.compile import inner, kernel
from nerf_lightning.kernels.cpu.lanes import WIDEST, fused, load, prefetch, spread, store, total

TILE = 128
"""Samples worked on together; a constant, so that the inner loops need no remainder."""
ROW = TILE + 16
"""Room for a row of a tile: rows a power of two apart would all want the same few places of the cache."""
RUN = (0,) * WIDEST
"""Samples of a tile in one register."""


@inner
def add_product(W, x, y):
    """y += W x, four rows by two registers of samples at a time: eight sums, as many as a processor adds to at once."""
    outputs, inputs = W.shape
    half = len(RUN)
    for n in range(0, TILE, 2 * half):
        for o in range(0, outputs, 4):
            a0, a1 = load(y, o, n, RUN), load(y, o, n + half, RUN)
            b0, b1 = load(y, o + 1, n, RUN), load(y, o + 1, n + half, RUN)
            c0, c1 = load(y, o + 2, n, RUN), load(y, o + 2, n + half, RUN)
            d0, d1 = load(y, o + 3, n, RUN), load(y, o + 3, n + half, RUN)
            for i in range(inputs):
                x0, x1 = load(x, i, n, RUN), load(x, i, n + half, RUN)
                w = spread(W[o, i], RUN)
                a0, a1 = fused(w, x0, a0), fused(w, x1, a1)
                w = spread(W[o + 1, i], RUN)
                b0, b1 = fused(w, x0, b0), fused(w, x1, b1)
                w = spread(W[o + 2, i], RUN)
                c0, c1 = fused(w, x0, c0), fused(w, x1, c1)
                w = spread(W[o + 3, i], RUN)
                d0, d1 = fused(w, x0, d0), fused(w, x1, d1)
            for k, sums in enumerate(((a0, a1), (b0, b1), (c0, c1), (d0, d1))):
                store(y, o + k, n, sums[0])
                store(y, o + k, n + half, sums[1])


@inner
def affine(W, b, x, y, relu):
    """y = W x + b, or its ReLU."""
    for o in range(len(W)):
        for n in range(TILE):
            y[o, n] = b[o]
    add_product(W, x, y)
    if relu:
        for o in range(len(W)):
            for n in range(TILE):
                y[o, n] = float32(0) if y[o, n] < float32(0) else y[o, n]  # keeps NaN


@inner
def back_input(W, dy, dx):
    """dx = W^T dy."""
    dx[:] = float32(0)
    add_product(W.T, dy, dx)


@inner
def back_weight(dW, db, dy, x):
    """dW += dy x^T, db += the sum of dy: two rows by four columns at a time, each summed in the lanes of a register."""
    outputs, inputs = dW.shape
    zero = spread(float32(0), RUN)
    for o in range(0, outputs, 2):
        for k in range(o, o + 2):
            s = zero
            for n in range(0, TILE, len(RUN)):
                s = s + load(dy, k, n, RUN)
            db[k] += total(s)
        for i in range(0, inputs, 4):
            a0, a1, a2, a3 = zero, zero, zero, zero
            b0, b1, b2, b3 = zero, zero, zero, zero
            for n in range(0, TILE, len(RUN)):
                x0, x1 = load(x, i, n, RUN), load(x, i + 1, n, RUN)
                x2, x3 = load(x, i + 2, n, RUN), load(x, i + 3, n, RUN)
                y = load(dy, o, n, RUN)
                a0, a1, a2, a3 = fused(y, x0, a0), fused(y, x1, a1), fused(y, x2, a2), fused(y, x3, a3)
                y = load(dy, o + 1, n, RUN)
                b0, b1, b2, b3 = fused(y, x0, b0), fused(y, x1, b1), fused(y, x2, b2), fused(y, x3, b3)
            for k, sums in enumerate(((a0, a1, a2, a3), (b0, b1, b2, b3))):
                for m in range(4):
                    dW[o + k, i + m] += total(sums[m])


@inner
def copy(x, first, y, start, count):
    """y[:, start : start + count] = x[:, first : first + count], for as many rows as the one that has fewer."""
    for i in range(min(len(x), len(y))):
        if count == TILE:
            for n in range(0, TILE, len(RUN)):
                prefetch(x, i, first + TILE + n)  # where the next tile's come from
                store(y, i, start + n, load(x, i, first + n, RUN))
        else:
            for n in range(count):
                y[i, start + n] = x[i, first + n]


@inner
def fill(x, extra, first, count, tile):
    """Copies columns first : first + count of x, then of extra, into a tile; zeros fill the rest of it."""
    rows = len(x)
    copy(x, first, tile, 0, count)
    copy(extra, first, tile[rows:], 0, count)
    tile[rows + len(extra) :] = float32(0)
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
        activations = np.empty((widths.sum(), ROW), np.float32)
        for tile in range(tiles * worker // workers, tiles * (worker + 1) // workers):
            first = tile * TILE
            count = min(TILE, samples - first)
            fill(x, extra, first, count, activations[: widths[0]])
            row, _ = run_tile(weights, widths, activations)
            copy(activations[row:], 0, out, first, count)


@kernel
def backward(weights, widths, x, extra, above, grad_x, grad_weights, workers):
    """Fills grad_x [I, N] and one row of grad_weights [workers, W] a worker, running each tile's forward pass again."""
    samples = x.shape[1]
    tiles, layers = (samples + TILE - 1) // TILE, len(widths) - 1
    nothing = np.empty((0, samples), np.float32)
    for worker in prange(workers):
        activations = np.empty((widths.sum(), ROW), np.float32)
        grad_out = np.empty((widths.max(), ROW), np.float32)
        grad_in = np.empty((widths.max(), ROW), np.float32)
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
            copy(grad_in, 0, grad_x, first, count)
