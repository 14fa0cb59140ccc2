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
    """Render a run along a camera path, as a video or images. If interrupted, the same command continues.

    Args:
        path: orbit, spiral, test or train (next to the photos, with the error), or FILE.json: cameras as in a run's
            scene.json (width, height, K, c2w), or a nerfstudio or instant-ngp path.
        path_frame: Coordinate frame of FILE.json: run, file (the photos' own), or auto by its format.
        frames: Number of frames along the path; default: that of the path.
        fps: Frames per second.
        background: scene (as trained), black, white, transparent, or R,G,B in 0..1.
        scale: Factor on the width and height.
        channels: One or more of rgb, depth, opacity, side by side.
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
    target = None if output is None else check_output_path(output)
    if target is not None:
        check_output(target, background == "transparent")
    where, source = resolve_device(device), find_run(run)
    target = target or get_output_folder(source) / f"render_{Path(path).stem}.webp"
    loaded = open_scene_run(source, where)
    scene: Any = reload_data(loaded.cfg, loaded.scene, photos).scene if path in PHOTO_PATHS else None
    camera_path = build_path(path, frames, loaded.orbit, scene, loaded.to_source, path_frame, scale)
    style = parse_style(loaded.system, camera_path, channels, background)
    manifest, count = build_manifest(path, loaded.system, camera_path, style), len(camera_path.cameras)
    reused = write_video(manifest, partial(draw_frame, loaded.system, camera_path, style), count, target, fps)
    width, height = camera_path.cameras.sizes.amax(0).tolist()
    seconds = f"{time.perf_counter() - began:.1f} s on {describe_device(where)}"
    seconds += f", {reused} of them reused" if reused else ""
    print(f"{target}: {count} frames of {width} x {height} pixels in {seconds}")
    return target
