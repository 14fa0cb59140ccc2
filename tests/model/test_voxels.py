import pytest
import torch

from nerf_lightning.cameras import Bounds
from nerf_lightning.errors import InputError
from nerf_lightning.model import VoxelField

BOX = Bounds(torch.tensor([[-2.0, -1, 0], [2, 3, 4]]))


def field(**options) -> VoxelField:
    made = VoxelField(BOX, **{"coarsest": 8, "finest": 16, "stages": 2, "grown": 0.5} | options)
    made.log_density.data[1:] = torch.randn(len(made.log_density) - 1)
    made.coefficients.data[1:] = torch.randn(made.coefficients[1:].shape)
    return made


def positions(count: int = 200) -> torch.Tensor:
    return BOX.to_world(torch.rand(count, 3))


def directions(count: int = 200) -> torch.Tensor:
    return torch.nn.functional.normalize(torch.randn(count, 3), dim=1)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_the_short_way_agrees_with_features_and_colour(degree):
    voxels, x, d = field(degree=degree), positions(), directions()
    density, rgb = voxels(x, d)
    raw, features = voxels.features(x)
    torch.testing.assert_close(density, raw / voxels.unit_length)
    torch.testing.assert_close(voxels.density(x), density)
    torch.testing.assert_close(rgb, voxels.colour(features, d), atol=1e-5, rtol=1e-4)
    assert (density > 0).all() and (rgb > 0).all() and (rgb < 1).all()


def test_growing_keeps_the_field_where_everything_was_seen():
    voxels, x, d = field(), positions(), directions()
    voxels.touched[:] = True
    before = [part.detach() for part in voxels(x, d)]
    assert voxels.grow(0.49) == []
    replaced = voxels.grow(0.5)
    assert [id(p) for p in replaced] == [id(voxels.log_density), id(voxels.coefficients)]
    assert len(voxels.index) == 17**3 and len(voxels.log_density) == 17**3 + 1
    # Every second vertex of the finer grid is one of the coarser: trilinear interpolation is the same on both.
    for ours, theirs in zip(voxels(x, d), before, strict=True):
        torch.testing.assert_close(ours, theirs, atol=1e-4, rtol=1e-3)
    assert voxels.grow(0.6) == []


def test_growing_drops_what_no_sample_has_read():
    voxels = field()
    low = BOX.to_world(0.2 * torch.rand(50, 3))
    voxels(low, directions(50))  # only one corner of the box is looked at
    with torch.no_grad():
        voxels(positions(), directions())  # an evaluation is no training
    before = voxels.density(low)
    voxels.grow(1.0)
    assert len(voxels.log_density) < 0.2 * 17**3
    torch.testing.assert_close(voxels.density(low), before, atol=1e-4, rtol=1e-3)
    far = BOX.to_world(0.8 + 0.2 * torch.rand(50, 3))
    assert (voxels.density(far) < 1e-3).all()
    assert voxels.index.min() == 0 and voxels.index.max() == len(voxels.log_density) - 1


def test_growing_does_not_mind_a_graph_from_before():
    voxels = field()
    before = voxels(positions(), directions())
    voxels.grow(1.0)
    density, rgb = voxels(positions(), directions())
    (density.sum() + rgb.sum()).backward()
    assert voxels.coefficients.grad.shape == voxels.coefficients.shape
    assert before[0].requires_grad


def test_what_was_read_in_the_first_half_of_a_stage_is_forgotten():
    voxels = field()
    voxels(positions(), directions())
    voxels.grow(0.24)
    assert voxels.touched.any()
    voxels.grow(0.25)
    assert not voxels.touched.any()
    voxels(positions(), directions())
    voxels.grow(0.3)
    assert voxels.touched.any()


def test_a_grown_state_loads_into_a_fresh_field():
    grown, x, d = field(), positions(), directions()
    grown(x[:20], d[:20])
    grown.grow(1.0)
    fresh = VoxelField(BOX, coarsest=8, finest=16, stages=2, grown=0.5)
    fresh.load_state_dict(grown.state_dict())
    for ours, theirs in zip(fresh(x, d), grown(x, d), strict=True):
        assert torch.equal(ours, theirs)
    assert fresh.grow(1.0) == []  # the stage came along


def test_the_empty_row_does_not_learn():
    voxels = field()
    voxels.touched[1:30] = True
    voxels.grow(1.0)
    density, rgb = voxels(positions(), directions())
    (density.sum() + rgb.sum()).backward()
    assert voxels.log_density.grad[0] == 0 and not voxels.coefficients.grad[0].any()


@pytest.mark.parametrize(
    ("options", "key"),
    [({"coarsest": 20}, "model.coarsest"), ({"degree": 4}, "model.degree"), ({"grown": 0.0}, "model.grown")],
)
def test_bad_options_are_named(options, key):
    with pytest.raises(InputError, match=key):
        field(**options)
