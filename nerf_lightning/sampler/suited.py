"""The sampler that suits a scene."""

from nerf_lightning.cameras import Bounds
from nerf_lightning.sampler.occupancy import OccupancySampler
from nerf_lightning.sampler.proposal import ProposalSampler
from nerf_lightning.sampler.samples import CHUNK, Sampler


def suited_sampler(bounds: Bounds, chunk: int = CHUNK) -> Sampler:
    """Proposals where every ray meets something, as before a background; where most of the space is empty, an occupancy grid,
    which skips it."""
    return ProposalSampler(bounds, chunk=chunk) if bounds.unbounded else OccupancySampler(bounds, chunk=chunk)
