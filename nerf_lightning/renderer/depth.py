"""How far away what a ray sees is, where intervals are long and some of the weight lies far behind."""

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.kernels.sums import before
from nerf_lightning.sampler import Samples


def median_depth(density: Float[Tensor, "N"], opacity: Float[Tensor, "R"], samples: Samples) -> Float[Tensor, "R"]:
    """The distance along each ray where half of its opacity is reached, in the scene's unit; 0 where it has none.

    Density is constant within an interval, so that this is exact: the thickness passed is then -log(1 - opacity / 2).

    Args:
        density: of the samples, 1 / world unit.
        opacity: of the rays.
        samples: along them.
    """
    if not len(samples):
        return torch.zeros_like(opacity)
    thickness = density * samples.dt
    passed = before(thickness, samples.ray, samples.offsets)
    goal = -torch.log1p(-opacity / 2)
    short = torch.nn.functional.pad((passed + thickness < goal[samples.ray]).cumsum(0), (1, 0))
    first, last = samples.offsets[:-1], samples.offsets[1:] - 1
    # A sum that falls short by rounding ends at the last sample; a ray without samples reads any, and is told apart below.
    place = torch.minimum(first + short[samples.offsets[1:]] - short[first], last).clamp_min(0)
    share = ((goal - passed[place]) / thickness[place].clamp_min(1e-12)).clamp(0, 1)
    return torch.where(opacity > 0, samples.t[place] + (share - 0.5) * samples.dt[place], 0.0)
