"""Channels of frames against the renderer's output."""

import numpy as np
import pytest
import torch

from nerf_lightning.drawing.channels import FrameStyle, make_error_image, render_channel
from nerf_lightning.drawing.panels import colorize_depth
from nerf_lightning.renderer import RenderOutput

RED = torch.tensor([1.0, 0.0, 0.0])


def render_output(background: torch.Tensor) -> RenderOutput:
    """Three rays: empty, half opaque red at distance 2, opaque red at 4."""
    opacity = torch.tensor([0.0, 0.5, 1.0])
    rgb = opacity[:, None] * RED + (1 - opacity)[:, None] * background
    return RenderOutput(rgb, opacity, opacity * torch.tensor([0.0, 2.0, 4.0]))


def test_render_channel_with_background_shows_it_except_in_opacity():
    blue = (0.0, 0.0, 1.0)
    style = FrameStyle(("rgb", "depth", "opacity"), blue, (2.0, 4.0))
    rendered = render_output(torch.tensor(blue))
    mixed = torch.tensor([[0, 0, 1.0], [0.5, 0, 0.5], [1, 0, 0]])
    torch.testing.assert_close(render_channel(rendered, "rgb", style), mixed)
    near, far = torch.from_numpy(colorize_depth(np.array([2.0, 4.0]), 2.0, 4.0)) / 255
    expected = torch.stack([torch.tensor(blue), 0.5 * near + torch.tensor([0, 0, 0.5]), far])
    torch.testing.assert_close(render_channel(rendered, "depth", style), expected)
    gray = torch.tensor([[0.0], [0.5], [1.0]]).expand(3, 3)
    torch.testing.assert_close(render_channel(rendered, "opacity", style), gray)


def test_render_channel_transparent_has_straight_alpha():
    style = FrameStyle(("rgb",), None, (0.0, 1.0))
    straight = render_channel(render_output(torch.zeros(3)), "rgb", style)
    assert straight.shape == (3, 4)
    torch.testing.assert_close(straight[:, 3], torch.tensor([0.0, 0.5, 1.0]))
    torch.testing.assert_close(straight[1:, :3], RED.expand(2, 3))
    white = straight[:, :3] * straight[:, 3:] + (1 - straight[:, 3:])
    torch.testing.assert_close(white, render_output(torch.ones(3)).rgb)
    torch.testing.assert_close(render_channel(render_output(torch.zeros(3)), "opacity", style)[:, 3], torch.ones(3))


def test_colorize_depth_near_is_bright_and_clamped():
    brightness = colorize_depth(np.array([0.0, 1.0, 1.5, 2.0, 9.0]), 1.0, 2.0).astype(int).sum(1)
    assert brightness[0] == brightness[1] > brightness[2] > brightness[3] == brightness[4]
    assert colorize_depth(np.full((4, 5), 1.5), 1.0, 2.0)[0, 0].tolist() == [186, 54, 85], "inferno's middle glows red"


def test_make_error_image_is_magnified_and_gives_psnr():
    truth = np.full((4, 5, 3), 100, np.uint8)
    shown = truth.copy()
    shown[..., 0] += 10
    picture, psnr = make_error_image(shown, truth)
    assert (picture == np.array([40, 0, 0])).all()
    assert psnr == pytest.approx(10 * np.log10(255**2 / (100 / 3)))
