"""Coarse to fine: sample evenly first, then again where the weight is."""

import torch
from torch import Generator

from nerf_lightning.cameras import Bounds, Rays
from nerf_lightning.kernels import inverse_cdf
from nerf_lightning.sampler.samples import CHUNK, DensityFn, Samples, interval_weights, pack
from nerf_lightning.sampler.uniform import UniformSampler
from nerf_lightning.utils.options import Count


class ImportanceSampler(UniformSampler):
    """A uniform pass without gradient, then further samples drawn by its weights; returns both together.

    One field serves both passes.

    Args:
        bounds: where the content is.
        samples: intervals of the first pass.
        fine: further samples per ray.
        stratified: jitter both passes in training.
        chunk: see `Sampler`.
    """

    def __init__(
        self, bounds: Bounds, samples: Count = 64, fine: Count = 64, stratified: bool = True, chunk: int = CHUNK
    ):
        super().__init__(bounds, samples, stratified, chunk)
        self.fine = fine

    def forward(self, rays: Rays, density: DensityFn, generator: Generator | None = None) -> Samples:
        edges = self.edges(rays, generator)
        hit = edges[:, -1:] > edges[:, :1]
        coarse = pack(edges, hit.expand(-1, self.samples))
        with torch.no_grad():
            optical = torch.zeros(hit.shape[0], self.samples, device=edges.device)
            optical[hit[:, 0]] = (density(coarse.positions(rays)) * coarse.dt).view(-1, self.samples)
            weights = interval_weights(optical)
        u = (torch.arange(self.fine, device=edges.device) + 0.5).expand(len(rays), -1) / self.fine
        if self.stratified and generator is not None:
            u = u + (torch.rand(u.shape, generator=generator, device=u.device) - 0.5) / self.fine
        merged = torch.cat([edges, inverse_cdf(edges, weights, u)], dim=1).sort(dim=1).values
        return pack(merged, hit.expand(-1, merged.shape[1] - 1))
