"""nerf_lightning render."""

import time
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

from nerf_lightning.cli.command import Device, Output, Photos, RunPath, command
from nerf_lightning.runs.find import find_run
from nerf_lightning.utils.option_checks import FramesPerSecond, Ge, Le


@command
def render(
    run: RunPath = None,
    /,
    *,
    path: str = "orbit",
    path_frame: Literal["auto", "run", "file"] = "auto",
    frames: Annotated[int, Ge(1), Le(99_999)] | None = None,
    fps: FramesPerSecond = 30.0,
    background: str = "scene",
    scale: Annotated[float, Ge(0.001), Le(1000)] = 1.0,
    channels: str = "rgb",
    output: Output = None,
    photos: Photos = None,
    device: Device = "auto",
) -> Path:
    """Render a run along a camera path, as a video or images. After an interruption the same command continues.

    Args:
        path: orbit, spiral, test or train (beside the photos, with the error), or FILE.json: cameras as in a run's
            scene.json (width, height, K, c2w), or a path of nerfstudio or instant-ngp.
        path_frame: Frame of FILE.json: run, or file for that of the photos' own file; auto by the kind of file.
        frames: How many, spread over the path; default: all it has.
        fps: Frames per second.
        background: scene (as trained), black, white, transparent, or R,G,B in 0..1.
        scale: Times as many pixels along each side.
        channels: rgb, depth, opacity: one or several, side by side.
        output: FILE.mp4, FILE.webp, FILE.gif, or a folder for PNGs; default: render_PATH.webp in the run.

    Returns:
        The video, or the folder.
    """
    from nerf_lightning.render.camera_path import PHOTO_PATHS, build_path
    from nerf_lightning.render.frames import build_manifest, draw_frame, parse_style
    from nerf_lightning.render.video import check_output, write_video
    from nerf_lightning.runs.open import get_output_folder, open_scene_run
    from nerf_lightning.runs.reload import reload_data
    from nerf_lightning.utils.device import resolve_device
    from nerf_lightning.utils.files import check_output_path
    from nerf_lightning.utils.machine import describe_device

    began = time.perf_counter()
    if output is not None:
        check_output(check_output_path(output), background == "transparent")
    where, source = resolve_device(device), find_run(run)
    target = (
        get_output_folder(source) / f"render_{Path(path).stem}.webp" if output is None else check_output_path(output)
    )
    found = open_scene_run(source, where)
    scene: Any = reload_data(found.cfg, found.scene, photos).scene if path in PHOTO_PATHS else None
    route = build_path(path, frames, found.orbit, scene, found.to_source, path_frame, scale)
    style = parse_style(found.system, route, channels, background)
    manifest, count = build_manifest(path, found.system, route, style), len(route.cameras)
    there = write_video(manifest, partial(draw_frame, found.system, route, style), count, target, fps)
    width, height = route.cameras.sizes.amax(0).tolist()
    seconds = f"{time.perf_counter() - began:.1f} s on {describe_device(where)}"
    seconds += f", {there} of them there already" if there else ""
    print(f"{target}: {count} frames of {width} x {height} pixels in {seconds}")
    return target
