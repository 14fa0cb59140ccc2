"""Fused multilayer perceptron on tiles of samples, so that activations stay in the core's cache.

Weights are one flat array: each layer's matrix [O, I], then its bias [O], all widths zero-padded to multiples of four. Loops
work on blocks of rows and samples whose sums stay in registers.
"""

import numpy as np
from numba import float32, prange

from nerf_lightning.kernels.cpu.jit import jit, kernel
from nerf_lightning.kernels.cpu.simd import MAX_LANES, broadcast, fma, horizontal_sum, load, prefetch, rectify, store

TILE = 128
"""Samples per tile; a constant, so that the inner loops need no remainder."""
TILE_STRIDE = TILE + 16
"""Row stride of a tile: a power of two would cause cache conflicts."""
LANES = (0,) * MAX_LANES
"""Samples of a tile in one register."""


@jit
def affine(W, b, x, y, relu):
    """y = W x + b, or its ReLU, in blocks of four rows by two registers of samples: eight independent sums hide the latency."""
    outputs, inputs = W.shape
    half = len(LANES)
    for n in range(0, TILE, 2 * half):
        for o in range(0, outputs, 4):
            a0, b0 = broadcast(b[o], LANES), broadcast(b[o + 1], LANES)
            c0, d0 = broadcast(b[o + 2], LANES), broadcast(b[o + 3], LANES)
            a1, b1, c1, d1 = a0, b0, c0, d0
            for i in range(inputs):
                x0, x1 = load(x, i, n, LANES), load(x, i, n + half, LANES)
                w = broadcast(W[o, i], LANES)
                a0, a1 = fma(w, x0, a0), fma(w, x1, a1)
                w = broadcast(W[o + 1, i], LANES)
                b0, b1 = fma(w, x0, b0), fma(w, x1, b1)
                w = broadcast(W[o + 2, i], LANES)
                c0, c1 = fma(w, x0, c0), fma(w, x1, c1)
                w = broadcast(W[o + 3, i], LANES)
                d0, d1 = fma(w, x0, d0), fma(w, x1, d1)
            for k, sums in enumerate(((a0, a1), (b0, b1), (c0, c1), (d0, d1))):
                store(y, o + k, n, rectify(sums[0]) if relu else sums[0])
                store(y, o + k, n + half, rectify(sums[1]) if relu else sums[1])


@jit
def add_weight_gradient(dW, db, dy, x):
    """dW += dy x^T, db += sum of dy, in blocks of two rows by four columns, each summed in the lanes of a register."""
    outputs, inputs = dW.shape
    zero = broadcast(float32(0), LANES)
    for o in range(0, outputs, 2):
        for k in range(o, o + 2):
            s = zero
            for n in range(0, TILE, len(LANES)):
                s = s + load(dy, k, n, LANES)
            db[k] += horizontal_sum(s)
        for i in range(0, inputs, 4):
            a0, a1, a2, a3 = zero, zero, zero, zero
            b0, b1, b2, b3 = zero, zero, zero, zero
            for n in range(0, TILE, len(LANES)):
                x0, x1 = load(x, i, n, LANES), load(x, i + 1, n, LANES)
                x2, x3 = load(x, i + 2, n, LANES), load(x, i + 3, n, LANES)
                y = load(dy, o, n, LANES)
                a0, a1, a2, a3 = fma(y, x0, a0), fma(y, x1, a1), fma(y, x2, a2), fma(y, x3, a3)
                y = load(dy, o + 1, n, LANES)
                b0, b1, b2, b3 = fma(y, x0, b0), fma(y, x1, b1), fma(y, x2, b2), fma(y, x3, b3)
            for k, sums in enumerate(((a0, a1, a2, a3), (b0, b1, b2, b3))):
                for m in range(4):
                    dW[o + k, i + m] += horizontal_sum(sums[m])


@jit
def copy_columns(x, first, y, start, count):
    """y[:, start : start + count] = x[:, first : first + count] for the rows that both have."""
    for i in range(min(len(x), len(y))):
        if count == TILE:
            for n in range(0, TILE, len(LANES)):
                prefetch(x, i, first + TILE + n)  # source of the next tile
                store(y, i, start + n, load(x, i, first + n, LANES))
        else:
            for n in range(count):
                y[i, start + n] = x[i, first + n]


@jit
def fill_tile(x, extra, first, count, tile):
    """Fills a tile with columns first : first + count of x, then of extra, then zeros."""
    rows = len(x)
    copy_columns(x, first, tile, 0, count)
    copy_columns(extra, first, tile[rows:], 0, count)
    tile[rows + len(extra) :] = float32(0)
    if count < TILE:
        tile[:, count:] = float32(0)


@jit
def layer_parameters(weights, start, inputs, outputs):
    """Matrix [O, I] and bias [O] of the layer that begins at `start`."""
    end = start + outputs * inputs
    return weights[start:end].reshape(outputs, inputs), weights[end : end + outputs]


@jit
def run_tile(weights, widths, activations):
    """Runs the network on the tile in the first rows of `activations`; each layer's output follows its input.

    Returns the first row of the last output and the length of `weights`.
    """
    start, row, layers = 0, 0, len(widths) - 1
    for index in range(layers):
        inputs, outputs = widths[index], widths[index + 1]
        matrix, bias = layer_parameters(weights, start, inputs, outputs)
        below, end = row + inputs, row + inputs + outputs
        affine(matrix, bias, activations[row:below], activations[below:end], index < layers - 1)
        start += outputs * inputs + outputs
        row = below
    return row, start


@kernel
def forward(weights, widths, x, extra, out, workers):
    """Fills out [O, N] from x [I, N] and extra [E, N]."""
    samples = x.shape[1]
    tiles = (samples + TILE - 1) // TILE
    for worker in prange(workers):
        activations = np.empty((widths.sum(), TILE_STRIDE), np.float32)
        for tile in range(tiles * worker // workers, tiles * (worker + 1) // workers):
            first = tile * TILE
            count = min(TILE, samples - first)
            fill_tile(x, extra, first, count, activations[: widths[0]])
            row, _ = run_tile(weights, widths, activations)
            copy_columns(activations[row:], 0, out, first, count)


@kernel
def backward(weights, widths, x, extra, grad_output, grad_x, grad_weights, workers):
    """Fills grad_x [I, N] and one row of grad_weights [workers, W] per worker; recomputes each tile's forward pass."""
    samples = x.shape[1]
    tiles, layers = (samples + TILE - 1) // TILE, len(widths) - 1
    no_extra = np.empty((0, samples), np.float32)
    for worker in prange(workers):
        activations = np.empty((widths.sum(), TILE_STRIDE), np.float32)
        grad_out = np.empty((widths.max(), TILE_STRIDE), np.float32)
        grad_in = np.empty((widths.max(), TILE_STRIDE), np.float32)
        sums, no_bias = grad_weights[worker], np.zeros(widths.max(), np.float32)
        sums[:] = float32(0)
        for tile in range(tiles * worker // workers, tiles * (worker + 1) // workers):
            first = tile * TILE
            count = min(TILE, samples - first)
            fill_tile(x, extra, first, count, activations[: widths[0]])
            row, start = run_tile(weights, widths, activations)
            fill_tile(grad_output, no_extra, first, count, grad_out[: widths[layers]])
            for index in range(layers - 1, -1, -1):
                inputs, outputs = widths[index], widths[index + 1]
                start -= outputs * inputs + outputs
                row -= inputs
                matrix, _ = layer_parameters(weights, start, inputs, outputs)
                grad_matrix, grad_bias = layer_parameters(sums, start, inputs, outputs)
                layer_input = activations[row : row + inputs]
                add_weight_gradient(grad_matrix, grad_bias, grad_out[:outputs], layer_input)
                affine(matrix.T, no_bias, grad_out[:outputs], grad_in[:inputs], False)
                if index > 0:
                    for i in range(inputs):
                        for n in range(TILE):
                            grad_out[i, n] = grad_in[i, n] if layer_input[i, n] > float32(0) else float32(0)
            copy_columns(grad_in, 0, grad_x, first, count)
