"""Stage 3, samplers: Rays -> Samples, where along each ray the field is evaluated."""

from nerf_lightning.sampler.importance import ImportanceSampler
from nerf_lightning.sampler.occupancy import OccupancySampler
from nerf_lightning.sampler.occupancy_grid import OccupancyGrid
from nerf_lightning.sampler.proposal import ProposalSampler
from nerf_lightning.sampler.samples import CHUNK, DensityFn, Sampler, Samples, pack, split
from nerf_lightning.sampler.suited import suited_sampler
from nerf_lightning.sampler.uniform import UniformSampler

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
