"""The original NeRF network (Mildenhall et al. 2020, figure 7), with the course's defaults."""

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.cameras import Bounds
from nerf_lightning.errors import InputError
from nerf_lightning.model.field import Field
from nerf_lightning.model.layers.activation import Activation, density_activation
from nerf_lightning.model.layers.encoding import sinusoidal
from nerf_lightning.model.layers.networks import linear_layers, widen
from nerf_lightning.utils.option_checks import Count, Frequencies, Layers


class MLPField(Field):
    """A deep MLP on the sinusoidally encoded position, with a view-dependent color head.

    Args:
        bounds: the box whose positions are scaled to [-1, 1].
        depth: hidden layers of the trunk.
        width: neurons in each.
        skip: the layer that takes the encoded position again, or None.
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
        position_frequencies: Frequencies = 10,
        direction_frequencies: Frequencies = 4,
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
        self.color_head = torch.nn.Sequential(
            torch.nn.Linear(width + 3 * (1 + 2 * direction_frequencies), width // 2),
            torch.nn.ReLU(),
            torch.nn.Linear(width // 2, 3),
        )

    @torch.no_grad()
    def warm_start_from(self, smaller: Field) -> None:
        """Copies a network with the same encodings, both without a skip; further trunk layers start as the identity."""
        assert isinstance(smaller, MLPField)
        ours, theirs = ((f.skip, f.position_frequencies, f.direction_frequencies) for f in (self, smaller))
        trunk, smaller_trunk = linear_layers(self.trunk), linear_layers(smaller.trunk)
        if self.skip is not None or ours != theirs or len(smaller_trunk) > len(trunk):
            return
        narrow = smaller.bottleneck.out_features
        widen(trunk[: len(smaller_trunk)], smaller_trunk)
        for layer in trunk[len(smaller_trunk) :]:  # its input is not negative, so its ReLU changes nothing
            layer.weight[:narrow] = torch.eye(layer.in_features)[:narrow]
            layer.bias[:narrow] = 0
        widen([self.density_head], [smaller.density_head])
        widen([self.bottleneck], [smaller.bottleneck])
        head, smaller_head = linear_layers(self.color_head), linear_layers(smaller.color_head)
        directions = torch.arange(self.bottleneck.out_features, head[0].in_features)
        widen(head, smaller_head, torch.cat([torch.arange(narrow), directions]))

    def features(self, positions: Float[Tensor, "N 3"]) -> tuple[Float[Tensor, "N"], Float[Tensor, "N F"]]:
        x = sinusoidal(self.bounds.to_unit(positions) * 2 - 1, self.position_frequencies)
        h = x
        for index, layer in enumerate(self.trunk):
            h = torch.relu(layer(torch.cat([h, x], dim=1) if index == self.skip else h))
        return self.activation(self.density_head(h).squeeze(1)), h

    def color(self, features: Float[Tensor, "N F"], directions: Float[Tensor, "N 3"]) -> Float[Tensor, "N 3"]:
        inputs = torch.cat([self.bottleneck(features), sinusoidal(directions, self.direction_frequencies)], dim=1)
        return torch.sigmoid(self.color_head(inputs))
