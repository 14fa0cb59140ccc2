"""Runs as web pages: of a scene, of an image, and of all runs of a folder side by side."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from omegaconf import OmegaConf

import nerf_lightning
from nerf_lightning.drawing.panels import to_uint8
from nerf_lightning.errors import InputError
from nerf_lightning.export.bake import bake_system, is_web_renderable
from nerf_lightning.export.compress import compress_system, get_occupied_cells, measure_held_out_psnr, subsample_cameras
from nerf_lightning.export.web_page import render_field_page, render_gallery_page, render_image_page
from nerf_lightning.runs.compact import strip_local_paths
from nerf_lightning.runs.folder import LoadedRun, config_to_dict
from nerf_lightning.runs.open import open_run
from nerf_lightning.runs.reload import reload_data
from nerf_lightning.runs.summaries import FIELD_PAGE, find_runs, find_varying_options, read_run
from nerf_lightning.utils.files import write_text
from nerf_lightning.utils.html import relative_url
from nerf_lightning.utils.text import subsample

MAX_PHOTOS = 100
"""To look through on a page."""


def build_page(
    source: Path,
    device: torch.device,
    cells: int | None = None,
    max_psnr_drop: float = 0.1,
    photos: Path | None = None,
) -> tuple[str, str]:
    """A run as a web page, and what to say of it; options as in `cli.export.export_html`."""
    found = open_run(source, device)
    system: Any = found.system
    if found.orbit is not None and source.is_file() and not photos and is_web_renderable(system):
        content = strip_local_paths(source.read_bytes())  # the page holds that very file
        facts = describe_run(source, found, [("size", f"{len(content) / 1000:,.1f} kB")])
        return render_field_page(content, system, found.orbit, found.scene["name"], facts), "without photos"
    data = reload_data(found.cfg, found.scene, photos)
    if found.orbit is None:
        view: Any = data.get_held_out_view(0).to(system.device)
        rgb = system.query_rgb(view.uv).view(view.height, view.width, 3)
        quality = f"PSNR {measure_held_out_psnr(system, data):.2f} dB"
        facts = describe_run(source, found, [("quality", quality), ("size", f"{view.width} x {view.height} pixels")])
        return render_image_page(to_uint8(rgb.cpu()), data.scene.name, facts), quality
    drawn = bake_system(system, subsample_cameras(data), config_to_dict(found.cfg), cells)
    seen = get_occupied_cells(drawn.system) if drawn.changes else None
    compact = compress_system(drawn.system, data, drawn.config, max_psnr_drop, seen)
    before = measure_held_out_psnr(system, data) if drawn.changes else compact.psnr_before
    content, changes = strip_local_paths(compact.content), "; ".join(drawn.changes)
    measured = [
        ("held-out PSNR", f"{compact.psnr:.2f} dB"),
        ("size", f"{len(content) / 1000:,.1f} kB, {compact.precision} precision"),
    ]
    if changes:
        measured.append(("drawn with", f"{changes}: {before - compact.psnr:.2f} dB lost"))
    train, chosen = data.scene.train, subsample(len(data.scene.train), MAX_PHOTOS)
    cameras, names = train.cameras[torch.tensor(chosen)].to("cpu"), [train.name(i) for i in chosen]
    facts = describe_run(source, found, measured)
    page = render_field_page(content, drawn.system, found.orbit, data.scene.name, facts, cameras, names)
    return page, f"held-out PSNR {before:.2f} -> {compact.psnr:.2f} dB" + (f" ({changes})" if changes else "")


def describe_run(source: Path, found: LoadedRun, measured: Sequence[tuple[str, str]]) -> list[tuple[str, str]]:
    """What a page says of its field."""
    training = []
    if source.is_dir():
        run = read_run(source)
        seconds, steps = run.get_metric("train_seconds"), run.get_metric("steps")
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
    keys = find_varying_options(runs)
    for run in runs:
        page = run.folder / FIELD_PAGE
        try:
            if not page.exists():
                write_text(page, build(run.folder)[0])
                print(page)
        except InputError as error:
            print(f"left out: {error}")
            continue
        label = ", ".join(f"{key} {run.get_option(key)}" for key in keys) or run.folder.name
        pages.append((relative_url(output.parent, page), label, run.psnr_text))
    if not pages:
        raise InputError(folder, "", "no run can be shown", hint="see what was left out")
    write_text(output, render_gallery_page(folder.resolve().name, pages))
    return len(pages)
