"""Coordinate networks for pictures: positional encoding, random Fourier features, and SIREN."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.model.field import PictureField
from nerf_lightning.model.layers.encoding import sinusoidal
from nerf_lightning.model.layers.networks import build_layers, linear_layers, widen
from nerf_lightning.utils.option_checks import Count, Frequencies, Layers, PositiveFloat


def build_relu_mlp(sizes: list[int]) -> torch.nn.Sequential:
    """Linear layers of the given widths with ReLU between them."""
    parts: list[torch.nn.Module] = [torch.nn.Linear(sizes[0], sizes[1])]
    for inputs, outputs in zip(sizes[1:-1], sizes[2:], strict=True):
        parts += [torch.nn.ReLU(), torch.nn.Linear(inputs, outputs)]
    return torch.nn.Sequential(*parts)


class PictureMLP(PictureField):
    """Sinusoidal encoding followed by an MLP (the course's NeRF2D).

    Args:
        size: see `PictureField`.
        num_frequencies: octaves L of the encoding; 0: the bare coordinates; None: octaves up to about half the Nyquist
            frequency, as higher ones are unconstrained between the pixels.
        width: neurons of each hidden layer.
        depth: hidden layers.
    """

    def __init__(
        self, size: tuple[int, int], num_frequencies: Frequencies | None = None, width: Count = 256, depth: Layers = 3
    ):
        super().__init__(size)
        if num_frequencies is None:
            # The last octave has 2^(L-1) / 2 cycles over the picture. At the Nyquist frequency a sine has the same absolute
            # value at all pixels and is unconstrained between them.
            num_frequencies = 1 + max(0, round(math.log2(self.nyquist)))
        self.num_frequencies = num_frequencies
        self.net = build_relu_mlp([2 * (1 + 2 * num_frequencies), *[width] * depth, 3])

    def warm_start_from(self, smaller: PictureField) -> None:
        """Copies a network of the same depth with at most the same number of octaves."""
        assert isinstance(smaller, PictureMLP)
        if len(self.net) == len(smaller.net) and smaller.num_frequencies <= self.num_frequencies:
            widen(linear_layers(self.net), linear_layers(smaller.net))

    def forward(self, uv: Float[Tensor, "N 2"]) -> Float[Tensor, "N 3"]:
        positions = 0.5 + 0.5 * self.centered(uv)  # square pixels: one set of octaves for both axes
        return torch.sigmoid(self.net(sinusoidal(positions, self.num_frequencies)))


class FourierField(PictureField):
    """Random Fourier features followed by an MLP (Tancik et al. 2020, sections 4 and 6.1).

    Args:
        size: see `PictureField`.
        num_frequencies: number of random frequencies; each gives a sine and a cosine.
        frequency_std: standard deviation of the frequencies, relative to the Nyquist frequency.
        width: neurons of each hidden layer.
        depth: hidden layers.
        lr_scale: factor on the learning rate.
    """

    def __init__(
        self,
        size: tuple[int, int],
        num_frequencies: Count = 256,
        frequency_std: PositiveFloat = 0.1,
        width: Count = 256,
        depth: Layers = 3,
        lr_scale: PositiveFloat = 1.0,
    ):
        super().__init__(size, lr_scale)
        self.cycles: Tensor
        """Random frequencies [2, num_frequencies], cycles over the picture's longer side."""
        self.register_buffer("cycles", torch.randn(2, num_frequencies) * frequency_std * self.nyquist)
        self.net = build_relu_mlp([2 * num_frequencies, *[width] * depth, 3])

    def forward(self, uv: Float[Tensor, "N 2"]) -> Float[Tensor, "N 3"]:
        angles = math.pi * self.centered(uv) @ self.cycles  # the longer side is 2 units long
        return torch.sigmoid(self.net(torch.cat([angles.sin(), angles.cos()], dim=1)))


class SirenField(PictureField):
    """An MLP with sine activations (SIREN, Sitzmann et al. 2020, section 3.2 and supplement 1.5).

    Args:
        size: see `PictureField`.
        width: neurons of each hidden layer.
        depth: hidden layers.
        first_frequency: angular frequency of the first layer relative to the Nyquist frequency; 0.075 gives the paper's 30
            for a picture of 256 pixels.
        lr_scale: factor on the learning rate.
    """

    HIDDEN_FREQUENCY = 30.0  # omega_0 of the later layers, independent of the signal as in the paper

    def __init__(
        self,
        size: tuple[int, int],
        width: Count = 256,
        depth: Layers = 3,
        first_frequency: PositiveFloat = 0.15,
        lr_scale: PositiveFloat = 0.1,
    ):
        super().__init__(size, lr_scale)
        # In radians per unit; the longer side is 2 units long.
        self.first_frequency = first_frequency * math.pi * self.nyquist
        self.hidden = build_layers(2, *[width] * depth)
        self.last = torch.nn.Linear(width, 3)
        self.reset_parameters()

    @torch.no_grad()
    def reset_parameters(self) -> None:
        """Draws weights such that all layers' activations have equal variance; biases keep `nn.Linear`'s initialization."""
        for index, layer in enumerate([*self.hidden, self.last]):
            inputs = layer.weight.shape[1]
            bound = 1 / inputs if index == 0 else math.sqrt(6 / inputs) / self.HIDDEN_FREQUENCY
            layer.weight.uniform_(-bound, bound)

    def forward(self, uv: Float[Tensor, "N 2"]) -> Float[Tensor, "N 3"]:
        h = self.centered(uv)
        for index, layer in enumerate(self.hidden):
            h = torch.sin((self.first_frequency if index == 0 else self.HIDDEN_FREQUENCY) * layer(h))
        return 0.5 + 0.5 * self.last(h)  # the paper's outputs lie around 0; display clips to [0, 1]
