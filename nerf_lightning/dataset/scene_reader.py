"""Opens a scene, detecting its format from the files at the path."""

from dataclasses import replace
from pathlib import Path

from nerf_lightning.dataset.formats import checks
from nerf_lightning.dataset.formats.colmap import MODEL_FOLDERS, PHOTO_FOLDERS, find_models, load_colmap
from nerf_lightning.dataset.formats.file_names import list_images
from nerf_lightning.dataset.formats.llff import POSES_FILE, load_llff
from nerf_lightning.dataset.formats.npz import load_npz
from nerf_lightning.dataset.formats.transforms import load_blender, load_transforms
from nerf_lightning.dataset.photo_loading import DEFAULT_OPTIONS, PhotoLoadOptions
from nerf_lightning.dataset.scene import Scene
from nerf_lightning.dataset.sfm.photo_folder import run_sfm
from nerf_lightning.dataset.sfm.video_frames import VIDEOS, extract_frames
from nerf_lightning.errors import InputError
from nerf_lightning.utils.files import expand_user_path

SUPPORTED_SOURCES = (
    "photos or a video, an .npz file, a COLMAP folder (sparse/0), poses_bounds.npy and images, a Blender folder"
    " (transforms_train.json), or transforms.json or its folder"
)


def open_scene(
    path: str,
    name: str | None = None,
    options: PhotoLoadOptions = DEFAULT_OPTIONS,
    near: float | None = None,
    far: float | None = None,
) -> Scene:
    """Reads a scene of any supported format, detected from its files.

    Args:
        path: an .npz file; a folder of a Blender scene (transforms_train.json), of a nerfstudio or instant-ngp capture
            (transforms.json, or that file), of LLFF (poses_bounds.npy), or of COLMAP (or its model's folder); else a folder
            of photos, or a video, which are reconstructed by COLMAP and cached.
        name: scene name; defaults to the file's or folder's name.
        near, far: distances along the rays, in the scene's unit, that override those of the bounds.
        options: how to read photos.

    Raises:
        InputError: nothing readable at `path`, or damaged files.
    """
    source = expand_user_path(path)
    try:
        scene = _open(source, name, options)
    except OSError as error:  # a loop of links, a folder that may not be read
        raise InputError(source, "", f"cannot be read ({error})") from error
    if near is None and far is None:
        return scene
    bounds = scene.bounds
    near = bounds.near if near is None else checks.parse_number(source, "near", near)
    far = bounds.far if far is None else checks.parse_number(source, "far", far)
    checks.check_near_far(source, near, far)
    return replace(scene, bounds=replace(bounds, near=near, far=far))


def _open(source: Path, name: str | None, options: PhotoLoadOptions) -> Scene:
    if source.suffix.lower() == ".npz" and not source.is_dir():
        return load_npz(source, name, options)
    if (source / "transforms_train.json").is_file():
        return load_blender(source, name, options)
    if (source / "transforms.json").is_file() or (source.suffix.lower() == ".json" and source.is_file()):
        return load_transforms(source, name, options)
    if find_models(source):
        return load_colmap(source, name, options)
    if (source / POSES_FILE).is_file():
        return load_llff(source, name, options)
    photos = None
    if source.suffix.lower() in VIDEOS and source.is_file():
        photos = extract_frames(source)
    elif not any((source / below).is_dir() for below in MODEL_FOLDERS if below):  # a damaged model is an error
        folders = (source / below for below in ("", *PHOTO_FOLDERS))
        photos = next((folder for folder in folders if folder.is_dir() and list_images(folder)), None)
    if photos is not None:
        name = name or (source.stem if source.is_file() else source.resolve().name)
        return load_colmap(run_sfm(photos), name, replace(options, orientation="exif"), photos)
    kind = "folder" if source.is_dir() else f"{source.suffix or 'plain'} file"
    found = f"a {kind} without a scene" if source.exists() else "no such file or folder"
    raise InputError(source, "", found, hint=f"give {SUPPORTED_SOURCES}")
