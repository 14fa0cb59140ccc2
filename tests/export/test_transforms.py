"""Photos and cameras written for other programs, read again."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from nerf_lightning.cameras import Bounds, Cameras, Distortion, Lenses, Projection, make_circle_poses, transform_poses
from nerf_lightning.dataset import Scene, Views
from nerf_lightning.dataset.formats.transforms import load_transforms
from nerf_lightning.errors import InputError
from nerf_lightning.export.transforms import write_photos

WIDTH, HEIGHT = 12, 8


def photographed(count: int, channels: int, lens: Distortion, projection: Projection, masked: bool) -> Views:
    generator = torch.Generator().manual_seed(count)
    pixels = torch.randint(0, 256, (count, HEIGHT, WIDTH, channels), generator=generator, dtype=torch.uint8)
    c2w = make_circle_poses(torch.zeros(3), torch.tensor([0.0, 0, 1]), 1.5, 0.4, count)
    K = torch.tensor([[15.0, 0, 6.2], [0, 14, 3.9], [0, 0, 1]]).repeat(count, 1, 1)
    lenses = Lenses(torch.tensor([lens] * count), torch.tensor([projection] * count)) if any(lens) else None
    cameras = replace(Cameras.pinhole(K, c2w, WIDTH, HEIGHT), lenses=lenses)
    known = None
    if masked:
        known = torch.rand(count * HEIGHT * WIDTH, generator=generator) < 0.7
    return Views(pixels.view(-1, channels), cameras, known, tuple(f"shots/{count}_{i}.jpg" for i in range(count)))


LENSES = {
    "pinhole": (Distortion(), Projection.PERSPECTIVE, True),
    "opencv": (Distortion(k1=0.05, k2=-0.01, p1=0.002, p2=-0.001), Projection.PERSPECTIVE, False),
    "fisheye": (Distortion(k1=0.02, k4=-0.001), Projection.FISHEYE, True),
}


@pytest.mark.parametrize(("lens", "projection", "masked"), LENSES.values(), ids=LENSES)
def test_write_photos_round_trip(lens: Distortion, projection: Projection, masked: bool, tmp_path: Path):
    turn = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(0)))[0]
    to_source = torch.eye(4)
    to_source[:3, :3] = 2.5 * turn * turn.det()
    to_source[:3, 3] = torch.tensor([3.0, -1.0, 0.5])
    train, val = (photographed(count, 3, lens, projection, masked) for count in (6, 2))
    box = Bounds(torch.tensor([[-1.0, -1, -1], [1, 1, 1]]))
    write_photos(Scene("made", "made", train, val, val.cameras, box, to_source=to_source), tmp_path)
    again = load_transforms(tmp_path)
    for views, found in ((train, again.train), (val, again.val)):
        assert torch.equal(found.pixels, views.pixels) and found.names[0] == f"images/{len(views)}_0.png"
        assert torch.equal(found.mask, views.mask)
        torch.testing.assert_close(
            transform_poses(found.cameras.c2w, again.to_source),
            transform_poses(views.cameras.c2w, to_source),
            atol=1e-5,
            rtol=1e-5,
        )
        torch.testing.assert_close(found.cameras.K, views.cameras.K)
        local = [(x.generate_view_rays(1).directions @ x.c2w[1, :3, :3]) for x in (found.cameras, views.cameras)]
        torch.testing.assert_close(*local, atol=1e-5, rtol=1e-5)


def test_write_photos_georeferenced_poses_keep_precision(tmp_path: Path):
    views, written = photographed(3, 3, Distortion(), Projection.PERSPECTIVE, False), []
    to_source = torch.eye(4, dtype=torch.float64)
    box = Bounds(torch.tensor([[-1.0, -1, -1], [1, 1, 1]]))
    for name, shift in (("near", [0.0, 0.0, 0.0]), ("far", [5e5, 5.4112e6, 300.0])):
        to_source[:3, 3] = torch.tensor(shift)
        write_photos(Scene("made", "made", views, views, views.cameras, box, to_source=to_source), tmp_path / name)
        frames = json.loads((tmp_path / name / "transforms.json").read_text())["frames"]
        written.append(torch.tensor([frame["transform_matrix"] for frame in frames], dtype=torch.float64))
    shift = (written[1] - written[0])[:, :3, 3]
    torch.testing.assert_close(shift, to_source[:3, 3].expand(6, 3), atol=1e-8, rtol=0)


def test_write_photos_keeps_alpha_and_renames_duplicates(tmp_path: Path):
    views = photographed(3, 4, Distortion(), Projection.PERSPECTIVE, False)
    for view in range(3):  # cut out
        views.image(view)[[0, -1], :, 3] = 0
        views.image(view)[:, [0, -1], 3] = 0
    box = Bounds(torch.tensor([[-1.0, -1, -1], [1, 1, 1]]))
    write_photos(Scene("made", "made", views, views, views.cameras, box), tmp_path)
    again = load_transforms(tmp_path)
    assert again.val.names == ("images/0003.png", "images/0004.png", "images/0005.png")
    assert torch.equal(again.train.pixels, views.pixels)


def test_write_photos_unknown_lens_raises(tmp_path: Path):
    views = photographed(3, 3, Distortion(d1=0.1), Projection.PERSPECTIVE, False)
    box = Bounds(torch.tensor([[-1.0, -1, -1], [1, 1, 1]]))
    with pytest.raises(InputError, match=r"3_0.jpg: d1: found 0.1, expected at most k1, k2, k3, p1, p2"):
        write_photos(Scene("made", "made", views, views, views.cameras, box), tmp_path)
