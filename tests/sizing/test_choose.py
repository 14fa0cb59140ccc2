"""When growing stops, what is trained in full, and which rung is enough."""

import pytest

from nerf_lightning.sizing.choose import (
    RungResult,
    Target,
    choose_candidate,
    choose_final,
    choose_neighbor,
    is_growth_finished,
)

NEAR = Target(within_db=0.3)


def rungs(*psnrs: float) -> list[RungResult]:
    """Rungs of twice the bytes each."""
    return [RungResult(psnr, 1000 * 2**index) for index, psnr in enumerate(psnrs)]


@pytest.mark.parametrize(("gain", "by", "stops"), [(0.2, 2, False), (0.05, 2, True), (0.2, 8, True), (0.2, 0.5, False)])
def test_is_growth_finished_weighs_gain_against_bytes(gain: float, by: float, stops: bool):
    after = RungResult(20 + gain, int(1000 * by))
    assert is_growth_finished([RungResult(20, 1000), after, after], NEAR) is stops


@pytest.mark.parametrize(
    ("psnrs", "target", "stops"),
    [
        ((20, 22, 24), NEAR, False),
        ((20, 22, 22.05), NEAR, False),  # one may be chance
        ((20, 22, 22.05, 22.1), NEAR, True),
        ((20, 22, 21, 22.01), NEAR, True),  # what falls and rises again has gained nothing
        ((20, 20, 20, 26.9), Target(psnr=28), False),
        ((20, 27), Target(psnr=28), True),  # a full training gains 1 dB at least
    ],
)
def test_is_growth_finished_after_rungs_without_gain(psnrs: tuple, target: Target, stops: bool):
    assert is_growth_finished(rungs(*psnrs), target) is stops


@pytest.mark.parametrize(
    ("psnrs", "target", "first"),
    [
        ((20, 27.8, 27.9, 28.0), NEAR, 1),
        ((20, 25, 28, 27.5), NEAR, 2),
        ((20, 25, 28), Target(psnr=24), 1),
        ((20, 25, 24), Target(psnr=30), 1),  # the best where none is enough
    ],
)
def test_choose_candidate_returns_smallest_sufficient(psnrs: tuple, target: Target, first: int):
    assert choose_candidate(rungs(*psnrs), target) == first


@pytest.mark.parametrize(
    ("psnrs", "target", "first", "full", "second"),
    [
        ((20, 27.8, 27.9, 28.0), NEAR, 1, 30.0, 3),  # candidate is below the best
        ((20, 25, 28), NEAR, 2, 30.0, None),  # the best itself
        ((25, 26, 27), Target(psnr=28), 2, 28.6, 1),  # 27.6 are expected, which may be wrong by half a dB
        ((25, 26, 27), Target(psnr=28), 2, 27.0, 3),
        ((25, 26, 27, 27), Target(psnr=28), 3, 27.0, None),  # there is no larger one
        # Bricks, 1500 steps: 32.2 are expected of rung 4, of the next smaller one 30.7.
        ((21.2, 23.4, 25.4, 27.4, 28.9, 29.7, 30.2), Target(psnr=31), 6, 33.5, 4),
    ],
)
def test_choose_neighbor_returns_rung_that_may_change_choice(
    psnrs: tuple, target: Target, first: int, full: float, second: int | None
):
    assert choose_neighbor(first, full, rungs(*psnrs), target, last=3) == second


@pytest.mark.parametrize(
    ("full", "target", "expected"),
    [
        ({1: 30.0, 3: 30.2}, NEAR, (1, True)),
        ({1: 30.0, 3: 31.0}, NEAR, (3, True)),
        ({2: 28.5, 1: 28.0}, Target(psnr=28), (1, True)),
        ({2: 27.0, 3: 27.5}, Target(psnr=28), (3, False)),
    ],
)
def test_choose_final_returns_smallest_sufficient(full: dict[int, float], target: Target, expected: tuple[int, bool]):
    assert choose_final({rung: RungResult(psnr, 1) for rung, psnr in full.items()}, target) == expected
