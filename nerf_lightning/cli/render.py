"""nerf_lightning render."""

from pathlib import Path
from typing import Annotated, Any, Literal

from nerf_lightning.cli.command import Device, Output, Photos, RunPath, command
from nerf_lightning.errors import InputError
from nerf_lightning.runs.find import find_run
from nerf_lightning.utils.options import AtLeast, AtMost, FramesPerSecond


@command
def render(
    run: RunPath = None,
    /,
    *,
    path: str = "orbit",
    path_frame: Literal["auto", "run", "file"] = "auto",
    frames: Annotated[int, AtLeast(1), AtMost(99_999)] | None = None,
    fps: FramesPerSecond = 30.0,
    background: str = "scene",
    scale: Annotated[float, AtLeast(0.001), AtMost(1000)] = 1.0,
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

    Raises:
        InputError: for an option, device, run or output that is no good.
    """
    import time

    from nerf_lightning.drawing.frame import Style, depth_range
    from nerf_lightning.render.camera_path import SPLITS, CameraPath, build_path, check_path
    from nerf_lightning.render.frames import (
        check_photos_background,
        describe_frames,
        draw_frame,
        parse_background,
        parse_channels,
    )
    from nerf_lightning.render.video import check_output, write_video
    from nerf_lightning.runs.data import data_again
    from nerf_lightning.runs.open import beside, open_scene_run
    from nerf_lightning.utils.device import synchronize, the_device
    from nerf_lightning.utils.files import output_path
    from nerf_lightning.utils.machine import device_in_words

    began = time.perf_counter()
    names, colour = parse_channels(channels), parse_background(background)
    check_path(path, path_frame)
    if path in SPLITS and (scale != 1 or background == "transparent"):
        key, value = ("scale", f"{scale:g}") if scale != 1 else ("background", background)
        raise InputError("render", key, value, f"scale 1 and a colour beside photos (path {path})")
    if output is not None:
        check_output(output_path(output), background == "transparent")
    where, source = the_device(device), find_run(run)
    target = beside(source) / f"render_{Path(path).stem}.webp" if output is None else output_path(output)
    found = open_scene_run(source, where)
    scene: Any = None
    if path in SPLITS:
        scene = data_again(found.cfg, found.scene, photos).scene
    route = build_path(path, frames, found.orbit, scene, found.to_source, path_frame)
    if scale != 1:
        route = CameraPath(route.cameras.scaled(scale), route.views)
    check_photos_background(colour, found.system, route)
    if background == "scene":
        red, green, blue = found.system.renderer.background.color.tolist()
        colour = red, green, blue
    depths = depth_range(found.system, route.cameras) if "depth" in names else (0.0, 1.0)
    style = Style(names, colour, depths)
    plan = describe_frames(path, found.system, route, style)
    count = len(route.cameras)
    there = write_video(plan, lambda index: draw_frame(found.system, route, index, style), count, target, fps)
    synchronize(where)
    width, height = route.cameras.sizes.amax(0).tolist()
    seconds = f"{time.perf_counter() - began:.1f} s on {device_in_words(where)}"
    before = f", {there} of them there already" if there else ""
    print(f"{target}: {count} frames of {width} x {height} pixels in {seconds}{before}")
    return target
