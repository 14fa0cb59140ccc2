"""PictureCharts: error, spectrum and curve of a finished 2D run."""

from pathlib import Path

import lightning as L
import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from torch import Tensor

from nerf_lightning.callbacks.attached import attached, data_of
from nerf_lightning.callbacks.evaluation import Evaluation
from nerf_lightning.callbacks.results import quality_curve
from nerf_lightning.drawing.ink import BLUE, DPI, pixels_of
from nerf_lightning.drawing.panels import averaged, write_png
from nerf_lightning.drawing.spectra import spectrum_chart
from nerf_lightning.system import System


def error_chart(rgb: Float[Tensor, "H W 3"], truth: Float[Tensor, "H W 3"], title: str) -> Figure:
    """The error of every pixel, averaged over the colours, with a colour bar."""
    error = (rgb - truth).abs_().mean(-1).mul_(255).numpy()
    height, width = error.shape
    figure = Figure(figsize=(8, 1 + 7 * min(max(height / width, 0.2), 3)), dpi=DPI, layout="constrained")
    axes = figure.subplots()
    # The largest errors would make all others look dark.
    top = max(float(np.percentile(error, 99.9)), 1e-3)
    edges = (-0.5, width - 0.5, height - 0.5, -0.5)
    shown = axes.imshow(averaged(error), extent=edges, vmin=0, vmax=top, cmap="inferno")
    axes.set(title=title, xlabel="column, pixels", ylabel="row, pixels")
    figure.colorbar(shown, ax=axes, label="absolute error, mean over colours, 1/255", shrink=0.8)
    return figure


def curve_chart(curve: list[list[float]], title: str) -> Figure:
    """PSNR over training seconds and over steps."""
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


class PictureCharts(L.Callback):
    """Writes error.png, spectrum.png and curve.png into the run folder after the test."""

    def on_test_end(self, trainer: L.Trainer, pl_module: System) -> None:
        if not trainer.is_global_zero:
            return
        data, evaluation = data_of(trainer), attached(trainer, Evaluation)
        (result,) = pl_module.evaluate_held_out(data, [0])
        title = f"{data.scene.name}, step {trainer.global_step}, {result.psnr:.2f} dB"
        folder = Path(trainer.default_root_dir)
        write_png(folder / "error.png", pixels_of(error_chart(result.rgb, result.truth, title)))
        spectrum = spectrum_chart(result.truth.numpy(), result.rgb.numpy(), title)
        write_png(folder / "spectrum.png", pixels_of(spectrum))
        curve = quality_curve(trainer, evaluation.psnr if evaluation is not None else None)
        if curve:
            write_png(folder / "curve.png", pixels_of(curve_chart(curve, title)))
