import pytest
import torch

from nerf_lightning.cameras import Rays
from nerf_lightning.renderer import render_checkerboard


@pytest.mark.parametrize(("line", "channel"), [(-2, 0), (0, 3), (1, 0), (3, 0), (8, 3)])
def test_pixels_between_are_rendered_near_thin_lines_only(line: int, channel: int):
    index, calls = torch.arange(54), []
    row, column = index // 9, index % 9
    values = torch.linspace(0.2, 0.23, 54)[:, None].repeat(1, 5)
    values[:, 4], values[column == line, channel] = 1 + row, 0.4

    def march(rays: Rays) -> torch.Tensor:
        calls.append(rays.origins[:, 0].long())
        return values[calls[-1]]

    rendered = render_checkerboard(march, Rays(index[:, None].expand(-1, 3).float(), torch.zeros(54, 3)), 9)
    is_near, is_between = (column - line).abs() < 2, (row + column) % 2 == 1
    assert torch.equal(torch.cat(calls), torch.cat([index[~is_between], index[is_between & is_near]]))
    assert torch.equal(rendered[is_near], values[is_near])
    assert float((rendered - values)[:, :4].abs().max()) < 0.02
    assert set(rendered[:, 4].tolist()) == set(values[:, 4].tolist())  # that of a neighbor, never between two
