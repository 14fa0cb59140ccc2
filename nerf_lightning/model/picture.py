"""A picture as a small network of encoded coordinates."""

import torch
from jaxtyping import Float
from torch import Tensor

from nerf_lightning.model.encoding import sinusoidal
from nerf_lightning.model.field import PictureField
from nerf_lightning.options import Count


class PictureMLP(PictureField):
    """Sinusoidal encoding, then a plain network (the course's NeRF2D).

    Args:
        frequencies: octaves L of the encoding; 0 feeds the bare coordinates.
        width: neurons of each hidden layer.
        depth: hidden layers.
    """

    def __init__(self, frequencies: int = 10, width: Count = 256, depth: Count = 3):
        super().__init__()
        self.frequencies = frequencies
        sizes = [2 * (1 + 2 * frequencies)] + [width] * depth
        hidden = [
            m for a, b in zip(sizes[:-1], sizes[1:], strict=True) for m in (torch.nn.Linear(a, b), torch.nn.ReLU())
        ]
        self.net = torch.nn.Sequential(*hidden, torch.nn.Linear(sizes[-1], 3))

    def forward(self, uv: Float[Tensor, "N 2"]) -> Float[Tensor, "N 3"]:
        return torch.sigmoid(self.net(sinusoidal(uv, self.frequencies)))
