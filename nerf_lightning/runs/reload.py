"""Reloading a run's photos, or other photos of the same scene. Nothing is downloaded."""

import copy
import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig

from nerf_lightning.cameras import Cameras, transform_points, transform_poses
from nerf_lightning.config.build import SceneMetadata, build_data
from nerf_lightning.config.quoting import escape_interpolations
from nerf_lightning.dataset import BUILT_IN, DataModule
from nerf_lightning.dataset.formats import checks
from nerf_lightning.dataset.resize import AUTO
from nerf_lightning.errors import InputError
from nerf_lightning.runs.scene_file import parse_metadata

MAX_FRAME_DIFFERENCE = 1e-5
"""Largest difference, in entries of the similarity between them, at which two frames count as equal."""


def align_scene(scene: Any, content: Mapping[str, Any]) -> Any:
    """Transforms a scene into the frame that a run was trained in, via the dataset's frame that both know.

    Other photos, or a later version of this package, may normalize the scene differently.

    Args:
        scene: newly read; an image is returned unchanged.
        content: of the run's scene.json.
    """
    frame, _, to_source = parse_metadata(content, "scene.json") if "aabb" in content else (None, None, None)
    if to_source is None or not isinstance(frame, SceneMetadata):
        return scene
    to_run = torch.linalg.solve(to_source, scene.to_source)
    if torch.allclose(to_run, torch.eye(4, dtype=to_run.dtype), atol=MAX_FRAME_DIFFERENCE):
        return replace(scene, bounds=frame.bounds, to_source=to_source)

    def transform(cameras: Cameras) -> Cameras:
        return replace(cameras, c2w=transform_poses(cameras.c2w, to_run).float())

    splits = {name: getattr(scene, name) for name in ("train", "val", "test")}
    views = {name: split and replace(split, cameras=transform(split.cameras)) for name, split in splits.items()}
    points = None if scene.points is None else transform_points(to_run, scene.points.double()).float()
    frame_fields = {"bounds": frame.bounds, "to_source": to_source}
    return replace(scene, **views, **frame_fields, orbit=transform(scene.orbit), points=points)


def apply_refined_cameras(scene: Any, content: Mapping[str, Any]) -> Any:
    """A run's scene with refined training cameras, if the run has any.

    Raises:
        InputError: the number of poses differs from that of the photos, or the focal factor is invalid.
    """
    if "corrected" not in content:
        return scene
    cameras = scene.train.cameras
    poses = checks.check_poses("scene.json", "corrected[{}]", content["corrected"])
    if len(poses) != len(cameras):
        expected, hint = f"{len(cameras)} poses, one per training photo", "have photos been added or removed?"
        raise InputError("scene.json", "corrected", f"{len(poses)} poses", expected, hint)
    c2w = torch.from_numpy(poses).float()
    factor = content.get("focal_factor")
    if factor is not None:
        if not (isinstance(factor, int | float) and 0 < factor < math.inf):
            raise InputError("scene.json", "focal_factor", repr(factor), "a number above 0, or null")
        cameras = cameras.zoom(factor)
    return replace(scene, train=replace(scene.train, cameras=replace(cameras, c2w=c2w)))


def reload_data(
    cfg: DictConfig, scene: Mapping[str, Any], photos: str | Path | None = None, corrected: bool = True
) -> DataModule:
    """The data module of a run; never downloads, as the run is not trusted.

    Args:
        cfg: the run's configuration.
        scene: content of its scene.json.
        photos: a file or folder of other photos; None: the training photos.
        corrected: whether training photos get their refined cameras.

    Raises:
        InputError: the photos are missing or have changed.
    """
    source = scene.get("source", BUILT_IN)
    local = copy.deepcopy(cfg)
    if "url" in local.dataset:
        local.dataset.download = False
        if local.dataset.get("path") is None and source != BUILT_IN:
            local.dataset.path = escape_interpolations(source)
    if local.dataset.get("resize") == AUTO and "longest" in scene:
        local.dataset.resize = scene["longest"]
    data = build_data(local, photos)
    data.scene = align_scene(data.scene, scene)
    if photos is None and corrected:
        data.scene = apply_refined_cameras(data.scene, scene)
    name = scene.get("name", data.scene.name)
    if photos is None and data.scene.name != name:
        expected = f"{name!r}, which the run was trained on"
        raise InputError("config", "dataset", f"the scene {data.scene.name!r}", expected, "give dataset.path=")
    return data
