"""Runs as web pages: of a scene, of an image, and of all runs of a folder side by side."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from omegaconf import OmegaConf

import nerf_lightning
from nerf_lightning.drawing.panels import to_bytes
from nerf_lightning.errors import InputError
from nerf_lightning.export.drawable import drawable, is_drawable
from nerf_lightning.export.page import field_page, gallery_page, picture_page
from nerf_lightning.export.smallest import held_out_psnr, occupied_cells, smallest, some_cameras
from nerf_lightning.runs.compact import without_folders
from nerf_lightning.runs.data import data_again
from nerf_lightning.runs.folder import RunFolder, plain_config
from nerf_lightning.runs.index import FIELD_PAGE, find_runs, read_run, varied
from nerf_lightning.runs.open import open_run
from nerf_lightning.utils.files import write_text
from nerf_lightning.utils.html import address_from
from nerf_lightning.utils.text import subsample

MAX_PHOTOS = 100
"""To look through on a page."""


def build_page(
    source: Path,
    device: torch.device,
    cells: int | None = None,
    loss_db: float = 0.1,
    photos: Path | None = None,
) -> tuple[str, str]:
    """A run as a web page, and what to say of it; options as in `cli.export.export_html`."""
    found = open_run(source, device)
    system: Any = found.system
    if found.orbit is not None and source.is_file() and not photos and is_drawable(system):
        content = without_folders(source.read_bytes())  # the page holds that very file
        facts = describe_run(source, found, [("size", f"{len(content) / 1000:,.1f} kB")])
        return field_page(content, system, found.orbit, found.scene["name"], facts), "without photos"
    data = data_again(found.cfg, found.scene, photos)
    if found.orbit is None:
        view: Any = data.held_out(0).to(system.device)
        rgb = system.colours(view.uv).view(view.height, view.width, 3)
        quality = f"PSNR {held_out_psnr(system, data):.2f} dB"
        facts = describe_run(source, found, [("quality", quality), ("size", f"{view.width} x {view.height} pixels")])
        return picture_page(to_bytes(rgb.cpu()), data.scene.name, facts), quality
    drawn = drawable(system, some_cameras(data), plain_config(found.cfg), cells)
    seen = occupied_cells(drawn.system) if drawn.changes else None
    compact = smallest(drawn.system, data, drawn.config, loss_db, seen)
    before = held_out_psnr(system, data) if drawn.changes else compact.before
    content, changes = without_folders(compact.content), "; ".join(drawn.changes)
    measured = [
        ("held-out PSNR", f"{compact.psnr:.2f} dB"),
        ("size", f"{len(content) / 1000:,.1f} kB, {compact.precision} precision"),
    ]
    if changes:
        measured.append(("drawn with", f"{changes}: {before - compact.psnr:.2f} dB lost"))
    train, chosen = data.scene.train, subsample(len(data.scene.train), MAX_PHOTOS)
    cameras, names = train.cameras[torch.tensor(chosen)].to("cpu"), [train.name(i) for i in chosen]
    facts = describe_run(source, found, measured)
    page = field_page(content, drawn.system, found.orbit, data.scene.name, facts, cameras, names)
    return page, f"held-out PSNR {before:.2f} -> {compact.psnr:.2f} dB" + (f" ({changes})" if changes else "")


def describe_run(source: Path, found: RunFolder, measured: Sequence[tuple[str, str]]) -> list[tuple[str, str]]:
    """What a page says of its field."""
    training = []
    if source.is_dir():
        run = read_run(source)
        seconds, steps = run.figure("train_seconds"), run.figure("steps")
        if seconds is not None and steps is not None:
            training = [("training", f"{seconds:.3g} s, {steps:.0f} steps")]
    method = str(OmegaConf.select(found.cfg, "model._target_")).rsplit(".", 1)[-1]
    return [("method", method), *measured, *training, ("made with", f"nerf_lightning {nerf_lightning.__version__}")]


def write_gallery(folder: Path, output: Path, build: Callable[[Path], tuple[str, str]]) -> int:
    """Writes the page of each run below a folder, where it has none yet, and one that shows them all side by side.

    Args:
        folder, output: of the runs, and the page.
        build: makes the page of a run, see `build_page`.

    Returns:
        How many runs are shown.

    Raises:
        InputError: where there is no run, or none that can be shown.
    """
    runs, pages = find_runs(folder), []
    keys = varied(runs)
    for run in runs:
        page = run.folder / FIELD_PAGE
        try:
            if not page.exists():
                write_text(page, build(run.folder)[0])
                print(page)
        except InputError as error:
            print(f"left out: {error}")
            continue
        label = ", ".join(f"{key} {run.option(key)}" for key in keys) or run.folder.name
        pages.append((address_from(output.parent, page), label, run.quality))
    if not pages:
        raise InputError(folder, "", "no run that can be shown", "a folder of finished runs", "see what was left out")
    write_text(output, gallery_page(folder.resolve().name, pages))
    return len(pages)
