"""Opens a scene of any format: what is at the path decides how it is read."""

from dataclasses import replace
from pathlib import Path

from nerf_lightning.dataset.formats import checks
from nerf_lightning.dataset.formats.colmap import MODEL_FOLDERS, PHOTO_FOLDERS, find_models, load_colmap
from nerf_lightning.dataset.formats.llff import POSES, load_llff
from nerf_lightning.dataset.formats.names import list_images
from nerf_lightning.dataset.formats.npz import load_npz
from nerf_lightning.dataset.formats.transforms import load_blender, load_transforms
from nerf_lightning.dataset.scene import Scene
from nerf_lightning.dataset.sfm.frames import VIDEOS, extract_frames
from nerf_lightning.dataset.sfm.photos import place_photos
from nerf_lightning.dataset.shots import AS_IT_IS, PhotoLoadOptions
from nerf_lightning.errors import InputError
from nerf_lightning.utils.files import user_path

SUPPORTED = (
    "photos or a video, an .npz file, a COLMAP folder (sparse/0), poses_bounds.npy beside images, a Blender folder"
    " (transforms_train.json), or transforms.json or its folder"
)


def open_scene(
    path: str,
    name: str | None = None,
    options: PhotoLoadOptions = AS_IT_IS,
    near: float | None = None,
    far: float | None = None,
) -> Scene:
    """Reads a scene of any supported format, told apart by what is inside.

    Args:
        path: an .npz file; a folder of a Blender scene (transforms_train.json), of a nerfstudio or instant-ngp capture
            (transforms.json, or that file), of LLFF (poses_bounds.npy), or of COLMAP (or its model's folder); else a folder
            of photos, or a video, which COLMAP places once.
        name: what to call it; defaults to the file's or folder's name.
        near, far: distances along the rays, in the scene's unit, that override the bounds'.
        options: see there.

    Raises:
        InputError: nothing readable at `path`, or what is there is damaged.
    """
    place = user_path(path)
    try:
        scene = _open(place, name, options)
    except OSError as error:  # a loop of links, a folder that may not be read
        raise InputError(place, "", f"something unreadable ({error})", SUPPORTED) from error
    if near is None and far is None:
        return scene
    bounds = scene.bounds
    near = bounds.near if near is None else checks.parse_number(place, "near", near)
    far = bounds.far if far is None else checks.parse_number(place, "far", far)
    checks.check_near_far(place, near, far)
    return replace(scene, bounds=replace(bounds, near=near, far=far))


def _open(place: Path, name: str | None, options: PhotoLoadOptions) -> Scene:
    if place.suffix.lower() == ".npz" and not place.is_dir():
        return load_npz(place, name, options)
    if (place / "transforms_train.json").is_file():
        return load_blender(place, name, options)
    if (place / "transforms.json").is_file() or (place.suffix.lower() == ".json" and place.is_file()):
        return load_transforms(place, name, options)
    if find_models(place):
        return load_colmap(place, name, options)
    if (place / POSES).is_file():
        return load_llff(place, name, options)
    photos = None
    if place.suffix.lower() in VIDEOS and place.is_file():
        photos = extract_frames(place)
    elif not any((place / below).is_dir() for below in MODEL_FOLDERS if below):  # a damaged model is not made again
        folders = (place / below for below in ("", *PHOTO_FOLDERS))
        photos = next((folder for folder in folders if folder.is_dir() and list_images(folder)), None)
    if photos is not None:
        name = name or (place.stem if place.is_file() else place.resolve().name)
        return load_colmap(place_photos(photos), name, replace(options, orientation="exif"), photos)
    kind = "folder" if place.is_dir() else f"{place.suffix or 'plain'} file"
    found = f"a {kind} without a scene" if place.exists() else "nothing there"
    raise InputError(place, "", found, SUPPORTED)
