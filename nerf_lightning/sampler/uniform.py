"""Equal steps between near and far, with or without jitter."""

import torch
from jaxtyping import Float
from torch import Generator, Tensor

from nerf_lightning.cameras import Bounds, Rays
from nerf_lightning.sampler.samples import CHUNK, DensityFn, Sampler, Samples, pack
from nerf_lightning.utils.options import Count


def stratified_edges(edges: Float[Tensor, "R S_plus_1"], generator: Generator) -> Float[Tensor, "R S_plus_1"]:
    """Moves each inner edge to a random place between its neighbours' midpoints (NeRF, eq. 2); the ends stay."""
    middle = (edges[:, :-1] + edges[:, 1:]) / 2
    noise = torch.rand(middle[:, 1:].shape, generator=generator, device=edges.device)
    inner = middle[:, :-1] + (middle[:, 1:] - middle[:, :-1]) * noise
    return torch.cat([edges[:, :1], inner, edges[:, -1:]], dim=1)


class UniformSampler(Sampler):
    """The same number of samples on every ray that meets the bounds.

    Args:
        bounds: where the content is; rays that miss it get no samples.
        samples: intervals per ray.
        stratified: jitter the intervals in training, so that over time the field is evaluated everywhere.
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
        return self.bounds.distances(rays, near, far, s)

    def forward(self, rays: Rays, density: DensityFn, generator: Generator | None = None) -> Samples:
        edges = self.edges(rays, generator)
        hit = edges[:, -1:] > edges[:, :1]
        return pack(edges, hit.expand(-1, self.samples))
