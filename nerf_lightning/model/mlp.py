"""The original NeRF network (Mildenhall et al. 2020, figure 7), sized as the course does."""

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.cameras import Bounds
from nerf_lightning.errors import InputError
from nerf_lightning.model.field import Field
from nerf_lightning.model.layers.activation import Activation, density_activation
from nerf_lightning.model.layers.encoding import sinusoidal
from nerf_lightning.model.layers.widening import widen, widen_all
from nerf_lightning.utils.options import Count, Layers, Octaves


class MLPField(Field):
    """A deep network of sinusoidally encoded position, with a view-dependent colour head.

    Args:
        bounds: positions are scaled to [-1, 1] in them.
        depth: hidden layers of the trunk.
        width: neurons in each.
        skip: the layer that sees the encoded position again, or None.
        position_frequencies, direction_frequencies: octaves of the two encodings.
        density: "relu", "softplus" or "exp".

    Raises:
        InputError: where `skip` is not one of the trunk's layers after the first.
    """

    max_lr = 0.05

    def __init__(
        self,
        bounds: Bounds,
        depth: Layers = 8,
        width: Count = 256,
        skip: int | None = 4,
        position_frequencies: Octaves = 10,
        direction_frequencies: Octaves = 4,
        density: Activation = "relu",
    ):
        super().__init__(bounds)
        if skip is not None and not 0 < skip < depth:
            expected = f"a layer from 1 to {depth - 1} (model.depth={depth}), or null for no skip"
            raise InputError("model.skip", "", str(skip), expected)
        self.skip = skip
        self.position_frequencies = position_frequencies
        self.direction_frequencies = direction_frequencies
        self.activation = density_activation(density)
        encoded = 3 * (1 + 2 * position_frequencies)
        inputs = [encoded] + [width + encoded if layer == skip else width for layer in range(1, depth)]
        self.trunk = torch.nn.ModuleList(torch.nn.Linear(n, width) for n in inputs)
        self.density_head = torch.nn.Linear(width, 1)
        self.bottleneck = torch.nn.Linear(width, width)
        self.colour_head = torch.nn.Sequential(
            torch.nn.Linear(width + 3 * (1 + 2 * direction_frequencies), width // 2),
            torch.nn.ReLU(),
            torch.nn.Linear(width // 2, 3),
        )

    @torch.no_grad()
    def warm_start_from(self, smaller: Field) -> None:
        """Copies a network with the same encodings and skip; further layers of the trunk pass on their input."""
        assert isinstance(smaller, MLPField)
        like = ("skip", "position_frequencies", "direction_frequencies")
        if any(getattr(self, key) != getattr(smaller, key) for key in like) or len(smaller.trunk) > len(self.trunk):
            return
        wide, narrow = self.bottleneck.in_features, smaller.bottleneck.in_features
        encoded = torch.arange(3 * (1 + 2 * self.position_frequencies))
        directions = torch.arange(3 * (1 + 2 * self.direction_frequencies))
        hidden = torch.arange(narrow)
        for layer, mine in enumerate(self.trunk):
            assert isinstance(mine, torch.nn.Linear)
            if layer >= len(smaller.trunk):  # its input has been through a ReLU, which a second one leaves alone
                mine.weight[:narrow] = torch.eye(mine.in_features)[:narrow]
                mine.bias[:narrow] = 0
                continue
            its = smaller.trunk[layer]
            assert isinstance(its, torch.nn.Linear)
            again = torch.cat([hidden, wide + encoded]) if layer == self.skip else hidden
            widen(mine, its, encoded if layer == 0 else again)
        widen(self.density_head, smaller.density_head, hidden)
        widen(self.bottleneck, smaller.bottleneck, hidden)
        head, its_head = (
            torch.nn.ModuleList([field.colour_head[0], field.colour_head[2]]) for field in (self, smaller)
        )
        widen_all(head, its_head, torch.cat([hidden, wide + directions]))

    def features(self, positions: Float[Tensor, "N 3"]) -> tuple[Float[Tensor, "N"], Float[Tensor, "N F"]]:
        x = sinusoidal(self.bounds.to_unit(positions) * 2 - 1, self.position_frequencies)
        h = x
        for index, layer in enumerate(self.trunk):
            h = torch.relu(layer(torch.cat([h, x], dim=1) if index == self.skip else h))
        return self.activation(self.density_head(h).squeeze(1)), h

    def colour(self, features: Float[Tensor, "N F"], directions: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
        seen = torch.cat([self.bottleneck(features), sinusoidal(directions, self.direction_frequencies)], dim=1)
        return torch.sigmoid(self.colour_head(seen))
