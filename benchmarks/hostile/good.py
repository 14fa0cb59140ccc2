"""Inputs that are good: one small scene in every format, a run of it, its compact file, and what else a command line reads."""

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from omegaconf import OmegaConf
from PIL import ExifTags, Image
from scipy.spatial.transform import Rotation

from nerf_lightning.config.compose import composed
from nerf_lightning.dataset import Scene, Views
from nerf_lightning.dataset.bricks.scene import bricks
from nerf_lightning.dataset.formats.npz import save_npz
from nerf_lightning.export.photos import write_photos, write_picture
from nerf_lightning.runs.index import flat

SIZE, VIEWS, HELD_OUT = 16, 8, 2
PINHOLE = 1
"""Number of that model in COLMAP's binary files."""
VERBS = ("config", "render", "evaluate", "export", "inspect", "chart", "gallery", "capture", "rightsize", "stability")
"""Configurations of the command lines; the first is training's."""
NUMBERED = "{:03d}.png"

TRAIN = (
    *("budget.steps=1", "budget.default.steps=1", "budget.default.seconds=null", "kernels=reference", "device=cpu"),
    *("callbacks.orbit.frames=0", "callbacks.snapshots.steps=[]", "callbacks.heldout.views=1"),
)
"""A training of a step, with the kernels that need no compiling, and nothing drawn."""
ON_RAYS = (*TRAIN, "dataset=photos", "dataset.rays=16", "dataset.samples=64")
HASHGRID = ("model.levels=2", "model.log2_entries=6", "model.width=4", "sampler.resolution=8", "sampler.samples=8")
FIELDS = (
    HASHGRID,
    ("model=mlp", "model.depth=1", "model.skip=null", "model.width=4", "sampler=stratified", "sampler.samples=4"),
    ("model=voxels", "model.coarsest=4", "model.finest=8", "sampler.resolution=8", "sampler.samples=8"),
)
"""Fields of a few numbers, and samplers of a few samples."""
PICTURE = (
    *("budget.steps=1", "budget.default.steps=1", "budget.default.seconds=null", "kernels=reference", "device=cpu"),
    *("+experiment=smoke_2d", "callbacks.snapshots.steps=[]"),
    *("callbacks.baselines=null", "callbacks.charts=null", "callbacks.training_gif=null", "callbacks.enlarge=null"),
)
"""The same of a picture."""


def write(folder: Path) -> None:
    """Writes all that no command of the package makes."""
    scene = bricks(SIZE, VIEWS, HELD_OUT)
    save_npz(scene, folder / "scene.npz")
    write_photos(scene, folder / "nerfstudio")
    _blender(scene, folder / "blender")
    _colmap(scene.train, folder / "colmap", _binary)
    _colmap(scene.train, folder / "colmap_text", _text)
    _llff(scene.train, folder / "llff")
    picture = scene.train.image(0)[..., :3].numpy()
    write_picture(folder / "picture.png", picture)
    _photo(picture, folder / "photo.jpg")
    orbit = scene.orbit
    route = {"width": SIZE, "height": SIZE, "K": orbit.K[0].tolist(), "c2w": orbit.c2w[:2].tolist()}
    documents: dict[str, Any] = {
        "path.json": route,
        "viewer.json": _viewer(orbit.c2w[:2].tolist()),
        "layout.yaml": {"tags": {0: {"x": 0.0, "y": 0.0}, 1: {"x": 0.09, "y": 0.0, "turn": 90.0}}},
        "ladder.yaml": {"rungs": [{"width": 2}, {"width": 4}], "samplers": [{"resolution": 8, "samples": 8}]},
        "experiment.yaml": {
            "name": "mine",
            "dataset": {"focus": 0.25},
            "optimizer": {"lr": 0.01},
            "renderer": {"background": "scene"},
            "callbacks": {"guard": {"every": 1}},
        },
    }
    for name, content in documents.items():
        text = json.dumps(content) if name.endswith(".json") else yaml.safe_dump(content)
        head = "# @package _global_\n" if name == "experiment.yaml" else ""
        (folder / name).write_text(head + text, encoding="utf-8")


def options_of(verb: str, folder: Path) -> dict[str, str]:
    """A verb's options by their dotted names, with what stands there, as text."""
    plain = OmegaConf.to_container(composed(["dataset=photos"] if verb == "config" else [], folder, verb))
    assert isinstance(plain, dict)  # of a DictConfig
    return {key: str(value) for key, value in flat({str(key): value for key, value in plain.items()}).items()}


def _viewer(poses: list[Any]) -> dict[str, Any]:
    """A camera path as nerfstudio's viewer saves it."""
    return {
        "render_width": SIZE,
        "render_height": SIZE,
        "camera_path": [{"camera_to_world": sum(pose, []), "fov": 50.0} for pose in poses],
    }


def _photo(picture: np.ndarray, path: Path) -> None:
    """A JPEG as a phone writes it: on its side, with a focal length and a place."""
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation], exif[ExifTags.Base.Make] = 6, "nobody"
    exif.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.FocalLengthIn35mmFilm] = 28
    Image.fromarray(picture).save(path, exif=exif)


def _blender(scene: Scene, folder: Path) -> None:
    for split, views in (("train", scene.train), ("val", scene.val)):
        frames = []
        for i, pose in enumerate(views.cameras.c2w.double().numpy()):
            write_picture(folder / split / NUMBERED.format(i), views.image(i).numpy())
            name = f"./{split}/{NUMBERED.format(i).removesuffix('.png')}"
            frames.append({"file_path": name, "transform_matrix": (pose * [1, -1, -1, 1]).tolist()})
        angle = 2 * float(np.arctan(SIZE / 2 / float(views.cameras.K[0, 0, 0])))
        content = json.dumps({"camera_angle_x": angle, "frames": frames})
        (folder / f"transforms_{split}.json").write_text(content, encoding="utf-8")


def _colmap(views: Views, folder: Path, write_model: Any) -> None:
    poses = []
    for i, c2w in enumerate(views.cameras.c2w.double().numpy()):
        write_picture(folder / "images" / NUMBERED.format(i), views.image(i)[..., :3].numpy())
        w2c = np.linalg.inv(c2w)
        x, y, z, w = Rotation.from_matrix(w2c[:3, :3]).as_quat()
        poses.append([float(number) for number in (w, x, y, z, *w2c[:3, 3])])
    (folder / "sparse" / "0").mkdir(parents=True)
    K = views.cameras.K[0].double().numpy()
    places = np.random.default_rng(0).uniform(-0.5, 0.5, (20, 3)).tolist()
    write_model(folder / "sparse" / "0", [float(K[0, 0]), float(K[1, 1]), SIZE / 2, SIZE / 2], poses, places)


def _binary(folder: Path, lens: list[float], poses: list[list[float]], places: list[list[float]]) -> None:
    camera = struct.pack("<QiiQQ4d", 1, 1, PINHOLE, SIZE, SIZE, *lens)
    (folder / "cameras.bin").write_bytes(camera)
    images = [
        struct.pack("<i7di", i + 1, *pose, 1) + NUMBERED.format(i).encode() + struct.pack("<BQddQ", 0, 1, 1.5, 2.5, 0)
        for i, pose in enumerate(poses)
    ]
    (folder / "images.bin").write_bytes(struct.pack("<Q", len(images)) + b"".join(images))
    points = [struct.pack("<Q3d3BdQii", i, *place, 9, 9, 9, 0.5, 1, 1, 0) for i, place in enumerate(places)]
    (folder / "points3D.bin").write_bytes(struct.pack("<Q", len(points)) + b"".join(points))


def _text(folder: Path, lens: list[float], poses: list[list[float]], places: list[list[float]]) -> None:
    def row(*words: object) -> str:
        return " ".join(map(str, words)) + "\n"

    (folder / "cameras.txt").write_text("# cameras\n" + row(1, "PINHOLE", SIZE, SIZE, *lens), encoding="utf-8")
    images = [row(i + 1, *pose, 1, NUMBERED.format(i)) + row(1.5, 2.5, 0) for i, pose in enumerate(poses)]
    (folder / "images.txt").write_text("# images\n" + "".join(images), encoding="utf-8")
    points = [row(i, *place, 9, 9, 9, 0.5, 1, 0) for i, place in enumerate(places)]
    (folder / "points3D.txt").write_text("".join(points), encoding="utf-8")


def _llff(views: Views, folder: Path) -> None:
    rows = []
    for i, pose in enumerate(views.cameras.c2w.double().numpy()):
        write_picture(folder / "images" / NUMBERED.format(i), views.image(i)[..., :3].numpy())
        size = [[SIZE], [SIZE], [float(views.cameras.K[i, 0, 0])]]
        turned = np.concatenate([pose[:3, 1:2], pose[:3, 0:1], -pose[:3, 2:3], pose[:3, 3:4], size], axis=1)
        rows.append([*turned.ravel(), 1.0, 9.0])
    np.save(folder / "poses_bounds.npy", np.array(rows))


MADE = (
    ("train", (*ON_RAYS, *HASHGRID, "dataset.path='{good}/scene.npz'", "hydra.run.dir='{good}/run'")),
    ("train", (*PICTURE, "dataset.path='{good}/picture.png'", "hydra.run.dir='{good}/runs/picture'")),
    ("train", (*ON_RAYS, *FIELDS[1], "dataset.path='{good}/scene.npz'", "hydra.run.dir='{good}/runs/mlp'")),
    ("export", ("run={good}/run", "loss=100")),
)
"""Commands that make the others: a run with its compact file, and a folder of runs."""
