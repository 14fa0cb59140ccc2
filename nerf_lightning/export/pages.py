"""Runs as web pages: of a scene, of a picture, and of all runs of a sweep side by side."""

from collections.abc import Sequence
from pathlib import Path

import torch
from omegaconf import OmegaConf

import nerf_lightning
from nerf_lightning.dataset import PictureBatch, RayDataModule
from nerf_lightning.drawing.panels import to_bytes
from nerf_lightning.errors import InputError
from nerf_lightning.export.drawable import drawable, drawn_as_it_is
from nerf_lightning.export.options import ExportOptions
from nerf_lightning.export.page import field_page, gallery_page, picture_page
from nerf_lightning.export.reach import occupied_cells
from nerf_lightning.export.smallest import held_out_psnr, smallest, some_cameras
from nerf_lightning.runs.compact import without_folders
from nerf_lightning.runs.data import data_again
from nerf_lightning.runs.folder import RunFolder, plain_config
from nerf_lightning.runs.index import FIELD_PAGE, find_runs, read_run, varied
from nerf_lightning.runs.open import open_run
from nerf_lightning.system import NeRF2D, NeRF3D
from nerf_lightning.utils.evenly import evenly
from nerf_lightning.utils.files import atomic, output_path
from nerf_lightning.utils.html import address_from

MOST_PHOTOS = 100
"""Photos to look through on a page."""


def paged(options: ExportOptions, source: Path, device: torch.device) -> tuple[bytes, str]:
    """A run as a web page, and what to say of it."""
    found = open_run(source, device)
    if isinstance(found.system, NeRF2D):
        page, words = picture(options, source, found)
    elif isinstance(found.system, NeRF3D) and source.is_file() and not options.photos and drawn_as_it_is(found.system):
        page, words = as_it_is(source, found)
    else:
        page, words = scene(options, source, found)
    return page.encode(), f"{len(page) / 1000:,.1f} kB, {words}: open it in a browser"


def picture(options: ExportOptions, source: Path, found: RunFolder) -> tuple[str, str]:
    """The page of a picture's field."""
    assert isinstance(found.system, NeRF2D)  # chosen by the caller
    data = data_again(found.cfg, found.scene, options.photos)
    view = data.held_out(0).to(found.system.device)
    assert isinstance(view, PictureBatch)  # what a NeRF2D is fed
    rgb = found.system.colours(view.uv).view(view.height, view.width, 3)
    quality = f"PSNR {held_out_psnr(found.system, data):.2f} dB"
    facts = facts_of(source, found, [("quality", quality), ("size", f"{view.width} x {view.height} pixels")])
    return picture_page(to_bytes(rgb.cpu()), data.scene.name, facts), quality


def as_it_is(source: Path, found: RunFolder) -> tuple[str, str]:
    """The page of a compact file that needs no change and whose photos are not asked for: it holds that very file."""
    assert isinstance(found.system, NeRF3D) and found.orbit is not None  # chosen by the caller
    content = without_folders(source.read_bytes())
    facts = facts_of(source, found, [("size", f"{len(content) / 1000:,.1f} kB")])
    return field_page(content, found.system, found.orbit, found.scene["name"], facts), "without photos"


def scene(options: ExportOptions, source: Path, found: RunFolder) -> tuple[str, str]:
    """The page of a radiance field, with the cameras of its photos."""
    assert isinstance(found.system, NeRF3D) and found.orbit is not None  # a scene's run
    data = data_again(found.cfg, found.scene, options.photos)
    assert isinstance(data, RayDataModule)  # of a scene's run
    drawn = drawable(found.system, some_cameras(data), plain_config(found.cfg), options.resolution)
    seen = occupied_cells(drawn.system) if drawn.changes else None
    compact = smallest(drawn.system, data, drawn.config, options.loss, options.precision, seen)
    before = held_out_psnr(found.system, data) if drawn.changes else compact.before
    content, changes = without_folders(compact.content), "; ".join(drawn.changes)
    facts = facts_of(
        source,
        found,
        [
            ("held-out PSNR", f"{compact.psnr:.2f} dB"),
            ("size", f"{len(content) / 1000:,.1f} kB, {compact.precision} precision"),
            *([("drawn with", f"{changes}: {before - compact.psnr:.2f} dB lost")] if changes else []),
        ],
    )
    shown, chosen = data.scene.train, evenly(len(data.scene.train), MOST_PHOTOS)
    cameras = shown.cameras[torch.tensor(chosen)].to("cpu")
    names = [shown.name(i) for i in chosen]
    page = field_page(content, drawn.system, found.orbit, data.scene.name, facts, cameras, names)
    return page, f"held-out PSNR {before:.2f} -> {compact.psnr:.2f} dB" + (f" ({changes})" if changes else "")


def facts_of(source: Path, found: RunFolder, measured: Sequence[tuple[str, str]]) -> list[tuple[str, str]]:
    """What a page says of its field."""
    training = []
    if source.is_dir():
        run = read_run(source)
        seconds, steps = run.figure("train_seconds"), run.figure("steps")
        if seconds is not None and steps is not None:
            training = [("training", f"{seconds:.3g} s, {steps:.0f} steps")]
    method = str(OmegaConf.select(found.cfg, "model._target_")).rsplit(".", 1)[-1]
    return [("method", method), *measured, *training, ("made with", f"nerf_lightning {nerf_lightning.__version__}")]


def side_by_side(options: ExportOptions, folder: Path, device: torch.device) -> None:
    """Writes the page of each run below a folder, where it has none yet, and one that shows them all.

    Raises:
        InputError: where there is no run, or none that can be shown.
    """
    output = folder / "gallery.html" if options.output is None else output_path(options.output)
    runs, pages = find_runs(folder), []
    keys = varied(runs)
    for run in runs:
        address, line = run.folder / FIELD_PAGE, "no figure" if run.psnr is None else f"{run.psnr:.2f} dB"
        if not address.exists():
            try:
                page, words = paged(options, run.folder, device)
            except InputError as error:
                print(f"left out: {error}")
                continue
            with atomic(address) as temporary:
                temporary.write_bytes(page)
            print(f"{address}: {words}")
        label = ", ".join(f"{key} {run.option(key)}" for key in keys) or run.folder.name
        pages.append((address_from(output.parent, address), label, line))
    if not pages:
        raise InputError(folder, "", "no run that can be shown", "a folder of finished runs", "see what was left out")
    with atomic(output) as temporary:
        temporary.write_text(gallery_page(folder.resolve().name, pages), encoding="utf-8")
    print(f"{output}: {len(pages)} fields side by side: open it in a browser")
