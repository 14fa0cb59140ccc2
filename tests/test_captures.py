"""What the benchmark of captures compares with: rooms whose true depth is known."""

from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from benchmarks import captures
from benchmarks.synthetic import rooms
from nerf_lightning.cameras import Bounds, Rays
from nerf_lightning.dataset import open_scene
from nerf_lightning.sampler import UniformSampler
from nerf_lightning.synthetic.objects import trace_rays
from nerf_lightning.synthetic.rooms import ROOMS


def test_true_view_of_room_gives_distance_and_body(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    for name, value in (("WIDTH", 48), ("HEIGHT", 36), ("VIEWS", 16)):
        monkeypatch.setattr(rooms, name, value)
    room = ROOMS["filling subject"]
    rooms.write_room(room, tmp_path / "room")
    scene = open_scene(str(tmp_path / "room"))
    assert scene.bounds.unbounded and len(scene.val) == 2
    distance, body = rooms.true_view(room, scene, 0)
    rays = scene.val.cameras.view_rays(0)
    # The subject is what the cameras stand around, a distance of about 1 away.
    assert 0.2 < float((body < room.subject).float().mean()) < 0.9
    assert 0.3 < float(distance[body < room.subject].median()) < 1.2
    places = rays.origins + distance[:, None] * rays.directions
    floor = places[body == room.floor]
    assert len(floor) > 50 and float(floor[:, 2].std()) < 0.15 * float(places.std())
    seen = trace_rays(room.bodies, Rays(*(x.float() for x in (rays_in_the_room(rays, scene)))))[0]
    off = (seen - scene.val.image(0).view(-1, 3) / 255).abs()
    assert float(off.median()) < 0.05
    own = scene.train.cameras.view_rays(3)
    distance, body = rooms.meet(room, scene, own)
    surface, behind = (
        rooms.photos_that_show(room, scene, own.origins + share * distance[:, None] * own.directions)
        for share in (1, 1.3)
    )
    assert int(surface.min()) >= 1 and int(surface.max()) <= len(scene.train)
    subject = body < room.subject  # 1.3 times as far is its inside, or what it hides from here
    assert float(behind[subject].float().mean()) < 0.5 * float(surface[subject].float().mean())


def rays_in_the_room(rays: Rays, scene) -> tuple[torch.Tensor, torch.Tensor]:
    turn = scene.to_source[:3, :3].float()
    directions = rays.directions @ turn.mT
    return rays.origins @ turn.mT + scene.to_source[:3, 3], torch.nn.functional.normalize(directions, dim=1)


def test_opacity_before_surface_measures_fog():
    """Rays along x meet thin fog between 1 and 2, and a wall at 4. One interval may span the surface."""

    def density(places: torch.Tensor) -> torch.Tensor:
        x = places[:, 0]
        return torch.where((x > 1) & (x < 2), 0.1, 0.0) + torch.where(x > 4, 100.0, 0.0)

    bounds = Bounds(torch.tensor([[0.0, -1, -1], [6, 1, 1]]))
    system = SimpleNamespace(sampler=UniformSampler(bounds, 600), field=SimpleNamespace(density=density))
    rays = Rays(torch.zeros(3, 3), torch.tensor([[1.0, 0, 0]]).repeat(3, 1))
    before = captures.opacity_before(system, rays, torch.tensor([3.999, 3.5, 1.5]))
    torch.testing.assert_close(before, torch.tensor([0.0952, 0.0952, 0.0488]), atol=2e-3, rtol=0)
