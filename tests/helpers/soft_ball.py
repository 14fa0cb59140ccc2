"""A known field, and cameras around it: photos of it have exact poses and light."""

import torch
from torch import Tensor

from nerf_lightning.cameras import Bounds, Cameras, look_at

BOX = Bounds(torch.tensor([[-1.0] * 3, [1.0] * 3]))


def make_ball_cameras(views: int, size: int) -> Cameras:
    """Cameras at random places, looking at its center; their photos have that many pixels along each side."""
    centers = 3 * torch.nn.functional.normalize(torch.randn(views, 3), dim=1)
    K = torch.tensor([[1.2 * size, 0, size / 2], [0, 1.2 * size, size / 2], [0, 0, 1]])
    return Cameras.pinhole(K.repeat(views, 1, 1), look_at(centers, torch.zeros(3), torch.eye(3)[2]), size, size)


def evaluate_soft_ball(positions: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
    """A ball with soft borders, whose color changes from place to place."""
    density = 8 * torch.sigmoid(8 * (0.7 - positions.norm(dim=1)))
    return density, torch.sigmoid(4 * torch.sin(3 * positions + torch.tensor([0, 1, 2]).to(positions)))
