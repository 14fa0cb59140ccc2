"""Frequencies of a picture: how much of each is there, and how much of it a field has learned."""

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from scipy.fft import fft2

from nerf_lightning.drawing.panels import downsample
from nerf_lightning.drawing.style import BLUE, DPI, ORANGE, VERMILLION

NUM_BANDS = 64
"""Rings into which the frequencies up to one cycle in two pixels are gathered."""


def zero_mean_luma(image: Float[np.ndarray, "H W 3"]) -> Float[np.ndarray, "H W"]:
    """Luma of sRGB (ITU-R BT.601), its mean taken away."""
    grey = image @ np.array([0.299, 0.587, 0.114], image.dtype)
    return grey - grey.mean()


def amplitude_spectrum(grey: Float[np.ndarray, "H W"]) -> Float[np.ndarray, "H W"]:
    """Size of every frequency, zero in the middle. A Hann window keeps the picture's borders from looking like edges."""
    down, across = (np.hanning(side + 2)[1:-1].astype(grey.dtype) for side in grey.shape)
    # In the picture's precision: in doubles, large ones take gigabytes.
    sizes = np.abs(fft2(grey * down[:, None] * across))
    return np.fft.fftshift(sizes) / np.sqrt((down**2).sum() * (across**2).sum() * grey.size, dtype=grey.dtype)


def radial_rms(
    spectrum: Float[np.ndarray, "H W"], bands: int = NUM_BANDS
) -> tuple[Float[np.ndarray, "B"], Float[np.ndarray, "B"]]:
    """Root mean square over rings of equal frequency: their middles in cycles a pixel, and the sizes (nan for empty rings)."""
    down, across = (np.fft.fftshift(np.fft.fftfreq(n)) for n in spectrum.shape)
    radius = np.hypot(down[:, None], across)  # the corners beyond 0.5 are left out
    count, power = (np.histogram(radius, bands, (0, 0.5), weights=weights)[0] for weights in (None, spectrum**2))
    with np.errstate(invalid="ignore", divide="ignore"):
        return (np.arange(bands) + 0.5) * 0.5 / bands, np.sqrt(power / count)


def plot_spectra(target: Float[np.ndarray, "H W 3"], result: Float[np.ndarray, "H W 3"], title: str) -> Figure:
    """Both spectra as pictures, and by frequency beside that of the error: where they cross, learning ends."""
    figure = Figure(figsize=(16, 5), dpi=DPI, layout="constrained")
    left, middle, right = figure.subplots(1, 3, width_ratios=(1, 1, 1.4))
    greys = {"target": zero_mean_luma(target), "result": zero_mean_luma(result)}
    greys["error"] = greys["result"] - greys["target"]
    top = 0.0  # of the target, which is the first
    for (name, grey), colour, axes in zip(greys.items(), (BLUE, ORANGE, VERMILLION), (left, middle, None), strict=True):
        spectrum = amplitude_spectrum(grey)  # one after the other: that of a large picture is as large
        top = top or max(float(spectrum.max()), 1e-9)
        frequency, size = radial_rms(spectrum)
        right.semilogy(frequency, np.maximum(size, top * 1e-9), color=colour, label=name)
        if axes is not None:
            decades = downsample(np.log10(np.maximum(spectrum, top * 1e-6) / top))
            shown = axes.imshow(decades, extent=(-0.5, 0.5, 0.5, -0.5), vmin=-6, vmax=0, cmap="magma", aspect="auto")
            axes.set(
                title=f"{name}: amplitude, decades", xlabel="cycles a pixel, across", ylabel="cycles a pixel, down"
            )
    figure.colorbar(shown, ax=middle)
    right.set(title=title, xlabel="cycles a pixel (0.5: every other pixel)", ylabel="rms amplitude", xlim=(0, 0.5))
    right.grid(alpha=0.3)
    right.legend()
    return figure
