"""The check command: issues of damaged photos are reported, good photos are not."""

from collections.abc import Callable
from pathlib import Path

import cv2
import imageio.v3 as imageio
import numpy as np
import pytest
import torch

from nerf_lightning.check.photo_quality import sharpness
from nerf_lightning.check.report import assess_photos
from nerf_lightning.cli.check import check
from nerf_lightning.dataset import Views, open_scene
from nerf_lightning.drawing.camera_map import plot_camera_map
from nerf_lightning.synthetic.objects import PILE, make_hemisphere_cameras, render_photos
from tests.helpers.scene_writers import colmap_cameras, write_colmap, write_photos

Edit = Callable[[np.ndarray], np.ndarray]


@pytest.fixture(scope="module")
def views() -> Views:
    """A pile on gray grain."""
    cameras = make_hemisphere_cameras(16, 96)
    images = render_photos(PILE, cameras, (0.5, 0.5, 0.5)).numpy().astype(np.int16)
    noise = cv2.GaussianBlur(np.random.default_rng(0).normal(0, 60, (96, 96)), (0, 0), 1.0)
    grain = np.stack([np.roll(noise, 7 * i, axis=1) for i in range(16)])[..., None]
    return Views.from_images(torch.from_numpy((images + grain).clip(0, 255).astype(np.uint8)), cameras)


def capture(folder: Path, views: Views, edits: dict[int, Edit], points: np.ndarray | None = None) -> Path:
    names = write_photos(folder / "images", views)
    for i, edit in edits.items():
        imageio.imwrite(folder / "images" / names[i], edit(imageio.imread(folder / "images" / names[i])))
    given = {} if points is None else {"points": points}
    write_colmap(folder / "sparse/0", views.cameras.c2w.numpy(), names, colmap_cameras(views), **given)
    return folder


def issues(folder: Path) -> dict[str, list[str]]:
    found, _ = assess_photos(open_scene(str(folder)))
    return {photo.name: [text.split(":")[0] for text in photo.issues] for photo in found if photo.issues}


def test_assess_photos_of_damaged_photos_names_each_issue(views: Views, tmp_path: Path):
    edits: dict[int, Edit] = {
        2: lambda image: cv2.GaussianBlur(image, (0, 0), 1.2),
        5: lambda image: (image.astype(float) * 1.9).clip(0, 255).astype(np.uint8),
        7: lambda image: (image * 0.1).astype(np.uint8),
    }
    assert issues(capture(tmp_path / "good", views, {})) == {}
    folder = capture(tmp_path / "bad", views, edits)
    (folder / "images/0011.png").write_bytes((folder / "images/0010.png").read_bytes())
    assert issues(folder) == {
        "0002.png": ["blurred"],
        "0005.png": ["over-exposed", "brighter than the others"],
        "0007.png": ["darker than the others"],
        "0011.png": ["duplicate"],
    }


def test_sharpness_does_not_depend_on_exposure(views: Views):
    image = views.image(3).numpy()
    dark = (image * 0.5).astype(np.uint8)
    assert sharpness(dark) == pytest.approx(sharpness(image), rel=0.1)
    assert sharpness(cv2.GaussianBlur(image, (0, 0), 1.5)) < 0.7 * sharpness(image)


def test_render_check_page_shows_photos_worst_first(views: Views, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    folder = capture(tmp_path / "a <b>", views, {9: lambda image: cv2.GaussianBlur(image, (0, 0), 1.5)})
    (folder / "images/9999.png").write_bytes((folder / "images/0000.png").read_bytes())
    page = tmp_path / "page.html"
    found = check(folder, output=page, resize=64)
    assert any(line.startswith("0009.png: blurred") for line in found)
    assert "0009.png: blurred" in capsys.readouterr().out
    text = page.read_text(encoding="utf-8")
    assert "14 to train on, 2 held out" in text and "16 of 64 x 64" in text
    assert "ignoring 1 photos that are not in the model: 9999.png" in text and "<b>" not in text.split("<figure")[0]
    assert "a &lt;b&gt;" in text and "http" not in text.replace("http-equiv", "")
    figures = text.split("<figure")[1:]
    assert len(figures) == 16 and "0009.png" in figures[0] and "0000.png" in figures[1]
    assert all("data:image/jpeg" in figure for figure in figures)


def test_plot_camera_map_shows_points_and_box(views: Views, tmp_path: Path):
    scene = open_scene(str(capture(tmp_path, views, {}, np.random.default_rng(0).normal(0, 0.3, (300, 3)))))
    figure = plot_camera_map(list(enumerate(scene.train.cameras.c2w.double().numpy())), scene, {})
    assert scene.points is not None
    above, side = figure.axes
    for axes, up in ((above, 1), (side, 2)):
        lines = [np.asarray(line.get_xydata()) for line in axes.lines]
        assert any(len(xy) == 300 and np.allclose(xy, scene.points[:, [0, up]]) for xy in lines)
        assert any(np.allclose(xy[[0, 2]], scene.bounds.aabb[:, [0, up]]) for xy in lines if len(xy) == 5)
    assert [text.get_text() for text in figure.legends[0].get_texts()][-1] == "known points"
