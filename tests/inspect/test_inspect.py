"""python -m nerf_lightning.inspect: what is wrong with photos is named, what is right is not."""

from collections.abc import Callable
from pathlib import Path

import cv2
import imageio.v3 as imageio
import numpy as np
import pytest
import torch

from nerf_lightning.dataset import Views, open_scene
from nerf_lightning.drawing.camera_map import camera_map
from nerf_lightning.inspect.quality import judge, look_at, sharpness
from nerf_lightning.inspect.verb import inspect
from nerf_lightning.synthetic.objects import PILE, place_cameras, render_photos
from tests.dataset.colmap_files import cameras_of, photos, write_colmap

Edit = Callable[[np.ndarray], np.ndarray]


@pytest.fixture(scope="module")
def views() -> Views:
    """A pile on grey grain."""
    cameras = place_cameras(16, 96)
    images = render_photos(PILE, cameras, (0.5, 0.5, 0.5)).numpy().astype(np.int16)
    noise = cv2.GaussianBlur(np.random.default_rng(0).normal(0, 60, (96, 96)), (0, 0), 1.0)
    grain = np.stack([np.roll(noise, 7 * i, axis=1) for i in range(16)])[..., None]
    return Views.of(torch.from_numpy((images + grain).clip(0, 255).astype(np.uint8)), cameras)


def capture(folder: Path, views: Views, edits: dict[int, Edit]) -> Path:
    names = photos(folder / "images", views)
    for i, edit in edits.items():
        imageio.imwrite(folder / "images" / names[i], edit(imageio.imread(folder / "images" / names[i])))
    write_colmap(folder / "sparse/0", views.cameras.c2w.numpy(), names, cameras_of(views))
    return folder


def troubles(folder: Path) -> dict[str, list[str]]:
    scene = open_scene(str(folder))
    found = [*look_at(scene.train, "train", 1), *look_at(scene.val, "held out", 1 + len(scene.train))]
    found.sort(key=lambda photo: photo.name)
    judge(found, False)
    return {photo.name: [text.split(":")[0] for text in photo.troubles] for photo in found if photo.troubles}


def test_good_photos_raise_no_remark(views: Views, tmp_path: Path):
    assert troubles(capture(tmp_path, views, {})) == {}


def test_each_trouble_is_named(views: Views, tmp_path: Path):
    folder = capture(
        tmp_path,
        views,
        {
            2: lambda image: cv2.GaussianBlur(image, (0, 0), 1.2),
            5: lambda image: (image.astype(float) * 1.9).clip(0, 255).astype(np.uint8),
            7: lambda image: (image * 0.1).astype(np.uint8),
        },
    )
    (folder / "images/0011.png").write_bytes((folder / "images/0010.png").read_bytes())
    found = troubles(folder)
    assert found == {
        "0002.png": ["blurred"],
        "0005.png": ["over-exposed", "brighter than the others"],
        "0007.png": ["darker than the others"],
        "0011.png": ["doubled"],
    }


def test_sharpness_does_not_depend_on_exposure(views: Views):
    image = views.image(3).numpy()
    dark = (image * 0.5).astype(np.uint8)
    assert sharpness(dark) == pytest.approx(sharpness(image), rel=0.1)
    assert sharpness(cv2.GaussianBlur(image, (0, 0), 1.5)) < 0.7 * sharpness(image)


def test_the_page_says_everything_and_opens_without_a_network(
    views: Views, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    folder = capture(tmp_path / "a <b>", views, {2: lambda image: cv2.GaussianBlur(image, (0, 0), 1.5)})
    (folder / "images/9999.png").write_bytes((folder / "images/0000.png").read_bytes())
    page = tmp_path / "look.html"
    inspect(str(folder), str(page), 64, 8, "auto", False, False)
    text = page.read_text(encoding="utf-8")
    assert "14 to train on, 2 held out" in text and "16 of 64x64" in text and "0002.png" in text
    assert "1 photos have no place in the model, 9999.png" in text and "<b>" not in text and "a &lt;b&gt;" in text
    assert text.index("<h1>") < text.index("cameras from above") < text.index("<td>source") < text.index("<h2>Photos")
    assert text.count("data:image/jpeg") == 16 and "http" not in text.replace("http-equiv", "")
    out = capsys.readouterr().out
    assert "0002.png: blurred" in out and str(page) in out


def test_the_map_shows_the_points_and_the_box(views: Views, tmp_path: Path):
    folder = capture(tmp_path, views, {})
    points = np.random.default_rng(0).normal(0, 0.3, (300, 3))
    write_colmap(
        folder / "sparse/0",
        views.cameras.c2w.numpy(),
        sorted(f"{i:04d}.png" for i in range(16)),
        cameras_of(views),
        points=points,
    )
    scene = open_scene(str(folder))
    numbered = [(i, c2w) for i, c2w in enumerate(scene.train.cameras.c2w.double().numpy())]
    figure = camera_map(numbered, scene, {})
    assert scene.points is not None
    above, beside = figure.axes
    for axes, up in ((above, 1), (beside, 2)):
        lines = [np.asarray(line.get_xydata()) for line in axes.lines]
        assert any(len(xy) == 300 and np.allclose(xy, scene.points[:, [0, up]]) for xy in lines)
        assert any(np.allclose(xy[[0, 2]], scene.bounds.aabb[:, [0, up]]) for xy in lines if len(xy) == 5)
    assert [text.get_text() for text in figure.legends[0].get_texts()][-1] == "known points"


def test_bad_input_is_one_line(verb, tmp_path: Path):
    from nerf_lightning.config import cli
    from nerf_lightning.inspect.__main__ import task

    def main() -> None:
        cli.run("inspect", task, texts=("scene", "output"))

    code, _, errors = verb(main, "scene=nowhere")
    assert code == 2 and errors.count("\n") == 1 and "nowhere: found nothing there" in errors
    code, _, errors = verb(main, "scene=nowhere", "holdout=1")
    assert code == 2 and "holdout: found 1" in errors
    assert not list(tmp_path.iterdir())
