"""Uniform, stratified and importance sampling between near and far (NeRF, sections 4 and 5.2)."""

import torch
from jaxtyping import Float
from torch import Generator, Tensor

from nerf_lightning.cameras import Bounds, Rays
from nerf_lightning.kernels import interval_weights, invert_cdf
from nerf_lightning.sampler.samples import CHUNK, DensityFn, Sampler, Samples, pack
from nerf_lightning.utils.option_checks import Count


def stratified_edges(edges: Float[Tensor, "R S_plus_1"], generator: Generator) -> Float[Tensor, "R S_plus_1"]:
    """Stratified jitter (NeRF, eq. 2): moves each inner edge within the adjacent midpoints; the ends stay."""
    middle = (edges[:, :-1] + edges[:, 1:]) / 2
    noise = torch.rand(middle[:, 1:].shape, generator=generator, device=edges.device)
    inner = middle[:, :-1] + (middle[:, 1:] - middle[:, :-1]) * noise
    return torch.cat([edges[:, :1], inner, edges[:, -1:]], dim=1)


class UniformSampler(Sampler):
    """Uniform sampling with the same number of samples on every ray that hits the bounds.

    Args:
        bounds: the box of the content; rays that miss it get no samples.
        samples: intervals per ray.
        stratified: jitter the intervals in training.
        chunk: see `Sampler`.
    """

    def __init__(self, bounds: Bounds, samples: Count = 64, stratified: bool = False, chunk: int = CHUNK):
        super().__init__(bounds, chunk)
        self.samples = samples
        self.stratified = stratified

    def edges(self, rays: Rays, generator: Generator | None) -> Float[Tensor, "R S_plus_1"]:
        near, far = self.bounds.near_far(rays)
        s = torch.linspace(0, 1, self.samples + 1, device=near.device).expand(len(rays), -1)
        if self.stratified and generator is not None:
            s = stratified_edges(s, generator)
        return self.bounds.s_to_t(rays, near, far, s)

    def forward(self, rays: Rays, density: DensityFn, generator: Generator | None = None) -> Samples:
        edges = self.edges(rays, generator)
        hit = edges[:, -1:] > edges[:, :1]
        return pack(edges, hit.expand(-1, self.samples))


class ImportanceSampler(UniformSampler):
    """Hierarchical sampling (NeRF, section 5.2) with one field: a uniform pass without gradient, then samples by its weights.

    Args:
        bounds: the box of the content.
        samples: intervals of the coarse pass.
        importance_samples: additional samples per ray; the output holds both.
        stratified: jitter both passes in training.
        chunk: see `Sampler`.
    """

    def __init__(
        self,
        bounds: Bounds,
        samples: Count = 64,
        importance_samples: Count = 64,
        stratified: bool = True,
        chunk: int = CHUNK,
    ):
        super().__init__(bounds, samples, stratified, chunk)
        self.importance_samples = importance_samples

    def forward(self, rays: Rays, density: DensityFn, generator: Generator | None = None) -> Samples:
        edges = self.edges(rays, generator)
        hit = edges[:, -1:] > edges[:, :1]
        coarse = pack(edges, hit.expand(-1, self.samples))
        with torch.no_grad():
            optical = torch.zeros(hit.shape[0], self.samples, device=edges.device)
            optical[hit[:, 0]] = (density(coarse.positions(rays)) * coarse.dt).view(-1, self.samples)
            weights = interval_weights(optical)
        count = self.importance_samples
        u = (torch.arange(count, device=edges.device) + 0.5).expand(len(rays), -1) / count
        if self.stratified and generator is not None:
            u = u + (torch.rand(u.shape, generator=generator, device=u.device) - 0.5) / count
        merged = torch.cat([edges, invert_cdf(edges, weights, u)], dim=1).sort(dim=1).values
        return pack(merged, hit.expand(-1, merged.shape[1] - 1))
