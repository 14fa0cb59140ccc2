"""A field as one web page: its compact file, a ray marcher for the browser's graphics, and what a person's hands do with it."""

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
from nerf_lightning.model import TensoRFField, VoxelField
from nerf_lightning.model.layers.activation import SoftenableReLU, shifted_softplus
from nerf_lightning.sampler import OccupancySampler
from nerf_lightning.system import NeRF3D
from nerf_lightning.utils.html import json_for_script, read_minified, render_page

WEB = Path(__file__).with_name("web")
STYLESHEET = WEB / "view.css"
SCRIPTS = [WEB / f"{name}.js" for name in ("common", "compact", "textures", "camera", "renderer", "page")]
IMAGE_SCRIPTS = [WEB / "common.js", WEB / "picture.js"]
MAX_RAY_DISTANCE = 1e9
"""Where a ray ends that nothing else ends, world units."""
MIN_WEIGHT = 1e-4
"""Share of a pixel below which a sample's colour is not asked for: a few dozen such change no byte."""
FRUSTUM_DEPTH_FRACTION = 0.06
"""Depth of a photo's pyramid, as a share of the cameras' distance to what they look at."""
NON_FILENAME_CHARS = re.compile(r"[^\w.-]+")


def get_activation_id(field: TensoRFField | VoxelField) -> int:
    """The map from raw output to density, by its number in march.glsl: exp, relu, softplus."""
    made = field.activation if isinstance(field, TensoRFField) else torch.exp
    if isinstance(made, SoftenableReLU):
        return 2 if made.is_soft else 1
    return 2 if made is shifted_softplus else 0


def encode_cameras(cameras: Cameras) -> dict[str, Any]:
    """Camera-to-world matrices as rows of three, 32-bit, and lenses: one if all are alike, else of each."""
    rows = cameras.c2w[:, :3].contiguous().numpy().astype("<f4")
    lenses = [
        [width, height, K[0][0], K[1][1], K[0][2], K[1][2]]
        for (width, height), K in zip(cameras.sizes.tolist(), cameras.K.tolist(), strict=True)
    ]
    alike = all(lens == lenses[0] for lens in lenses)
    return {"poses": base64.b64encode(rows.tobytes()).decode(), "lenses": lenses[:1] if alike else lenses}


def describe_field(system: NeRF3D, orbit: Cameras) -> dict[str, Any]:
    """What the page needs to know of a field besides its compact file.

    Args:
        system: with planes and lines or voxels, and an occupancy grid.
        orbit: the views that the turntable shows.
    """
    field, sampler = system.field, system.sampler
    assert isinstance(field, TensoRFField | VoxelField) and isinstance(sampler, OccupancySampler)
    bounds = sampler.bounds.to("cpu")
    if bounds.unbounded:  # the same for all rays
        near, far = (float(end) for end in bounds.near_far(Rays(torch.zeros(1, 3), torch.zeros(1, 3))))
    else:  # ends within the box, if there are any; the page knows the box
        near, far = max(bounds.near or 0.0, 0.0), MAX_RAY_DISTANCE if bounds.far is None else bounds.far
    return {
        "kind": "planes" if isinstance(field, TensoRFField) else "voxels",
        "terms": field.terms,
        "activation": get_activation_id(field),
        "density_lr_scale": field.density_lr_scale if isinstance(field, VoxelField) else 1.0,
        "least": MIN_WEIGHT,
        "background": system.renderer.background.color.tolist(),
        "bounds": {
            "low": bounds.aabb[0].tolist(),
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
    """Photos to look through, and how deep to draw their pyramids."""
    depth = FRUSTUM_DEPTH_FRACTION * float((cameras.centres - focus).norm(dim=1).median())
    return {"names": list(names), "depth": depth, **encode_cameras(cameras.to_pinhole())}


def render_field_page(
    compact: bytes,
    system: NeRF3D,
    orbit: Cameras,
    name: str,
    facts: Sequence[tuple[str, str]],
    photos: Cameras | None = None,
    names: Sequence[str] = (),
) -> str:
    """The page's HTML. Nothing in it is fetched from anywhere, and nothing that a run's files say is executed.

    Args:
        compact: a compact file.
        system, orbit: what it holds, see `describe_field`.
        name: of the scene, the page's title.
        facts: about the field, by name.
        photos: cameras to look through, if there are any.
        names: of those.
    """
    about = describe_field(system, orbit)
    about |= {
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
        about=json_for_script(about),
        shader=shader,
        compact=Markup(data),
    )


def render_image_page(picture: UInt8[np.ndarray, "H W 3"], name: str, facts: Sequence[tuple[str, str]]) -> str:
    """The page of an image's field: what the field renders, without loss, and facts about it."""
    image = encode_data_url(picture, "webp")
    return render_page(WEB / "picture.html", [STYLESHEET], IMAGE_SCRIPTS, title=name, facts=facts, image=image)


def render_gallery_page(title: str, pages: Sequence[tuple[str, str, str]]) -> str:
    """Pages side by side, whose views turn together: of each its address, its name, and a line about it."""
    return render_page(WEB / "gallery.html", [WEB / "gallery.css"], [WEB / "gallery.js"], title=title, pages=pages)
