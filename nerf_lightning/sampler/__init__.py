"""Stage 3, samplers: Rays -> Samples, where along each ray the field is evaluated."""

from nerf_lightning.sampler.occupancy import OccupancySampler
from nerf_lightning.sampler.occupancy_grid import OccupancyGrid
from nerf_lightning.sampler.proposal import ProposalSampler, suited_sampler
from nerf_lightning.sampler.samples import CHUNK, DensityFn, Sampler, Samples, pack, split
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
    "split",
    "suited_sampler",
]
