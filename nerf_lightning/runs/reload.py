"""The photos or picture for a run that is read back: those it was trained on, or others. Nothing is downloaded."""

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
"""Frames that differ less, in entries of the similarity between them, are one: in the unit of the run's own."""


def align_scene(scene: Any, content: Mapping[str, Any]) -> Any:
    """A scene in the frame that a run was trained in, which other photos of it, or a later version of this package, may place
    and turn in another way: both know the frame of the files they came from.

    Args:
        scene: just read; a picture stays as it is.
        content: of the run's scene.json.
    """
    frame, _, to_source = parse_metadata(content, "scene.json") if "aabb" in content else (None, None, None)
    if to_source is None or not isinstance(frame, SceneMetadata):
        return scene
    moved = torch.linalg.solve(to_source, scene.to_source)
    if torch.allclose(moved, torch.eye(4, dtype=moved.dtype), atol=MAX_FRAME_DIFFERENCE):
        return replace(scene, bounds=frame.bounds, to_source=to_source)

    def placed(cameras: Cameras) -> Cameras:
        return replace(cameras, c2w=transform_poses(cameras.c2w, moved).float())

    splits = {name: getattr(scene, name) for name in ("train", "val", "test")}
    views = {name: one and replace(one, cameras=placed(one.cameras)) for name, one in splits.items()}
    points = None if scene.points is None else transform_points(moved, scene.points.double()).float()
    kept = {"bounds": frame.bounds, "to_source": to_source}
    return replace(scene, **views, **kept, orbit=placed(scene.orbit), points=points)


def apply_refined_cameras(scene: Any, content: Mapping[str, Any]) -> Any:
    """A run's scene with its training cameras as the training has corrected them, if it has.

    Raises:
        InputError: where those are not as many poses as there are photos, or the factor on the focal length is none.
    """
    if "corrected" not in content:
        return scene
    cameras = scene.train.cameras
    poses = checks.check_poses("scene.json", "corrected[{}]", content["corrected"])
    if len(poses) != len(cameras):
        expected, hint = f"{len(cameras)} poses, one of each training photo", "have photos been added or removed?"
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
    """The data module of a run. The network is never used, as the run may be a stranger's.

    Args:
        cfg: the run's configuration.
        scene: what its scene.json says.
        photos: a file or folder of others; None takes those it was trained on.
        corrected: whether those are seen by cameras as training has corrected them.

    Raises:
        InputError: if they are gone, or have changed.
    """
    source = scene.get("source", BUILT_IN)
    at_hand = copy.deepcopy(cfg)
    if "url" in at_hand.dataset:
        at_hand.dataset.download = False
        if at_hand.dataset.get("path") is None and source != BUILT_IN:
            at_hand.dataset.path = escape_interpolations(source)
    if at_hand.dataset.get("resize") == AUTO and "longest" in scene:
        at_hand.dataset.resize = scene["longest"]
    data = build_data(at_hand, photos)
    data.scene = align_scene(data.scene, scene)
    if photos is None and corrected:
        data.scene = apply_refined_cameras(data.scene, scene)
    name = scene.get("name", data.scene.name)
    if photos is None and data.scene.name != name:
        expected = f"{name!r}, which the run was trained on"
        raise InputError("config", "dataset", f"the scene {data.scene.name!r}", expected, "give dataset.path=")
    return data
