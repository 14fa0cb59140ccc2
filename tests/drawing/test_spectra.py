import math

import numpy as np
import pytest

from nerf_lightning.drawing.spectra import NUM_BANDS, amplitude_spectrum, plot_spectra, radial_rms, zero_mean_luma

SIDE = 256
BAND = 0.5 / NUM_BANDS


def wave(across: float, down: float, height: int = SIDE, width: int = SIDE) -> np.ndarray:
    """A cosine wave, frequencies in cycles per pixel."""
    y, x = np.mgrid[:height, :width]
    return np.cos(2 * np.pi * (across * x + down * y))


@pytest.mark.parametrize(("across", "down"), [(51, 0), (90, -30)])
def test_amplitude_spectrum_of_wave_peaks_at_its_frequency(across: int, down: int):
    spectrum = amplitude_spectrum(wave(across / SIDE, down / SIDE))
    peaks = np.argwhere(spectrum > spectrum.max() * 0.99) - SIDE // 2
    assert sorted(map(tuple, peaks)) == sorted([(down, across), (-down, -across)])
    frequency, size = radial_rms(spectrum)
    peak, truly = int(size.argmax()), math.hypot(across, down) / SIDE
    assert abs(frequency[peak] - truly) <= BAND / 2
    assert size[np.abs(frequency - truly) > 4 * BAND].max() < 1e-3 * size[peak], "the window keeps it from leaking"


def test_amplitude_spectrum_power_sums_to_variance():
    height, width = 33, 17
    gray = np.random.default_rng(0).normal(size=(height, width))
    window = np.outer(*(np.sin(np.pi * np.arange(1, n + 1) / (n + 1)) ** 2 for n in (height, width)))
    assert (amplitude_spectrum(gray) ** 2).sum() == pytest.approx((gray**2 * window**2).sum() / (window**2).sum())


@pytest.mark.parametrize("shape", [(64, 48, 3), (1, 1, 3)])
def test_plot_spectra_shows_target_result_and_error(shape: tuple[int, int, int]):
    target = np.random.default_rng(0).random(shape)
    result = target + 0.1 * wave(0.25, 0, *shape[:2])[..., None]
    axes = plot_spectra(target, result, "sunset, 30 dB").axes
    lines = {line.get_label(): line.get_ydata() for line in axes[2].lines}
    assert list(lines) == ["target", "result", "error"]
    for name, image in (("target", target), ("result", result), ("error", result - target)):
        expected = radial_rms(amplitude_spectrum(zero_mean_luma(image)))[1]
        assert lines[name] == pytest.approx(expected, abs=1e-7, nan_ok=True), name
    assert [one.images[0].get_array().shape for one in axes[:2]] == 2 * [shape[:2]]
