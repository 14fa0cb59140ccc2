import math

import pytest
import torch

from nerf_lightning.model import sinusoidal


@pytest.mark.parametrize(("frequencies", "shape"), [(0, (5, 3)), (1, (2,)), (4, (2, 3, 1))])
def test_sinusoidal_any_shape_matches_loop(frequencies, shape):
    x = torch.randn(shape)
    rows = []
    for row in x.reshape(-1, shape[-1]).tolist():
        out = list(row)
        for octave in range(frequencies):
            out += [math.sin(2**octave * math.pi * v) for v in row]
            out += [math.cos(2**octave * math.pi * v) for v in row]
        rows.append(out)
    expected = torch.tensor(rows).view(*shape[:-1], shape[-1] * (1 + 2 * frequencies))
    torch.testing.assert_close(sinusoidal(x, frequencies), expected, atol=1e-5, rtol=1e-5)
