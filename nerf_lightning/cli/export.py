"""nerf_lightning export: one subcommand per file type."""

from pathlib import Path
from typing import Annotated

from cyclopts import App, Parameter

from nerf_lightning.cli.command import Device, Output, Photos, RunPath, command
from nerf_lightning.errors import InputError
from nerf_lightning.runs.find import find_run
from nerf_lightning.utils.option_checks import Ge, GridSize, Le

Box = Annotated[
    tuple[float, float, float, float, float, float] | None,
    Parameter(help="Crop to a box: X Y Z X Y Z of its lower, then upper corner, in the photos' unit."),
]
Resolution = Annotated[GridSize | None, Parameter(help="Cells on the longest side; default: the photos' resolution.")]
Threshold = Annotated[
    Annotated[float, Ge(0.001), Le(0.999)] | None,
    Parameter(help="Opacity of a cell at the surface; default: Otsu's method on the histogram."),
]
MaxPsnrDrop = Annotated[float, Ge(0), Parameter(help="Largest loss of held-out PSNR, dB.")]

export = App(name="export", help="Write a run as a file for other uses.")


@export.command(name="mesh")
@command
def export_mesh(
    run: RunPath = None,
    /,
    *,
    resolution: Resolution = None,
    threshold: Threshold = None,
    box: Box = None,
    output: Output = None,
    photos: Photos = None,
    device: Device = "auto",
) -> Path:
    """Write a colored surface mesh, in the coordinates of the photos' own file.

    Args:
        output: FILE.ply, .glb (3D viewers), .obj (modelers) or .stl (printers; no colors); default: mesh.ply in the run.
    """
    return _write_geometry("mesh", run, output, device, resolution, box, threshold, photos)


@export.command(name="points")
@command
def export_points(
    run: RunPath = None,
    /,
    *,
    resolution: Resolution = None,
    threshold: Threshold = None,
    box: Box = None,
    output: Output = None,
    photos: Photos = None,
    device: Device = "auto",
) -> Path:
    """Write a colored point cloud of the surface, in the coordinates of the photos' own file.

    Args:
        output: FILE.ply; default: points.ply in the run.
    """
    return _write_geometry("points", run, output, device, resolution, box, threshold, photos)


@export.command(name="voxels")
@command
def export_voxels(
    run: RunPath = None,
    /,
    *,
    resolution: Resolution = None,
    box: Box = None,
    output: Output = None,
    device: Device = "auto",
) -> Path:
    """Write a voxel grid of density and color, with its transform.

    Args:
        output: FILE.npz; default: voxels.npz in the run.
    """
    return _write_geometry("voxels", run, output, device, resolution, box)


@export.command(name="compact")
@command
def export_compact(
    run: RunPath = None,
    /,
    *,
    max_psnr_drop: MaxPsnrDrop = 0.1,
    output: Output = None,
    photos: Photos = None,
    device: Device = "auto",
) -> Path:
    """Write a small file of all that the photos' cameras see; all commands accept it as a run.

    Args:
        output: FILE.npz; default: compact.npz in the run.
    """
    from nerf_lightning.export.compress import compress_system
    from nerf_lightning.runs.folder import config_to_dict
    from nerf_lightning.runs.open import open_run
    from nerf_lightning.runs.reload import reload_data
    from nerf_lightning.utils.device import resolve_device

    where, source = resolve_device(device), find_run(run)
    target = _resolve_output(source, output, "compact.npz", (".npz",))
    loaded = open_run(source, where)
    data = reload_data(loaded.cfg, loaded.scene, photos)
    compact = compress_system(loaded.system, data, config_to_dict(loaded.cfg), max_psnr_drop)
    size = f"{len(compact.content) / 1000:,.1f} kB, {compact.precision} precision"
    return _write(target, compact.content, f"{size}, held-out PSNR {compact.psnr_before:.2f} -> {compact.psnr:.2f} dB")


@export.command(name="html")
@command
def export_html(
    run: RunPath = None,
    /,
    *,
    all: bool = False,
    cells: GridSize | None = None,
    max_psnr_drop: MaxPsnrDrop = 0.15,
    output: Output = None,
    photos: Photos = None,
    device: Device = "auto",
) -> Path:
    """Write a self-contained interactive HTML viewer that works offline in any browser.

    TensoRF, hash-grid and voxel fields are drawn directly; others are baked into voxels.

    Args:
        all: Write a page for each run in a folder, and gallery.html with all of them side by side.
        cells: Resolution of voxels that replace another field; default: the photos' resolution.
        output: FILE.html; default: field.html in the run.
    """
    from functools import partial

    from nerf_lightning.export.html import build_page, write_gallery
    from nerf_lightning.runs.find import OUTPUT_ROOT
    from nerf_lightning.utils.device import resolve_device

    where = resolve_device(device)
    build = partial(build_page, device=where, cells=cells, max_psnr_drop=max_psnr_drop, photos=photos)
    if all:
        folder = run or OUTPUT_ROOT
        target = _resolve_output(folder, output, "gallery.html", (".html",))
        print(f"{target}: {write_gallery(folder, target, build)} fields side by side: open it in a browser")
        return target
    source = find_run(run)
    target = _resolve_output(source, output, "field.html", (".html",))
    page, words = build(source)
    return _write(target, page.encode(), f"{len(page) / 1000:,.1f} kB, {words}: open it in a browser")


@export.command(name="transforms")
@command
def export_transforms(run: RunPath = None, /, *, output: Output = None, photos: Photos = None) -> Path:
    """Write photos with refined cameras as transforms.json, for nerfstudio and others.

    Args:
        output: A new folder; default: posed/ in the run.
    """
    from nerf_lightning.export.transforms import write_photos
    from nerf_lightning.runs.folder import load_config
    from nerf_lightning.runs.reload import reload_data
    from nerf_lightning.runs.scene_file import read_scene_file
    from nerf_lightning.utils.files import atomic_write_folder, check_output_path

    source = find_run(run)
    target = source / "posed" if output is None else check_output_path(output)
    if target.exists():
        raise InputError(target, "", "exists already", hint="give another -o, or remove it")
    content = read_scene_file(source)  # compact files lack refined cameras
    data = reload_data(load_config(source), content, photos)
    if not data.is_posed:
        raise InputError(source, "", "the run of an image", "the run of a scene")
    with atomic_write_folder(target) as temporary:
        write_photos(data.scene, temporary)
    cameras = "corrected" if "corrected" in content else "given"
    print(f"{target}: {len(data.scene.train) + len(data.scene.val)} photos and transforms.json, cameras as {cameras}")
    return target


def _resolve_output(source: Path, output: Path | None, name: str, suffixes: tuple[str, ...]) -> Path:
    """The output path: `output`, or `name` in the run's folder; checks the suffix."""
    from nerf_lightning.runs.open import get_output_folder
    from nerf_lightning.utils.files import check_output_path

    if output is None:
        return get_output_folder(source) / name
    if output.suffix.lower() not in suffixes:
        raise InputError("export", "output", output.name, f"a name ending in {', '.join(suffixes)}")
    return check_output_path(output)


def _write(target: Path, content: bytes, words: str) -> Path:
    from nerf_lightning.utils.files import atomic_write

    with atomic_write(target) as temporary:
        temporary.write_bytes(content)
    print(f"{target}: {words}")
    return target


def _write_geometry(
    kind: str,
    run: Path | None,
    output: Path | None,
    device: str,
    resolution: int | None,
    box: tuple[float, ...] | None,
    threshold: float | None = None,
    photos: Path | None = None,
) -> Path:
    if box is not None and not all(low < high for low, high in zip(box[:3], box[3:], strict=True)):
        raise InputError("export", "box", " ".join(map(str, box)), "the lower, then the upper corner: X Y Z X Y Z")
    import torch

    from nerf_lightning.export import mesh
    from nerf_lightning.export.volume import sample_volume
    from nerf_lightning.runs.open import open_scene_run
    from nerf_lightning.utils.device import resolve_device
    from nerf_lightning.utils.libraries import require_extra

    where, source = resolve_device(device), find_run(run)
    target = _resolve_output(source, output, kind + mesh.SUFFIXES[kind][0], mesh.SUFFIXES[kind])
    if kind != "voxels":
        require_extra("mesh", "skimage", "trimesh", purpose="the optional extra for meshes")
    loaded = open_scene_run(source, where)
    corners = None if box is None else torch.tensor(box, dtype=torch.float64).view(2, 3)
    volume = sample_volume(loaded, resolution, corners)
    if kind == "voxels":
        content, words = mesh.build_voxels_file(loaded, volume)
    elif kind == "points":
        content, words = mesh.build_points_file(loaded, mesh.select_training_views(loaded, photos), volume, threshold)
    else:
        cameras, suffix = mesh.select_training_views(loaded, photos), target.suffix.lower()
        content, words = mesh.build_mesh_file(loaded, cameras, volume, threshold, suffix)
    size = f"{len(content) / 1e6:,.2f} MB"
    return _write(target, content, f"{size}, {words}, cells of {volume.cell * loaded.scale:.4g}")
