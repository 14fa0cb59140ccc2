"""Web pages of runs: scenes, images, and galleries of all runs of a folder."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import UInt8
from omegaconf import OmegaConf

import nerf_lightning
from nerf_lightning.cameras import Cameras, start_at_middle
from nerf_lightning.drawing.panels import to_uint8
from nerf_lightning.errors import InputError
from nerf_lightning.export.bake import bake_system, is_web_renderable
from nerf_lightning.export.compress import MAX_BAKED_PIXELS, compress_system, measure_held_out_psnr
from nerf_lightning.export.web_page import render_field_page, render_gallery_page, render_image_page
from nerf_lightning.model import HashGridField
from nerf_lightning.runs.compact import strip_local_paths
from nerf_lightning.runs.folder import LoadedRun, config_to_dict
from nerf_lightning.runs.open import open_run
from nerf_lightning.runs.reload import reload_data
from nerf_lightning.runs.summaries import FIELD_PAGE, find_runs, find_varying_options, read_run
from nerf_lightning.system import NeRF3D
from nerf_lightning.utils.files import write_text
from nerf_lightning.utils.html import relative_url
from nerf_lightning.utils.text import subsample

MAX_POSTER_SIDE = 240
"""Longest side of the picture that a page shows until it has drawn one, pixels."""
MAX_PHOTOS = 100
"""Training cameras shown on a page."""


def build_page(
    source: Path,
    device: torch.device,
    cells: int | None = None,
    max_psnr_drop: float = 0.15,
    photos: Path | None = None,
) -> tuple[str, str]:
    """Builds a run's web page; returns it with a summary. Options as in `cli.export.export_html`."""
    run = open_run(source, device)
    system: Any = run.system
    orbit = None if run.orbit is None else start_at_middle(run.orbit)
    if orbit is not None and source.is_file() and not photos and is_web_renderable(system):
        content = strip_local_paths(source.read_bytes())  # embedded unchanged
        facts = describe_run(source, run, [("size", f"{len(content) / 1000:,.1f} kB")])
        return render_field_page(content, system, orbit, run.scene["name"], facts), "without photos"
    data = reload_data(run.cfg, run.scene, photos)
    if orbit is None:
        view: Any = data.get_held_out_view(0).to(system.device)
        rgb = system.query_rgb(view.uv).view(view.height, view.width, 3)
        quality = f"PSNR {measure_held_out_psnr(system, data):.2f} dB"
        facts = describe_run(source, run, [("quality", quality), ("size", f"{view.width} x {view.height} pixels")])
        return render_image_page(to_uint8(rgb.cpu()), data.scene.name, facts), quality
    posed: Any = data
    baked = bake_system(system, posed, config_to_dict(run.cfg), cells)
    compact = compress_system(baked.system, data, baked.config, max_psnr_drop, bool(baked.changes))
    original_psnr = compact.psnr_before
    if baked.changes:
        original_psnr = measure_held_out_psnr(system, data, max_pixels=MAX_BAKED_PIXELS)
    content, changes = strip_local_paths(compact.content), "; ".join(baked.changes)
    size = f"{len(content) / 1000:,.1f} kB, {compact.precision} precision"
    measured = [("held-out PSNR", f"{compact.psnr:.2f} dB"), ("size", size)]
    if changes:
        measured.append(("drawn with", f"{changes}: {original_psnr - compact.psnr:.2f} dB lost"))
    train, indices = data.scene.train, subsample(len(data.scene.train), MAX_PHOTOS)
    cameras, names = train.cameras[torch.tensor(indices)].to("cpu"), [train.name(i) for i in indices]
    facts = describe_run(source, run, measured)
    poster = render_poster(baked.system, orbit) if isinstance(baked.system.field, HashGridField) else None
    page = render_field_page(content, baked.system, orbit, data.scene.name, facts, cameras, names, poster)
    return page, f"held-out PSNR {original_psnr:.2f} -> {compact.psnr:.2f} dB" + (f" ({changes})" if changes else "")


def render_poster(system: NeRF3D, orbit: Cameras) -> UInt8[np.ndarray, "H W 3"]:
    """The orbit's first view, at most `MAX_POSTER_SIDE` pixels long."""
    view = orbit[:1].rescale(min(1.0, MAX_POSTER_SIDE / orbit.max_side))
    width, height = view.size(0)
    return to_uint8(system.render(view.generate_view_rays(0).to(system.device)).rgb.view(height, width, 3).cpu())


def describe_run(source: Path, loaded: LoadedRun, measured: Sequence[tuple[str, str]]) -> list[tuple[str, str]]:
    """Facts about a run, shown on its page."""
    training = []
    if source.is_dir():
        run = read_run(source)
        seconds, steps = run.get_metric("train_seconds"), run.get_metric("steps")
        if seconds is not None and steps is not None:
            training = [("training", f"{seconds:.3g} s, {steps:.0f} steps")]
    method = str(OmegaConf.select(loaded.cfg, "model._target_")).rsplit(".", 1)[-1]
    return [("method", method), *measured, *training, ("made with", f"nerf_lightning {nerf_lightning.__version__}")]


def write_gallery(folder: Path, output: Path, build: Callable[[Path], tuple[str, str]]) -> int:
    """Writes missing pages of the runs below a folder, and a gallery of all; returns the number of runs shown.

    Args:
        folder, output: folder of runs, and gallery file.
        build: see `build_page`.

    Raises:
        InputError: no run, or none that can be shown.
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
        raise InputError(folder, "", "no run can be shown", hint="see the messages above")
    write_text(output, render_gallery_page(folder.resolve().name, pages))
    return len(pages)
