"""Writes posed photos as other programs do: COLMAP, binary and text, LLFF, transforms.json, Blender, and .npz."""

import json
import struct
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import torch
from scipy.spatial.transform import Rotation

from nerf_lightning.dataset import Views
from nerf_lightning.dataset.formats.colmap_model import CAMERA_MODELS

ColmapCamera = tuple[str, int, int, tuple[float, ...]]
"""Model, width, height and parameters."""


def write_photos(folder: Path, views: Views, ending: str = ".png", first: int = 0) -> list[str]:
    """Writes the photos; returns their names."""
    folder.mkdir(parents=True, exist_ok=True)
    names = [f"{first + i:04d}{ending}" for i in range(len(views))]
    for i, name in enumerate(names):
        imageio.imwrite(folder / name, views.image(i).numpy())
    return names


def colmap_cameras(views: Views, model: str = "PINHOLE", more: tuple[float, ...] = ()) -> dict[int, ColmapCamera]:
    """A camera for each view."""
    cameras: dict[int, ColmapCamera] = {}
    for i, K in enumerate(views.cameras.K.double().numpy()):
        fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
        one = len(CAMERA_MODELS[model][1].split()) - len(more) == 3
        cameras[i + 1] = (model, *views.cameras.size(i), ((fx, cx, cy) if one else (fx, fy, cx, cy)) + more)
    return cameras


def convert_to_quaternion(w2c: np.ndarray) -> list[float]:
    x, y, z, w = Rotation.from_matrix(w2c[:3, :3]).as_quat()
    return [w, x, y, z]


def write_colmap(
    folder: Path, c2w: np.ndarray, names: list[str], cameras: dict[int, ColmapCamera], text: bool = False, points=None
) -> None:
    """A sparse model; image i has camera i + 1, or the last there is."""
    folder.mkdir(parents=True, exist_ok=True)
    points = np.zeros((1, 3)) if points is None else points
    images = []
    for i, (pose, name) in enumerate(zip(c2w.astype(np.float64), names, strict=True)):
        w2c = np.linalg.inv(pose)
        images.append((i + 1, [*convert_to_quaternion(w2c), *w2c[:3, 3]], min(i + 1, len(cameras)), name))
    if text:
        lines = [f"{n} {m} {w} {h} {' '.join(map(repr, map(float, p)))}" for n, (m, w, h, p) in cameras.items()]
        (folder / "cameras.txt").write_text("# cameras\n" + "\n".join(lines) + "\n")
        rows = [f"{n} {' '.join(map(repr, map(float, pose)))} {c} {name}\n1.5 2.5 -1" for n, pose, c, name in images]
        (folder / "images.txt").write_text("# images\n" + "\n".join(rows) + "\n")
        points = [f"{n} {x} {y} {z} 0 0 0 0.5 1 0" for n, (x, y, z) in enumerate(points)]
        (folder / "points3D.txt").write_text("\n".join(points) + "\n")
        return
    packed = [
        struct.pack("<iiQQ", n, CAMERA_MODELS[m][0], w, h) + struct.pack(f"<{len(p)}d", *p)
        for n, (m, w, h, p) in cameras.items()
    ]
    (folder / "cameras.bin").write_bytes(struct.pack("<Q", len(packed)) + b"".join(packed))
    rows = [
        struct.pack("<i7di", n, *pose, c) + name.encode() + b"\0" + struct.pack("<QddQ", 1, 1.5, 2.5, 2**64 - 1)
        for n, pose, c, name in images
    ]
    (folder / "images.bin").write_bytes(struct.pack("<Q", len(rows)) + b"".join(rows))
    spots = [struct.pack("<Q3d3BdQii", n, *xyz, 0, 0, 0, 0.5, 1, 1, 0) for n, xyz in enumerate(points)]
    (folder / "points3D.bin").write_bytes(struct.pack("<Q", len(spots)) + b"".join(spots))


def write_llff(path: Path, views: Views) -> None:
    """poses_bounds.npy."""
    rows = []
    for i, pose in enumerate(views.cameras.c2w.double().numpy()):
        width, height = views.cameras.size(i)
        hwf = [[height], [width], [float(views.cameras.K[i, 0, 0])]]
        columns = [pose[:3, 1:2], pose[:3, 0:1], -pose[:3, 2:3], pose[:3, 3:4], hwf]
        rows.append(np.concatenate([np.concatenate(columns, axis=1).ravel(), [1.0, 9.0]]))
    np.save(path, np.stack(rows))


def write_transforms(path: Path, views: Views, names: list[str], **more: object) -> None:
    """transforms.json with a lens for each frame."""
    frames = []
    for i, (pose, name) in enumerate(zip(views.cameras.c2w.double().numpy(), names, strict=True)):
        K = views.cameras.K[i].double()
        own = {"fl_x": float(K[0, 0]), "fl_y": float(K[1, 1]), "cx": float(K[0, 2]), "cy": float(K[1, 2])}
        matrix = (pose * [1, -1, -1, 1]).tolist()
        frames.append({"file_path": name, "transform_matrix": matrix, **own, **more})
    path.write_text(json.dumps({"frames": frames}), encoding="utf-8")


def write_scene(format: str, folder: Path, views: Views) -> Path:
    """All views in a format; the first three are held out where it has a split."""
    folder.mkdir(exist_ok=True)
    focal, (width, _) = float(views.cameras.K[0, 0, 0]), views.cameras.size(0)
    if format == "npz":
        images, c2w = views.images.numpy(), views.cameras.c2w.numpy()
        held_out = {"images_val": images[:3], "c2ws_val": c2w[:3]}
        np.savez(folder / "s.npz", images_train=images[3:], c2ws_train=c2w[3:], focal=focal, **held_out)
        return folder / "s.npz"
    names = write_photos(folder / "images", views)
    if format in ("colmap", "text"):
        write_colmap(folder / "sparse/0", views.cameras.c2w.numpy(), names, colmap_cameras(views), format == "text")
    elif format == "llff":
        write_llff(folder / "poses_bounds.npy", views)
    elif format == "transforms":
        write_transforms(folder / "transforms.json", views, [f"images/{name}" for name in names])
    else:
        opengl = (views.cameras.c2w * torch.tensor([1.0, -1, -1, 1])).tolist()
        frames = [{"file_path": f"images/{n[:-4]}", "transform_matrix": m} for n, m in zip(names, opengl, strict=True)]
        for split, part in (("train", frames[3:]), ("val", frames[:3])):
            content = {"camera_angle_x": 2 * float(np.arctan(0.5 * width / focal)), "frames": part}
            (folder / f"transforms_{split}.json").write_text(json.dumps(content))
    return folder
