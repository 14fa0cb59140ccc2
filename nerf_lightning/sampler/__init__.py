"""Stage 3, samplers: Rays -> Samples, the intervals along each ray at which the field is evaluated."""

from nerf_lightning.sampler.occupancy import OccupancySampler
from nerf_lightning.sampler.occupancy_grid import OccupancyGrid
from nerf_lightning.sampler.proposal import ProposalSampler, choose_sampler
from nerf_lightning.sampler.samples import CHUNK, DensityFn, Sampler, Samples, pack, split_by_rays
from nerf_lightning.sampler.uniform import ImportanceSampler, UniformSampler

__all__ = [
    "CHUNK",
    "DensityFn",
    "ImportanceSampler",
    "OccupancyGrid",
    "OccupancySampler",
    "ProposalSampler",
    "Sampler",
    "Samples",
    "UniformSampler",
    "pack",
    "split_by_rays",
    "choose_sampler",
]
