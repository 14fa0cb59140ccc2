"""The render verb's options -> a film."""

import hashlib
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from nerf_lightning.dataset import RayDataModule
from nerf_lightning.drawing.frame import CHANNELS, ERROR_TIMES, Style, depth_range, draw, error_picture
from nerf_lightning.drawing.panels import panel
from nerf_lightning.errors import InputError
from nerf_lightning.render.film import KEPT, Picture, check_output, make_film
from nerf_lightning.render.options import RenderOptions
from nerf_lightning.render.route import WITH_PHOTOS, Route, find_route
from nerf_lightning.renderer.renderer import NAMED
from nerf_lightning.runs.data import data_again
from nerf_lightning.runs.open import SceneRun, beside, open_scene_run
from nerf_lightning.system import NeRF3D
from nerf_lightning.utils.device import synchronize, the_device
from nerf_lightning.utils.files import output_path, user_path
from nerf_lightning.utils.machine import device_in_words
from nerf_lightning.utils.memory import check_memory

RENDERED = 60
"""Bytes of a pixel while it is rendered: its number, row, column and view, whole numbers of 64 bits, its ray, and a colour."""


def render(options: RenderOptions) -> None:
    """Renders, and prints what was written.

    Raises:
        InputError: for a wrong device, run, option or output.
    """
    began = time.perf_counter()
    device = the_device(options.device)
    source = user_path(options.run)
    channels = the_channels(options.channels)
    output = beside(source) / f"render_{Path(options.path).stem}.webp"
    if options.output is not None:
        output = output_path(options.output)
    check_output(output, options.background == "transparent")
    found = open_scene_run(source, device)
    route = the_route(options, found)
    check_room(route, output)
    background = the_background(options, found.system, route)
    depths = depth_range(found.system, route.cameras) if "depth" in channels else (0.0, 1.0)
    style = Style(channels, background, depths)
    plan = the_plan(options, found.system, route, style)

    def frame(index: int) -> Picture:
        return (side_by_side if route.photos is None else beside_truth)(found.system, route, index, style)

    there = make_film(plan, frame, len(route.cameras), output, options.fps)
    synchronize(device)
    seconds = time.perf_counter() - began
    width, height = route.cameras.sizes.amax(0).tolist()
    frames = f"{len(route.cameras)} frames of {width} x {height} pixels"
    before = f", {there} of them there already" if there else ""
    print(f"{output}: {frames} in {seconds:.1f} s on {device_in_words(device)}{before}")


def the_channels(given: str | list[str]) -> tuple[str, ...]:
    """Their names.

    Raises:
        InputError: for another name, or one that stands twice.
    """
    names = [name.strip() for name in given.split(",")] if isinstance(given, str) else given
    if not names or any(name not in CHANNELS for name in names) or len(set(names)) < len(names):
        raise InputError(
            "config", "channels", repr(given), f"one or more of {', '.join(CHANNELS)}, separated by commas"
        )
    return tuple(names)


def the_route(options: RenderOptions, found: SceneRun) -> Route:
    """The views to show, at the size asked for."""
    scene = None
    if options.path in WITH_PHOTOS:
        if options.scale != 1 or options.background == "transparent":
            key, value = ("scale", options.scale) if options.scale != 1 else ("background", options.background)
            raise InputError("config", key, str(value), f"scale=1 and a colour beside photos (path={options.path})")
        data = data_again(found.cfg, found.scene, options.photos)
        assert isinstance(data, RayDataModule)  # of a scene's run
        scene = data.scene
    route = find_route(options.path, options.frames, found.orbit, scene, found.to_source, options.path_frame)
    if options.scale == 1:
        return route
    return Route(route.cameras.scaled(options.scale), route.views)


def check_room(route: Route, output: Path) -> None:
    """Refuses frames that certainly do not fit into memory: one while it is rendered, or all while a film is joined.

    Raises:
        InputError: see there.
    """
    pixels = route.cameras.sizes.prod(1)
    frame, todo = int(pixels.max()), "give less of scale or frames"
    check_memory("config", "scale", f"a frame's {frame:,} pixels", RENDERED * frame, todo)
    if output.suffix in KEPT:
        what, kept = f"{len(pixels):,} frames in one film", KEPT[output.suffix] * frame * len(pixels)
        check_memory("config", "frames", what, kept, f"{todo}, or output=FILE.mp4")


def the_background(options: RenderOptions, system: NeRF3D, route: Route) -> tuple[float, float, float] | None:
    """What shows where nothing is, in [0, 1]; None for transparency.

    Raises:
        InputError: for anything else, or where photos have a background that cannot be taken off.
    """
    given = options.background
    own = tuple(system.renderer.colour.tolist())
    if given == "transparent":
        return None
    if given == "scene":
        colour = own
    elif isinstance(given, str) and given in NAMED:
        colour = NAMED[given]
    else:
        try:
            colour = tuple(float(part) for part in (given.split(",") if isinstance(given, str) else given))
        except ValueError:
            colour = ()
    if len(colour) != 3 or not all(0 <= part <= 1 for part in colour):
        expected = "scene, black, white, transparent, or R,G,B in 0..1"
        raise InputError("config", "background", repr(given), expected)
    if route.photos is not None and route.photos.channels == 3 and not np.allclose(colour, own, atol=1e-3):
        expected = f"scene: these photos have no alpha, and stand on {[round(part, 3) for part in own]}"
        raise InputError("config", "background", repr(given), expected)
    red, green, blue = colour
    return red, green, blue


def the_plan(options: RenderOptions, system: NeRF3D, route: Route, style: Style) -> dict[str, Any]:
    """Everything that the frames depend on, as plain values."""
    digest = hashlib.sha256()
    for tensor in (*system.state_dict().values(), route.cameras.K, route.cameras.c2w):
        digest.update(tensor.cpu().contiguous().numpy().tobytes())
    return {
        "what": digest.hexdigest(),
        "path": options.path,
        "views": route.views,
        "size": route.cameras.sizes.tolist(),
        "channels": list(style.channels),
        "background": None if style.background is None else list(style.background),
    }


def side_by_side(system: NeRF3D, route: Route, index: int, style: Style) -> Picture:
    """The channels of a view."""
    return np.concatenate(list(draw(system, route.cameras, index, style).values()), axis=1)


def beside_truth(system: NeRF3D, route: Route, index: int, style: Style) -> Picture:
    """The photo, the render, their difference, and the other channels, with a caption."""
    assert route.photos is not None and style.background is not None  # the verb sees to it
    photo = route.photos.image(index).numpy()
    if photo.shape[-1] == 4:
        alpha = photo[..., 3:] / 255.0
        photo = np.rint(photo[..., :3] * alpha + 255 * (1 - alpha) * np.array(style.background)).astype(np.uint8)
    others = [name for name in style.channels if name != "rgb"]
    drawn = draw(system, route.cameras, index, replace(style, channels=("rgb", *others)))
    error, psnr = error_picture(drawn["rgb"], photo)
    names = ["truth", "render", f"{ERROR_TIMES} x error", *others]
    caption = f"{' | '.join(names)}    view {route.views[index]}, {psnr:.2f} dB"
    return panel([photo, drawn["rgb"], error, *(drawn[name] for name in others)], caption)
