"""Self-contained web page of a field: compact file, WebGL ray marcher and controls."""

import base64
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from markupsafe import Markup
from torch import Tensor

from nerf_lightning.cameras import Cameras, Rays, find_pivot, mean_up
from nerf_lightning.drawing.panels import encode_data_url
from nerf_lightning.model import HashGridField, TensoRFField, VoxelField
from nerf_lightning.model.layers.activation import SoftenableReLU, shifted_softplus
from nerf_lightning.sampler import OccupancySampler
from nerf_lightning.sampler.samples import MIN_SAMPLE_WEIGHT
from nerf_lightning.system import NeRF3D
from nerf_lightning.utils.html import json_for_script, read_minified, render_page

WEB = Path(__file__).with_name("web")
STYLESHEET = WEB / "view.css"
SCRIPTS = [WEB / f"{name}.js" for name in ("common", "compact", "textures", "camera", "renderer", "page")]
IMAGE_SCRIPTS = [WEB / "common.js", WEB / "picture.js"]
MAX_RAY_DISTANCE = 1e9
"""Far distance of unlimited rays, world units."""
MIN_WEIGHT = 1e-4
"""Weight below which a sample's color is skipped: a few dozen of them do not change 8-bit values."""
FRUSTUM_DEPTH_FRACTION = 0.06
"""Depth of a photo's frustum, relative to the cameras' distance to the focus."""
REACH_FRACTION = 0.25
"""Distance from the nearest photo within which the page keeps its camera in an unbounded scene, relative to the same."""
NON_FILENAME_CHARS = re.compile(r"[^\w.-]+")
DrawableField = TensoRFField | VoxelField | HashGridField
"""Fields with a branch of their own in march.glsl."""


def get_activation_id(field: DrawableField) -> int:
    """Number of the density activation in march.glsl: 0 exp, 1 relu, 2 softplus."""
    activation = torch.exp if isinstance(field, VoxelField) else field.activation
    if isinstance(activation, SoftenableReLU):
        return 2 if activation.is_soft else 1
    return 2 if activation is shifted_softplus else 0


def encode_cameras(cameras: Cameras) -> dict[str, Any]:
    """Encodes camera-to-world matrices [3, 4] in float32, and intrinsics: one if all are equal."""
    rows = cameras.c2w[:, :3].contiguous().numpy().astype("<f4")
    lenses = [
        [width, height, K[0][0], K[1][1], K[0][2], K[1][2]]
        for (width, height), K in zip(cameras.sizes.tolist(), cameras.K.tolist(), strict=True)
    ]
    shared = all(lens == lenses[0] for lens in lenses)
    return {"poses": base64.b64encode(rows.tobytes()).decode(), "lenses": lenses[:1] if shared else lenses}


def describe_field(system: NeRF3D, orbit: Cameras) -> dict[str, Any]:
    """Parameters of the page's renderer besides the compact file.

    Args:
        system: with a TensoRF, hash-grid or voxel field and an occupancy grid.
        orbit: views of the turntable.
    """
    field, sampler = system.field, system.sampler
    assert isinstance(field, DrawableField) and isinstance(sampler, OccupancySampler)
    hashed = field if isinstance(field, HashGridField) else None
    bounds = sampler.bounds.to("cpu")
    if bounds.unbounded:  # equal for all rays
        near, far = (float(end) for end in bounds.near_far(Rays(torch.zeros(1, 3), torch.zeros(1, 3))))
    else:  # near and far limits; the page clips to the box
        near, far = max(bounds.near or 0.0, 0.0), MAX_RAY_DISTANCE if bounds.far is None else bounds.far
    return {
        "kind": "hashes" if hashed else "planes" if isinstance(field, TensoRFField) else "voxels",
        "levels": [[cells[0], size] for cells, size in zip(hashed.grid.cells, hashed.grid.sizes, strict=True)]
        if hashed
        else [],
        "residual": int(hashed is not None and hashed.view_residual),
        "terms": field.terms,
        "activation": get_activation_id(field),
        "density_lr_scale": field.density_lr_scale if isinstance(field, VoxelField) else 1.0,
        "least": MIN_SAMPLE_WEIGHT if hashed else MIN_WEIGHT,
        "background": system.renderer.background.color.tolist(),
        "bounds": {
            "low": bounds.box[0].tolist(),
            "size": (2 * bounds.half_size).tolist(),
            "unit": bounds.max_half_size,
            "unbounded": bounds.unbounded,
            "near": near,
            "far": far,
        },
        "sampler": {
            "samples": sampler.eval_samples,
            "step": sampler.step_size(sampler.eval_samples),
            "cells": sampler.grid.resolution,
            "stop": sampler.early_stop_eps,
        },
        "focus": find_pivot(orbit).tolist(),
        "up": mean_up(orbit).tolist(),
        "orbit": encode_cameras(orbit),
    }


def describe_photos(cameras: Cameras, names: Sequence[str], focus: Float[Tensor, "3"]) -> dict[str, Any]:
    """Cameras of photos, the depth of their frusta, and how far from them the page's camera may go."""
    distance = float((cameras.centers - focus).norm(dim=1).median())
    lengths = {"depth": FRUSTUM_DEPTH_FRACTION * distance, "reach": REACH_FRACTION * distance}
    return {"names": list(names), **lengths, **encode_cameras(cameras.to_pinhole())}


def render_field_page(
    compact: bytes,
    system: NeRF3D,
    orbit: Cameras,
    name: str,
    facts: Sequence[tuple[str, str]],
    photos: Cameras | None = None,
    names: Sequence[str] = (),
    poster: UInt8[np.ndarray, "H W 3"] | None = None,
) -> str:
    """Renders the page's HTML: loads nothing from elsewhere, and escapes all content of the run.

    Args:
        compact: a compact file.
        system, orbit: see `describe_field`.
        name: the scene's, used as title.
        facts: name and value of each.
        photos: cameras of photos, if available.
        names: of the photos.
        poster: the first view, shown until the page has drawn it.
    """
    about = describe_field(system, orbit)
    about |= {
        "poster": None if poster is None else encode_data_url(poster, "jpeg"),
        "file": NON_FILENAME_CHARS.sub("_", name) or "field",
        "facts": [list(fact) for fact in facts],
        "photos": None if photos is None else describe_photos(photos, names, torch.tensor(about["focus"])),
    }
    shader, data = Markup(read_minified(WEB / "march.glsl")), base64.b64encode(compact).decode()
    return render_page(
        WEB / "field.html",
        [STYLESHEET],
        SCRIPTS,
        title=name,
        facts=facts,
        photos=photos is not None,
        stays=system.field.bounds.unbounded,
        about=json_for_script(about),
        shader=shader,
        compact=Markup(data),
    )


def render_image_page(picture: UInt8[np.ndarray, "H W 3"], name: str, facts: Sequence[tuple[str, str]]) -> str:
    """Renders the page of an image: the lossless render, and facts."""
    image = encode_data_url(picture, "webp")
    return render_page(WEB / "picture.html", [STYLESHEET], IMAGE_SCRIPTS, title=name, facts=facts, image=image)


def render_gallery_page(title: str, pages: Sequence[tuple[str, str, str]]) -> str:
    """Renders a gallery with synchronized views; `pages` are (URL, name, description)."""
    return render_page(WEB / "gallery.html", [WEB / "gallery.css"], [WEB / "gallery.js"], title=title, pages=pages)
