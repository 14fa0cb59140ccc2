import pytest
import torch
from torch.nn.functional import normalize

from nerf_lightning.cameras import Bounds
from nerf_lightning.model import TensoRFField
from tests.helpers.growth import grow

BOX = Bounds(torch.tensor([[-2.0, -1, 0], [2, 3, 5]]))
SMALL = {"density_components": 3, "color_components": 8, "base_resolution": 4, "max_resolution": 16}
SMALL |= {"stages": 3, "growth_end": 0.5}


def field(**options) -> TensoRFField:
    made = TensoRFField(BOX, **SMALL | {"width": 8} | options)
    for volume in (made.density_volume, made.color_volume):
        for parameter in volume.parameters():
            parameter.data = torch.randn(parameter.shape)
    return made


def positions(count: int = 200) -> torch.Tensor:
    return BOX.to_world(torch.rand(count, 3))


def directions(count: int = 200) -> torch.Tensor:
    return normalize(torch.randn(count, 3), dim=1)


def test_tensorf_density_is_sum_of_planes_times_lines():
    tensorf = field(density_components=1, base_resolution=1, max_resolution=1, stages=1)
    planes, lines = tensorf.density_volume.planes.detach(), tensorf.density_volume.lines.detach()
    for i, j, k in ((0, 0, 0), (1, 0, 0), (0, 1, 1), (1, 0, 1)):
        total = planes[0, j, k] * lines[0, i] + planes[1, i, k] * lines[1, j] + planes[2, i, j] * lines[2, k]
        corner = BOX.to_world(torch.tensor([[i, j, k]]).float())
        torch.testing.assert_close(tensorf.features(corner)[0], total.exp(), rtol=1e-4, atol=0)


def test_tensorf_grows_with_progress_and_never_back():
    tensorf = field()
    assert tensorf.resolutions == [4, 8, 16] and tensorf.growth is not None
    assert [tensorf.growth.stage_at(p) for p in (0.0, 0.24, 0.25, 0.49, 0.5, 1.0)] == [0, 0, 1, 1, 2, 2]
    at_once = field(growth_end=0.0).growth
    assert at_once is not None and at_once.stage_at(0.0) == 2 and field(max_resolution=4, stages=1).growth is None
    volumes = [*tensorf.density_volume.parameters(), *tensorf.color_volume.parameters()]
    assert grow(tensorf, 0.2) == []
    for progress, cells in ((0.25, 8), (0.9, 16)):
        replaced = grow(tensorf, progress)
        assert [id(p) for p in replaced] == [id(p) for p in volumes], "the same parameters, with other data"
        assert all(p.shape[1] == cells + 1 for p in volumes)
    assert grow(tensorf, 1.0) == [] and grow(tensorf, 0.0) == []
    assert tensorf.density_volume.cells == 16


@pytest.mark.parametrize(("progress", "exact"), [(0.25, True), (1.0, True), (1.0, False)])
def test_tensorf_upsample_keeps_values_at_old_vertices(progress: float, exact: bool):
    tensorf = field() if exact else field(max_resolution=10)
    x, d = positions(), directions()
    before = [part.detach() for part in tensorf(x, d)[:2]]
    assert grow(tensorf, progress)
    differences = [(ours - theirs).abs().max() for ours, theirs in zip(tensorf(x, d)[:2], before, strict=True)]
    assert (max(differences) < 1e-3) == exact


@pytest.mark.parametrize(("saved_at", "loaded_at"), [(1.0, 0.0), (0.3, 1.0)])
def test_tensorf_state_of_any_stage_loads(saved_at: float, loaded_at: float):
    saved, loaded = field(), field()
    grow(saved, saved_at)
    grow(loaded, loaded_at)
    wrapped = torch.nn.ModuleDict({"field": loaded})  # as in a system
    wrapped.load_state_dict(torch.nn.ModuleDict({"field": saved}).state_dict())
    x, d = positions(), directions()
    for ours, theirs in zip(loaded(x, d)[:2], saved(x, d)[:2], strict=True):
        assert torch.equal(ours, theirs)
    assert grow(loaded, saved_at) == [], "what was loaded has the size of its stage"
    grow(loaded, 1.0)
    assert loaded.density_volume.cells == 16
