"""Report of a 2D run: charts, a GIF, and comparisons with JPEG and bicubic interpolation."""

import math
from itertools import product
from operator import itemgetter
from pathlib import Path
from typing import Annotated, Any

import cv2
import imageio.v3 as imageio
import lightning as L
import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.figure import Figure
from torch import Tensor

from nerf_lightning.callbacks.results import collect_quality_curve, count_artifact_bytes
from nerf_lightning.callbacks.snapshots import SNAPSHOT_FOLDER
from nerf_lightning.callbacks.trainer_access import get_datamodule
from nerf_lightning.dataset import pixel_grid
from nerf_lightning.drawing.panels import downsample, limit_width, make_panel, to_uint8, write_animation, write_png
from nerf_lightning.drawing.spectra import plot_spectra
from nerf_lightning.drawing.style import BLUE, DPI, rasterize_figure
from nerf_lightning.system import NeRF2D, System
from nerf_lightning.utils.files import atomic_write, nan_to_none, write_json
from nerf_lightning.utils.option_checks import Count, FramesPerSecond, Gt, Le

Image = UInt8[np.ndarray, "H W 3"]
JPEG_QUALITIES = (*range(5, 90, 5), *range(90, 101))
"""Qualities compared: bytes grow fastest near 100."""
CHROMA_SUBSAMPLINGS = (cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444)
"""Chroma at half resolution, and at full."""


def plot_error_map(rgb: Float[Tensor, "H W 3"], truth: Float[Tensor, "H W 3"], title: str) -> Figure:
    """Plots the error of every pixel, averaged over the channels."""
    error = (rgb - truth).abs_().mean(-1).mul_(255).numpy()
    height, width = error.shape
    figure = Figure(figsize=(8, 1 + 7 * min(max(height / width, 0.2), 3)), dpi=DPI, layout="constrained")
    axes = figure.subplots()
    # The largest errors would make all others look dark.
    top = max(float(np.percentile(error, 99.9)), 1e-3)
    edges = (-0.5, width - 0.5, height - 0.5, -0.5)
    shown = axes.imshow(downsample(error), extent=edges, vmin=0, vmax=top, cmap="inferno")
    axes.set(title=title, xlabel="column, pixels", ylabel="row, pixels")
    figure.colorbar(shown, ax=axes, label="absolute error, mean over colors, 1/255", shrink=0.8)
    return figure


def plot_psnr_curve(curve: list[list[float]], title: str) -> Figure:
    """Plots PSNR over training seconds and over steps."""
    figure = Figure(figsize=(12, 4.5), dpi=DPI, layout="constrained")
    for axes, column, label in zip(figure.subplots(1, 2), (0, 1), ("training seconds", "step"), strict=True):
        points = [(p[column], p[2]) for p in curve if p[column] > 0]  # on a logarithmic axis
        if points:
            axes.plot(*zip(*points, strict=True), "o-", color=BLUE, markersize=4)
            axes.set_xscale("log")
        axes.set(xlabel=label, ylabel="PSNR, dB")
        axes.grid(alpha=0.3, which="both")
    figure.suptitle(title)
    return figure


class PictureReport(L.Callback):
    """Writes error.png, spectrum.png, curve.png, training.gif of the snapshots, and baselines.json after the test.

    baselines.json compares the field with a JPEG and with a downsampled picture of the same bytes.

    Args:
        fps: frames per second of training.gif; the last one is shown three times.
        width: most pixels across; wider snapshots are downsampled.
    """

    def __init__(self, fps: FramesPerSecond = 3, width: Count = 640):
        self.fps = fps
        self.width = width

    def on_test_end(self, trainer: L.Trainer, pl_module: System) -> None:
        if not trainer.is_global_zero:
            return
        data, folder = get_datamodule(trainer), Path(trainer.default_root_dir)
        (result,) = pl_module.evaluate_held_out(data, [0])
        title = f"{data.scene.name}, step {trainer.global_step}, {result.psnr:.2f} dB"
        write_png(folder / "error.png", rasterize_figure(plot_error_map(result.rgb, result.truth, title)))
        spectrum = plot_spectra(result.truth.numpy(), result.rgb.numpy(), title)
        write_png(folder / "spectrum.png", rasterize_figure(spectrum))
        write_png(folder / "curve.png", rasterize_figure(plot_psnr_curve(collect_quality_curve(trainer), title)))
        if files := sorted((folder / SNAPSHOT_FOLDER).glob("step_*.png")):
            self.write_gif(files, folder / "training.gif")
        comparison = compare_with_jpeg(data.scene.image.numpy(), count_artifact_bytes(pl_module))
        write_json(folder / "baselines.json", nan_to_none({**comparison, "field": round(result.psnr, 4)}))
        jpeg = "none that small" if comparison["jpeg"] is None else format_psnr(comparison["jpeg"]["psnr"])
        size, bicubic = comparison["bytes"] / 1e3, format_psnr(comparison["bicubic"]["psnr"])
        print(f"in {size:,.1f} kB: JPEG {jpeg}; downsampled and enlarged by bicubic interpolation {bicubic}")

    def write_gif(self, files: list[Path], target: Path) -> None:
        """Writes an animation of image files, at the size of the last."""
        height, width, _ = limit_width(imageio.imread(files[-1]), self.width).shape
        pictures = (imageio.imread(file) for file in [*files, files[-1], files[-1]])
        frames = (cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA) for image in pictures)
        with atomic_write(target) as temporary:
            write_animation(temporary, frames, 1 / self.fps)


def compute_psnr(image: Image, truth: Image) -> float:
    """PSNR in dB, infinite if the two are equal."""
    return math.inf if np.array_equal(image, truth) else round(cv2.PSNR(image, truth), 4)


def format_psnr(psnr_db: float) -> str:
    return "without loss" if psnr_db == math.inf else f"{psnr_db:.2f} dB"


def encode_jpegs(image: Image) -> list[dict[str, Any]]:
    """Quality, size in bytes and PSNR of JPEGs of an image."""
    jpegs, bgr = [], np.ascontiguousarray(image[..., ::-1])
    for quality, sampling in product(JPEG_QUALITIES, CHROMA_SUBSAMPLINGS):
        options = [cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, sampling]
        _, encoded = cv2.imencode(".jpg", bgr, options)
        decoded = cv2.imdecode(encoded, cv2.IMREAD_COLOR)
        assert decoded is not None  # encoded one line above
        jpegs.append({"quality": quality, "bytes": len(encoded), "psnr": compute_psnr(decoded, bgr)})
    return jpegs


def downsample_to_bytes(image: Image, max_bytes: int) -> dict[str, Any]:
    """Downsamples an image to `max_bytes` at three bytes per pixel, then enlarges it by bicubic interpolation."""
    height, width = image.shape[:2]
    scale = min(1.0, (max_bytes / image.nbytes) ** 0.5)
    size = (max(1, int(width * scale)), max(1, int(height * scale)))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    enlarged = cv2.resize(small, (width, height), interpolation=cv2.INTER_CUBIC)
    return {"width": size[0], "height": size[1], "bytes": small.nbytes, "psnr": compute_psnr(enlarged, image)}


def compare_with_jpeg(image: Image, size: int) -> dict[str, Any]:
    """Best JPEG of at most `size` bytes, None if none is that small, and the image downsampled to them."""
    candidates = [jpeg for jpeg in encode_jpegs(image) if jpeg["bytes"] <= size]
    best = max(candidates, key=itemgetter("psnr"), default=None)
    return {"bytes": size, "picture_bytes": image.nbytes, "jpeg": best, "bicubic": downsample_to_bytes(image, size)}


class PictureUpscaling(L.Callback):
    """Renders a 2D field at another scale after the test: enlarged.png, and enlarged_panel.png next to bicubic.

    If the picture was downsampled for training (`dataset.max_side`) or is the built-in one, its larger original is known, and
    both are compared with it: printed, and in enlarged.json.

    Args:
        scale: factor on width and height; None does nothing.
    """

    def __init__(self, scale: Annotated[float, Gt(0), Le(64)] | None = None):
        self.scale = scale

    def on_test_end(self, trainer: L.Trainer, pl_module: NeRF2D) -> None:
        scene, folder = get_datamodule(trainer).scene, Path(trainer.default_root_dir)
        if self.scale is None or not trainer.is_global_zero:
            return
        width, height = (max(1, round(side * self.scale)) for side in scene.size)
        rgb = pl_module.query_rgb(pixel_grid(height, width).to(pl_module.device)).cpu()
        field, truth = to_uint8(rgb.view(height, width, 3)), scene.make_reference(width, height)
        method = cv2.INTER_CUBIC if self.scale > 1 else cv2.INTER_AREA  # bicubic alone would skip pixels when shrinking
        bicubic = cv2.resize(scene.image.numpy(), (width, height), interpolation=method)
        images = {"bicubic": bicubic, "field": field} | ({} if truth is None else {"truth": truth.numpy()})
        scores: dict[str, float | None] = {"field": None, "bicubic": None}
        if truth is not None:
            scores = {name: compute_psnr(images[name], images["truth"]) for name in scores}
        write_png(folder / "enlarged.png", field)
        panel = make_panel([*images.values()], f"{' | '.join(images)}    {width}x{height}")
        write_png(folder / "enlarged_panel.png", panel)
        size = {"scale": self.scale, "width": width, "height": height}
        write_json(folder / "enlarged.json", nan_to_none({**size, **scores}))
        text = ", ".join(f"{name} {format_psnr(psnr)}" for name, psnr in scores.items() if psnr is not None)
        unknown = "no larger original to judge by (dataset.max_side=... shrinks a picture for training and keeps it)"
        print(f"{self.scale:g} times as large ({width}x{height}): {text or unknown}")
