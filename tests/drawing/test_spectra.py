import math

import numpy as np
import pytest

from nerf_lightning.drawing.spectra import BANDS, amplitudes, brightness, by_frequency, spectrum_chart

SIDE = 256
BAND = 0.5 / BANDS


def wave(across: float, down: float, height: int = SIDE, width: int = SIDE) -> np.ndarray:
    """A cosine of so many cycles a pixel along each side."""
    y, x = np.mgrid[:height, :width]
    return np.cos(2 * np.pi * (across * x + down * y))


def noise(height: int, width: int) -> np.ndarray:
    return np.random.default_rng(0).normal(size=(height, width))


def test_brightness_weighs_colours_as_the_eye_does_and_has_no_mean():
    black_and_colours = np.concatenate([np.zeros((1, 3)), np.eye(3)])[None]
    (grey,) = brightness(black_and_colours)
    assert abs(grey.mean()) < 1e-12
    assert grey[1:] - grey[0] == pytest.approx([0.299, 0.587, 0.114])


@pytest.mark.parametrize(("across", "down"), [(51, 0), (0, 51), (31, 40), (90, -30), (7, 0), (119, 0)])
def test_a_wave_is_one_peak_at_its_frequency(across: int, down: int):
    spectrum = amplitudes(wave(across / SIDE, down / SIDE))
    middle = SIDE // 2
    assert np.argwhere(spectrum > spectrum.max() * 0.99).tolist() == sorted(
        [[middle + down, middle + across], [middle - down, middle - across]]
    )
    frequency, size = by_frequency(spectrum)
    peak, truly = int(size.argmax()), math.hypot(across, down) / SIDE
    assert abs(frequency[peak] - truly) <= BAND / 2
    far = np.abs(frequency - truly) > 4 * BAND
    assert size[far].max() < 1e-3 * size[peak], "the window keeps it from leaking"


@pytest.mark.parametrize(("height", "width"), [(64, 64), (40, 90), (33, 17)])
def test_powers_of_all_frequencies_add_up_to_the_variance(height: int, width: int):
    grey = noise(height, width)
    window = np.outer(*(np.sin(np.pi * np.arange(1, n + 1) / (n + 1)) ** 2 for n in (height, width)))
    expected = (grey**2 * window**2).sum() / (window**2).sum()
    assert (amplitudes(grey) ** 2).sum() == pytest.approx(expected)
    assert (amplitudes(3 * grey) ** 2).sum() == pytest.approx(9 * expected)


def test_noise_has_as_much_of_every_frequency():
    _, size = by_frequency(amplitudes(noise(SIDE, SIDE)))
    assert size[6:] == pytest.approx(np.full(BANDS - 6, 1 / SIDE), rel=0.15), "variance one, spread over all"


def test_rings_are_root_mean_squares_of_equal_frequency():
    spectrum = np.random.default_rng(0).random((8, 12))
    y, x = np.mgrid[-4:4, -6:6]
    radius = np.hypot(y / 8, x / 12)
    frequency, size = by_frequency(spectrum, bands=4)
    assert frequency == pytest.approx([1 / 16, 3 / 16, 5 / 16, 7 / 16])
    for ring in range(4):
        inside = (radius >= ring / 8) & (radius < (ring + 1) / 8 + 1e-9 * (ring == 3))  # the last one holds its end
        assert size[ring] == pytest.approx(math.sqrt((spectrum[inside] ** 2).mean()))


def test_rings_without_any_frequency_are_not_numbers_and_corners_are_left_out():
    _, size = by_frequency(np.ones((4, 4)), bands=8)
    assert np.isnan(size).tolist() == [False, True, True, True, False, False, True, False]
    assert (size[[0, 4, 5, 7]] == 1).all()
    board = amplitudes(wave(0.5, 0.5, 64, 64))
    assert np.nanmax(by_frequency(board)[1]) < 1e-4 * board.max()


def test_the_chart_shows_target_result_and_what_is_missing():
    target = np.random.default_rng(0).random((64, 48, 3))
    result = target.copy()
    result[..., :] += 0.1 * wave(0.25, 0, 64, 48)[..., None]
    figure = spectrum_chart(target, result, "sunset, 30 dB")
    (axes,) = (axes for axes in figure.axes if axes.get_title() == "sunset, 30 dB")
    lines = {line.get_label(): line.get_ydata() for line in axes.lines}
    assert list(lines) == ["target", "result", "error"]
    for name, image in (("target", target), ("result", result), ("error", result - target)):
        expected = by_frequency(amplitudes(brightness(image)))[1]
        assert lines[name] == pytest.approx(expected, abs=1e-7, nan_ok=True), name
    assert int(np.nanargmax(lines["error"])) == BANDS // 2
    pictures = [axes.images[0].get_array() for axes in figure.axes if axes.images]
    assert len(pictures) == 2 and all(p.shape == (64, 48) and p.min() >= -6 for p in pictures)
    assert pictures[0].max() == 0 and not np.array_equal(*pictures)


@pytest.mark.parametrize("shape", [(1, 1, 3), (1, 9, 3), (3, 2, 3)])
@pytest.mark.parametrize("level", [0.0, 0.5])
def test_pictures_without_any_detail_have_charts_too(shape: tuple[int, int, int], level: float):
    assert len(spectrum_chart(np.full(shape, level), np.zeros(shape), "flat").axes) == 4
