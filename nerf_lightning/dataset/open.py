"""Opens a scene of any format: what is at the path decides how it is read."""

from dataclasses import replace
from pathlib import Path

from nerf_lightning.dataset.formats import checks
from nerf_lightning.dataset.formats.blender import load_blender
from nerf_lightning.dataset.formats.nerfstudio import load_nerfstudio
from nerf_lightning.dataset.formats.npz import load_npz
from nerf_lightning.dataset.resize import resize_scene
from nerf_lightning.dataset.scene import Scene
from nerf_lightning.errors import InputError

SUPPORTED = "an .npz file, a folder with transforms_train.json, or transforms.json or its folder"


def open_scene(
    path: str,
    name: str | None = None,
    resize: int | None = None,
    holdout: int = 10,
    near: float | None = None,
    far: float | None = None,
) -> Scene:
    """Reads a scene of any supported format.

    Args:
        path: an .npz file, a Blender folder (transforms_train.json), or a nerfstudio / instant-ngp capture
            (transforms.json or its folder).
        name: what to call it; defaults to the file's or folder's name.
        resize: longest side in pixels after averaging, if smaller than the photos.
        holdout: N to hold out every N-th photo, where the format has no split of its own.
        near, far: distances along the rays, in the scene's unit, that override the bounds'.

    Raises:
        InputError: nothing readable at `path`, or what is there is damaged.
    """
    place = Path(path).expanduser()
    if place.suffix.lower() == ".npz" and not place.is_dir():
        scene = resize_scene(load_npz(place, name), resize)
    elif (place / "transforms_train.json").is_file():
        scene = load_blender(place, name, resize)
    elif (place / "transforms.json").is_file() or (place.suffix.lower() == ".json" and place.is_file()):
        scene = load_nerfstudio(place, name, resize, holdout)
    else:
        raise InputError(place, "", _description(place), SUPPORTED)
    if near is None and far is None:
        return scene
    bounds = scene.bounds
    near = bounds.near if near is None else checks.number(place, "near", near)
    far = bounds.far if far is None else checks.number(place, "far", far)
    checks.near_far(place, near, far)
    return replace(scene, bounds=replace(bounds, near=near, far=far))


def _description(place: Path) -> str:
    if place.is_dir():
        names = sorted(item.name for item in place.iterdir())
        shown = ", ".join(names[:5]) + (", ..." if len(names) > 5 else "")
        return f"a folder with {shown}" if names else "an empty folder"
    return f"a {place.suffix or 'plain'} file" if place.exists() else "nothing there"
