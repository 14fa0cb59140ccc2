"""Intervals along rays in warped distances, and how they move to where the weight is."""

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.cameras import Bounds, Rays
from nerf_lightning.kernels.switch import fast

Along = tuple[Float[Tensor, "N 3"], Float[Tensor, "R S"], Float[Tensor, "R S"]]
"""Places of the midpoints in the unit cube, N = R S of them; their distances, and the intervals' lengths, world units."""


def along_reference(rays: Rays, bounds: Bounds, near: Tensor, far: Tensor, s: Tensor) -> Along:
    """`along` in plain PyTorch, for every device."""
    edges = bounds.distances(rays, near, far, s)
    t = (edges[:, :-1] + edges[:, 1:]) / 2
    places = (rays.origins[:, None] + t[..., None] * rays.directions[:, None]).view(-1, 3)
    return bounds.to_unit(places), t, edges[:, 1:] - edges[:, :-1]


def along(
    rays: Rays, bounds: Bounds, near: Float[Tensor, "R"], far: Float[Tensor, "R"], s: Float[Tensor, "R S_plus_1"]
) -> Along:
    """The middle and length of intervals.

    Args:
        rays, bounds: in world units.
        near, far: distances along each ray.
        s: where the intervals begin and end, in [0, 1], see `Bounds.distances`.
    """
    given = (rays.origins, rays.directions, near, far, s)
    if not fast(*given) or any(x.requires_grad for x in given):
        return along_reference(rays, bounds, near, far, s)
    from nerf_lightning.kernels.cpu import proposals, workers

    count, steps = len(s), s.shape[1] - 1
    inside = bounds.inside(rays) if bounds.unbounded else torch.empty(0, 2)
    unit, t, dt = torch.empty(3, count * steps), torch.empty(count, steps), torch.empty(count, steps)
    arrays = (x.contiguous().numpy() for x in (rays.origins, rays.directions, near, far, inside, s))
    box = bounds.centre.numpy(), bounds.half_size.numpy(), bounds.unbounded
    proposals.along(*arrays, *box, unit.numpy(), t.numpy(), dt.numpy(), workers())
    return unit.T, t, dt


def resample_reference(s: Tensor, share: Tensor, shift: Tensor, count: int) -> Tensor:
    """`resample` in plain PyTorch, for every device."""
    sums = torch.cat([torch.zeros_like(share[:, :1]), share.cumsum(1)], dim=1)
    steps = torch.arange(count + 1, device=s.device)
    u = ((steps + shift[:, None]) / count).clamp(0, 1) * sums[:, -1:]
    above = torch.searchsorted(sums, u, right=True).clamp(1, share.shape[1])
    low, high = sums.gather(1, above - 1), sums.gather(1, above)
    part = ((u - low) / (high - low)).clamp(0, 1)
    start, end = s.gather(1, above - 1), s.gather(1, above)
    return start + part * (end - start)


def resample(
    s: Float[Tensor, "R S_plus_1"], share: Float[Tensor, "R S"], shift: Float[Tensor, "R"], count: int
) -> Float[Tensor, "R K_plus_1"]:
    """Edges of `count` new intervals of equal share (NeRF, section 5.2: inverse transform sampling).

    Args:
        s: edges of the old intervals, ascending.
        share: of each old interval, above 0; any scale.
        shift: of each ray's edges, in shares of a new interval.
    """
    if not fast(s, share, shift):
        return resample_reference(s, share, shift, count)
    from nerf_lightning.kernels.cpu import proposals, workers

    out = torch.empty(len(s), count + 1)
    proposals.resample(*(x.detach().contiguous().numpy() for x in (s, share, shift)), out.numpy(), workers())
    return out
