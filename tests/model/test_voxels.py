import pytest
import torch

from nerf_lightning.cameras import Bounds
from nerf_lightning.kernels import interpolate_rows, locate_vertices, spherical_harmonics, total_variation
from nerf_lightning.model import VoxelField
from tests.helpers.growth import grow

BOX = Bounds(torch.tensor([[-2.0, -1, 0], [2, 3, 4]]))


def field(**options) -> VoxelField:
    made = VoxelField(BOX, **{"base_resolution": 8, "max_resolution": 16, "stages": 2, "growth_end": 0.5} | options)
    for table in made.tables:
        table.data[1:] = torch.randn(table[1:].shape)
    return made


def positions(count: int = 200) -> torch.Tensor:
    return BOX.to_world(torch.rand(count, 3))


def directions(count: int = 200) -> torch.Tensor:
    return torch.nn.functional.normalize(torch.randn(count, 3), dim=1)


def read_positions(voxels: VoxelField, low: float = 0.0, high: float = 1.0, count: int = 3000) -> torch.Tensor:
    """Reads the field at positions in a part of the box, as training does. Returns the positions."""
    at = BOX.to_world(low + (high - low) * torch.rand(count, 3))
    voxels(at, directions(count))
    return at


@pytest.mark.parametrize("degree", [0, 3])
def test_voxels_density_and_color_follow_tables(degree: int, kernels: str):
    voxels, x, d = field(degree=degree, density_lr_scale=2.0), positions(), directions()
    density, rgb, _ = voxels(x, d)
    rows, weights = locate_vertices(voxels.index, BOX.to_unit(x))
    raw, color, views = (interpolate_rows(table, rows, weights) for table in voxels.tables)
    torch.testing.assert_close(density, torch.exp(voxels.density_lr_scale * raw) / 2)  # half the box is two units long
    torch.testing.assert_close(voxels.density(x), density)
    terms = (degree + 1) ** 2 - 1
    turned = torch.einsum("ncb,nb->nc", views.view(200, 3, terms), spherical_harmonics(d)[:, 1 : 1 + terms])
    torch.testing.assert_close(rgb, torch.sigmoid(color + turned), atol=1e-5, rtol=1e-4)


def test_voxels_upsample_keeps_values_at_read_vertices():
    voxels, x, d = field(), positions(), directions()
    read_positions(voxels)
    before = [part.detach() for part in voxels(x, d)[:2]]
    assert grow(voxels, 0.49) == []
    replaced = grow(voxels, 0.5)
    assert [id(p) for p in replaced] == [id(table) for table in voxels.tables]
    assert len(voxels.index) == 17**3 and len(voxels.log_density) == 17**3 + 1
    # Every second vertex of the fine grid is a vertex of the coarse one: interpolation agrees.
    for ours, theirs in zip(voxels(x, d)[:2], before, strict=True):
        torch.testing.assert_close(ours, theirs, atol=1e-4, rtol=1e-3)
    assert grow(voxels, 0.6) == []


def test_voxels_upsample_drops_unread_vertices():
    voxels = field()
    low = read_positions(voxels, high=0.2)  # reads one corner of the box only
    with torch.no_grad():
        voxels(positions(), directions())  # evaluation does not mark rows as read
    before = voxels.density(low)
    grow(voxels, 1.0)
    assert len(voxels.log_density) < 0.1 * 17**3
    torch.testing.assert_close(voxels.density(low), before, atol=1e-4, rtol=1e-3)
    far = BOX.to_world(0.8 + 0.2 * torch.rand(50, 3))
    assert (voxels.density(far) < 1e-3).all()
    assert voxels.index.min() == 0 and voxels.index.max() == len(voxels.log_density) - 1
    rows = torch.arange(1, len(voxels.vertex_of_row), dtype=torch.int32)
    assert torch.equal(voxels.index[voxels.vertex_of_row[1:].long()], rows)


@pytest.mark.parametrize("grown", [False, True])
def test_voxels_state_in_fresh_field_continues_alike(grown: bool):
    voxels, x, d = field(), positions(), directions()
    read_positions(voxels, high=0.4)
    grow(voxels, 1.0 if grown else 0.1)
    fresh = VoxelField(BOX, base_resolution=8, max_resolution=16, stages=2, growth_end=0.5)
    fresh.load_state_dict(voxels.state_dict())
    for _ in range(3):
        assert len(grow(fresh, 0.1)) == len(grow(voxels, 0.1)) == 0
        assert torch.equal(fresh.losses()["tv"], voxels.losses()["tv"])
        read_positions(fresh), read_positions(voxels)
    for ours, theirs in zip(fresh(x, d)[:2], voxels(x, d)[:2], strict=True):
        assert torch.equal(ours, theirs)
    assert len(grow(fresh, 1.0)) == len(grow(voxels, 1.0)) == (0 if grown else 3)
    assert torch.equal(fresh.index, voxels.index) and torch.equal(fresh.log_density, voxels.log_density)


def test_voxels_tv_loss_covers_each_slice_in_turn():
    voxels = field(tv_weight=0.5)
    slopes = []
    for _ in range(4):
        read_positions(voxels)
        (slope,) = torch.autograd.grad(voxels.losses()["tv"], voxels.log_density)
        slopes.append(slope)
    touched = torch.stack(slopes).bool().sum(0)
    assert touched[0] == 0 and (touched[1:] == 1).all()
    rows = len(voxels.vertex_of_row)
    mean = 0.5 * total_variation(voxels.log_density, voxels.vertex_of_row, voxels.index, 1, rows)
    (expected,) = torch.autograd.grad(mean, voxels.log_density)
    torch.testing.assert_close(sum(slopes) / 4, expected, rtol=0.02, atol=1e-5)
    assert field(tv_weight=0.0).losses() == {}
