"""Frequency spectra of an image, of a field's reconstruction, and of the error."""

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from scipy.fft import fft2

from nerf_lightning.drawing.panels import downsample
from nerf_lightning.drawing.style import BLUE, DPI, ORANGE, VERMILLION

NUM_BANDS = 64
"""Number of radial bands up to the Nyquist frequency, 0.5 cycles per pixel."""


def zero_mean_luma(image: Float[np.ndarray, "H W 3"]) -> Float[np.ndarray, "H W"]:
    """Luma of sRGB (ITU-R BT.601), minus its mean."""
    gray = image @ np.array([0.299, 0.587, 0.114], image.dtype)
    return gray - gray.mean()


def amplitude_spectrum(gray: Float[np.ndarray, "H W"]) -> Float[np.ndarray, "H W"]:
    """Amplitude of every frequency, zero in the center; a Hann window keeps the borders from acting as edges."""
    rows, cols = (np.hanning(side + 2)[1:-1].astype(gray.dtype) for side in gray.shape)
    # In the image's precision: in doubles, large ones take gigabytes.
    amplitudes = np.abs(fft2(gray * rows[:, None] * cols))
    return np.fft.fftshift(amplitudes) / np.sqrt((rows**2).sum() * (cols**2).sum() * gray.size, dtype=gray.dtype)


def radial_rms(
    spectrum: Float[np.ndarray, "H W"], bands: int = NUM_BANDS
) -> tuple[Float[np.ndarray, "B"], Float[np.ndarray, "B"]]:
    """Center of each radial band, cycles per pixel, and the RMS amplitude in it (nan for empty bands)."""
    freq_y, freq_x = (np.fft.fftshift(np.fft.fftfreq(n)) for n in spectrum.shape)
    radius = np.hypot(freq_y[:, None], freq_x)  # bands exclude the corners beyond 0.5
    count, power = (np.histogram(radius, bands, (0, 0.5), weights=weights)[0] for weights in (None, spectrum**2))
    with np.errstate(invalid="ignore", divide="ignore"):
        return (np.arange(bands) + 0.5) * 0.5 / bands, np.sqrt(power / count)


def plot_spectra(target: Float[np.ndarray, "H W 3"], result: Float[np.ndarray, "H W 3"], title: str) -> Figure:
    """Plots the spectra of target and result, and the radial amplitudes of both and of the error."""
    figure = Figure(figsize=(16, 5), dpi=DPI, layout="constrained")
    left, middle, right = figure.subplots(1, 3, width_ratios=(1, 1, 1.4))
    grays = {"target": zero_mean_luma(target), "result": zero_mean_luma(result)}
    grays["error"] = grays["result"] - grays["target"]
    max_amplitude = 0.0  # of the target, which comes first
    for (name, gray), color, axes in zip(grays.items(), (BLUE, ORANGE, VERMILLION), (left, middle, None), strict=True):
        spectrum = amplitude_spectrum(gray)  # one at a time: each is as large as the image
        max_amplitude = max_amplitude or max(float(spectrum.max()), 1e-9)
        frequency, amplitude = radial_rms(spectrum)
        right.semilogy(frequency, np.maximum(amplitude, max_amplitude * 1e-9), color=color, label=name)
        if axes is not None:
            decades = downsample(np.log10(np.maximum(spectrum, max_amplitude * 1e-6) / max_amplitude))
            shown = axes.imshow(decades, extent=(-0.5, 0.5, 0.5, -0.5), vmin=-6, vmax=0, cmap="magma", aspect="auto")
            axes.set(title=f"{name}: amplitude, decades", xlabel="cycles per pixel, x", ylabel="cycles per pixel, y")
    figure.colorbar(shown, ax=middle)
    right.set(title=title, xlabel="cycles per pixel (0.5: Nyquist)", ylabel="RMS amplitude", xlim=(0, 0.5))
    right.grid(alpha=0.3)
    right.legend()
    return figure
