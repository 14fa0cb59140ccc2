"""Room captures with exact geometry, as files: the rooms of the stability suite, larger."""

import json
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from nerf_lightning.cameras import Cameras, Rays
from nerf_lightning.dataset import Scene
from nerf_lightning.synthetic.objects import trace_rays
from nerf_lightning.synthetic.rooms import Room, make_handheld_cameras, render_room

WIDTH, HEIGHT, VIEWS = 240, 180, 56


def write_room(room: Room, folder: Path, seed: int = 0) -> None:
    """Writes a room as a capture."""
    cameras = make_handheld_cameras(VIEWS, WIDTH, HEIGHT, seed)
    write_capture(cameras, render_room(room, cameras).images.numpy(), folder)


def write_capture(cameras: Cameras, photos: UInt8[np.ndarray, "V H W 3"], folder: Path) -> None:
    """Writes photos and a transforms.json."""
    (folder / "images").mkdir(parents=True)
    frames = []
    for view, photo in enumerate(photos):
        name = f"images/{view:03d}.png"
        imageio.imwrite(folder / name, photo)
        pose = cameras.c2w[view] * torch.tensor([1.0, -1.0, -1.0, 1.0])  # OpenGL: y up, looking along -z
        frames.append({"file_path": name, "transform_matrix": pose.tolist()})
    K, (height, width) = cameras.K[0], photos.shape[1:3]
    lens = {"fl_x": float(K[0, 0]), "fl_y": float(K[1, 1]), "cx": float(K[0, 2]), "cy": float(K[1, 2])}
    (folder / "transforms.json").write_text(json.dumps({**lens, "w": width, "h": height, "frames": frames}))


def render_true_view(room: Room, scene: Scene, view: int) -> tuple[Float[Tensor, "R"], Int[Tensor, "R"]]:
    """True distance along the rays of a held-out view, scene's unit, and the index of the primitive hit."""
    rays, to_source = scene.val.cameras.generate_view_rays(view), scene.to_source
    scale = float(torch.linalg.det(to_source[:3, :3])) ** (1 / 3)
    rotation, shift = to_source[:3, :3].to(rays.origins), to_source[:3, 3].to(rays.origins)
    source_rays = Rays(rays.origins @ rotation.mT + shift, rays.directions @ rotation.mT / scale)
    _, distance, index = trace_rays(room.primitives, source_rays)
    return distance / scale, index
