"""The export verb's options -> a file."""

from operator import lt
from pathlib import Path

import torch

from nerf_lightning.cameras import Cameras, spiral_like
from nerf_lightning.dataset import RayDataModule
from nerf_lightning.errors import InputError
from nerf_lightning.export.mesh import mesh_file, points_file, voxels_file
from nerf_lightning.export.options import ExportOptions
from nerf_lightning.export.pages import paged, side_by_side
from nerf_lightning.export.photos import write_photos
from nerf_lightning.export.smallest import MOST_VIEWS, PRECISIONS, smallest, some_cameras
from nerf_lightning.export.volume import volume_of
from nerf_lightning.runs.data import data_again
from nerf_lightning.runs.folder import load_config, plain_config
from nerf_lightning.runs.index import FIELD_PAGE
from nerf_lightning.runs.open import SceneRun, beside, open_run, open_scene_run
from nerf_lightning.runs.scene_file import load_scene
from nerf_lightning.utils.device import the_device
from nerf_lightning.utils.files import atomic, atomic_folder, output_path, user_path
from nerf_lightning.utils.libraries import require
from nerf_lightning.utils.machine import device_in_words
from nerf_lightning.utils.text import subsample

NAMES = {
    ("compact", "mesh"): "compact.npz",
    ("npz", "mesh"): "voxels.npz",
    ("ply", "mesh"): "mesh.ply",
    ("glb", "mesh"): "mesh.glb",
    ("obj", "mesh"): "mesh.obj",
    ("stl", "mesh"): "mesh.stl",
    ("ply", "points"): "points.ply",
    ("html", "mesh"): FIELD_PAGE,
    ("transforms", "mesh"): "posed",
}
"""Default names of the output, by format and content."""


def export(options: ExportOptions) -> None:
    """Writes a run's last state in another format, and prints what was written.

    Raises:
        InputError: where the device, an option or the run is no good, photos are missing, or more would be lost than allowed.
    """
    device = the_device(options.device)
    formats = sorted({one for one, _ in NAMES})
    if options.format not in formats:
        raise InputError("config", "format", repr(options.format), ", ".join(formats))
    if (options.format, options.content) not in NAMES:
        raise InputError("config", "content", repr(options.content), "mesh, or points with format=ply")
    if options.precision not in (None, *PRECISIONS):
        found, expected = repr(options.precision), "half, byte, or null for the smaller one that is allowed"
        raise InputError("config", "precision", found, expected)
    if options.box is not None and not (len(options.box) == 6 and all(map(lt, options.box[:3], options.box[3:]))):
        raise InputError("config", "box", str(options.box), "the lower, then the upper corner: [x,y,z,x,y,z]")
    source = user_path(options.run)
    if options.format == "html" and source.is_dir() and not (source / "config.yaml").exists():
        return side_by_side(options, source, device)
    output = beside(source) / NAMES[options.format, options.content]
    if options.output is not None:
        output = output_path(options.output)
    if options.format == "transforms":
        return posed(options, source, output)
    if options.format in ("ply", "glb", "obj", "stl"):
        require("mesh", "skimage", "trimesh", purpose="the optional extra for meshes")
    made = {"compact": compacted, "html": paged}.get(options.format, shaped)
    content, words = made(options, source, device)
    with atomic(output) as temporary:
        temporary.write_bytes(content)
    print(f"{output}: {words}")


def posed(options: ExportOptions, source: Path, output: Path) -> None:
    """Writes a run's photos, as it saw them, and their cameras, as it corrected them, into a folder."""
    if not source.is_dir():
        raise InputError(source, "", "a file", "a run's folder", "its compact file does not know corrected cameras")
    if output.exists():
        raise InputError(
            output, "", "something", "a folder that is not there yet", "give another output=, or remove it"
        )
    content = load_scene(source)
    data = data_again(load_config(source), content, options.photos)
    if not isinstance(data, RayDataModule):
        raise InputError(source, "", "a picture's run", "a scene's run")
    with atomic_folder(output) as temporary:
        write_photos(data.scene, temporary)
    count, cameras = (
        len(data.scene.train) + len(data.scene.val),
        "as corrected" if "corrected" in content else "as given",
    )
    print(f"{output}: {count} photos and transforms.json, cameras {cameras}")


def compacted(options: ExportOptions, source: Path, device: torch.device) -> tuple[bytes, str]:
    """A run as one small file."""
    found = open_run(source, device)
    data = data_again(found.cfg, found.scene, options.photos)
    before = sum(tensor.numel() * tensor.element_size() for tensor in found.system.state_dict().values())
    compact = smallest(found.system, data, plain_config(found.cfg), options.loss, options.precision)
    size = f"{len(compact.content) / 1000:,.1f} kB of {before / 1000:,.1f} kB (precision={compact.precision})"
    quality = f"held-out PSNR {compact.before:.2f} -> {compact.psnr:.2f} dB, {max(compact.loss, 0):.3f} dB lost"
    return compact.content, f"{size}, {quality}, on {device_in_words(device)}"


def shaped(options: ExportOptions, source: Path, device: torch.device) -> tuple[bytes, str]:
    """A run as a mesh, points or voxels."""
    found = open_scene_run(source, device)
    box = None if options.box is None else torch.tensor(options.box, dtype=torch.float64).view(2, 3)
    volume = volume_of(found, options.resolution, box)
    if options.format == "npz":
        shape = voxels_file(found, volume)
    elif options.content == "points":
        shape = points_file(found, views_of(found, options.photos), volume, options.threshold)
    else:
        shape = mesh_file(found, views_of(found, options.photos), volume, options.threshold, options.format)
    return shape.content, f"{len(shape.content) / 1e6:,.2f} MB, {shape.words}, cells of {volume.cell * found.scale:.4g}"


def views_of(run: SceneRun, photos: str | None) -> Cameras:
    """Views that the field was trained from: its photos' cameras; without photos, its orbit and a spiral above it."""
    try:
        data = data_again(run.cfg, run.scene, photos)
    except InputError as error:
        if photos is not None:
            raise
        print(f"without the photos' cameras, from the orbit: {error}")
        spiral, count = spiral_like(run.orbit, MOST_VIEWS // 2), MOST_VIEWS // 2
        orbit = run.orbit[torch.tensor(subsample(len(run.orbit), count))]
        K, c2w, sizes = (torch.cat([getattr(x, name) for x in (orbit, spiral)]) for name in ("K", "c2w", "sizes"))
        return Cameras(K, c2w, sizes)
    assert isinstance(data, RayDataModule)  # of a scene's run
    return some_cameras(data)
