"""Pictures as networks of encoded coordinates: sinusoids of every octave, random sinusoids, or sinusoidal layers."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.model.field import PictureField
from nerf_lightning.model.layers.encoding import sinusoidal
from nerf_lightning.model.layers.networks import layers, linears, widen
from nerf_lightning.utils.options import Count, Layers, Octaves, Positive


def relu_layers(sizes: list[int]) -> torch.nn.Sequential:
    """Fully connected layers of the given widths with ReLU between them."""
    parts: list[torch.nn.Module] = [torch.nn.Linear(sizes[0], sizes[1])]
    for inputs, outputs in zip(sizes[1:-1], sizes[2:], strict=True):
        parts += [torch.nn.ReLU(), torch.nn.Linear(inputs, outputs)]
    return torch.nn.Sequential(*parts)


class PictureMLP(PictureField):
    """Sinusoidal encoding, then a plain network (the course's NeRF2D).

    Args:
        size: see `PictureField`.
        frequencies: octaves L of the encoding; 0 means the bare coordinates; None takes octaves up to about half the Nyquist
            frequency, as higher ones are unconstrained between the pixels.
        width: neurons of each hidden layer.
        depth: hidden layers.
    """

    def __init__(
        self, size: tuple[int, int], frequencies: Octaves | None = None, width: Count = 256, depth: Layers = 3
    ):
        super().__init__(size)
        if frequencies is None:
            # The last octave has 2^(L-1) / 2 cycles over the picture. At the Nyquist frequency itself a sine would have the
            # same value at all pixels, up to its sign, and anything between them.
            frequencies = 1 + max(0, round(math.log2(self.nyquist)))
        self.frequencies = frequencies
        self.net = relu_layers([2 * (1 + 2 * frequencies), *[width] * depth, 3])

    def warm_start_from(self, smaller: PictureField) -> None:
        """Copies a network with as many layers and at most as many octaves, which come first here."""
        assert isinstance(smaller, PictureMLP)
        if len(self.net) == len(smaller.net) and smaller.frequencies <= self.frequencies:
            widen(linears(self.net), linears(smaller.net))

    def forward(self, uv: Float[Tensor, "N 2"]) -> Float[Tensor, "N 3"]:
        places = 0.5 + 0.5 * self.centred(uv)  # pixels stay square: octaves that suit the longer side suit the shorter
        return torch.sigmoid(self.net(sinusoidal(places, self.frequencies)))


class FourierField(PictureField):
    """Sinusoids of random frequency and direction, then a plain network (Tancik et al. 2020, section 4 and 6.1).

    Args:
        size: see `PictureField`.
        features: number of random frequencies; each gives a sine and a cosine.
        spread: standard deviation of the frequencies, as a share of the Nyquist frequency.
        width: neurons of each hidden layer.
        depth: hidden layers.
        rate: factor on the learning rate.
    """

    def __init__(
        self,
        size: tuple[int, int],
        features: Count = 256,
        spread: Positive = 0.1,
        width: Count = 256,
        depth: Layers = 3,
        rate: Positive = 1.0,
    ):
        super().__init__(size, rate)
        self.cycles: Tensor
        """[2, features], over the picture's longer side; the seed decides them, and checkpoints keep them."""
        self.register_buffer("cycles", torch.randn(2, features) * spread * self.nyquist)
        self.net = relu_layers([2 * features, *[width] * depth, 3])

    def forward(self, uv: Float[Tensor, "N 2"]) -> Float[Tensor, "N 3"]:
        angles = math.pi * self.centred(uv) @ self.cycles  # the longer side is 2 units long
        return torch.sigmoid(self.net(torch.cat([angles.sin(), angles.cos()], dim=1)))


class SirenField(PictureField):
    """A network with sines for activations (SIREN, Sitzmann et al. 2020, section 3.2 and supplement 1.5).

    Args:
        size: see `PictureField`.
        width: neurons of each hidden layer.
        depth: hidden layers.
        reach: angular frequency of the first layer as a share of the Nyquist frequency; 0.075 gives the paper's 30 for a
            picture of 256 pixels.
        rate: factor on the learning rate.
    """

    HIDDEN_FREQUENCY = 30.0  # omega_0 of the later layers, which the paper keeps whatever the signal

    def __init__(
        self, size: tuple[int, int], width: Count = 256, depth: Layers = 3, reach: Positive = 0.15, rate: Positive = 0.1
    ):
        super().__init__(size, rate)
        # In radians per unit; the longer side is 2 units long.
        self.first_frequency = reach * math.pi * self.nyquist
        self.hidden = layers(2, *[width] * depth)
        self.last = torch.nn.Linear(width, 3)
        self.reset_parameters()

    @torch.no_grad()
    def reset_parameters(self) -> None:
        """Draws weights so that all layers' activations have equal variance; biases stay as the layers drew them."""
        for index, layer in enumerate([*self.hidden, self.last]):
            inputs = layer.weight.shape[1]
            bound = 1 / inputs if index == 0 else math.sqrt(6 / inputs) / self.HIDDEN_FREQUENCY
            layer.weight.uniform_(-bound, bound)

    def forward(self, uv: Float[Tensor, "N 2"]) -> Float[Tensor, "N 3"]:
        h = self.centred(uv)
        for index, layer in enumerate(self.hidden):
            h = torch.sin((self.first_frequency if index == 0 else self.HIDDEN_FREQUENCY) * layer(h))
        return 0.5 + 0.5 * self.last(h)  # the paper's outputs lie around 0; display clips to [0, 1]
