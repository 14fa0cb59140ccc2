"""When climbing stops, and which rung is enough."""

import pytest

from nerf_lightning.errors import InputError
from nerf_lightning.rightsize.choose import (
    Measured,
    Target,
    candidate,
    chosen,
    climbed_enough,
    expected,
    knee,
    next_to_train,
    worth,
)


def rungs(*psnrs: float) -> list[Measured]:
    """Rungs of twice the bytes each."""
    return [Measured(psnr, 1000 * 2**index) for index, psnr in enumerate(psnrs)]


NEAR = Target(within_db=0.3)


@pytest.mark.parametrize(
    ("given", "message"),
    [({}, "one of the two"), ({"psnr": 20.0, "within_db": 0.3}, "one of the two"), ({"within_db": -1}, "found -1")],
)
def test_a_target_is_one_of_two_and_not_negative(given: dict, message: str):
    with pytest.raises(InputError, match=message):
        Target(**given)


@pytest.mark.parametrize(
    ("gain", "times", "noise", "expected"),
    [(0.2, 2, 0.0, True), (0.05, 2, 0.0, False), (0.2, 8, 0.0, False), (0.2, 2, 0.3, False), (0.2, 0.5, 0.0, True)],
)
def test_a_rung_is_worth_its_bytes(gain: float, times: float, noise: float, expected: bool):
    before, after = Measured(20, 1000), Measured(20 + gain, int(1000 * times))
    assert worth(before, after, 0.3, noise) is expected


def test_climbing_goes_on_while_it_pays():
    assert not climbed_enough(rungs(20), NEAR, 0)
    assert not climbed_enough(rungs(20, 22, 24), NEAR, 0)
    assert not climbed_enough(rungs(20, 22, 22.05), NEAR, 0), "one may be chance"
    assert "gained less" in climbed_enough(rungs(20, 22, 22.05, 22.1), NEAR, 0)
    assert "gained less" in climbed_enough(rungs(20, 22, 22.5, 22.7), NEAR, noise=1.0)
    assert climbed_enough(rungs(20, 22, 21, 22.01), NEAR, 0), "what falls and rises again has gained nothing"


def test_climbing_stops_at_a_figure():
    assert not climbed_enough(rungs(20, 20, 20, 26.9), Target(psnr=28), 1)
    assert "near" in climbed_enough(rungs(20, 27), Target(psnr=28), 1), "a whole training brings 1 dB at the least"


def test_the_knee_is_where_more_bytes_begin_to_bring_less():
    assert knee(rungs(20, 26, 30, 30.5, 30.9, 31)) == 2
    assert knee(rungs(20, 26, 30, 30.5, 29)) == 2, "what comes after the best does not count"
    assert knee(rungs(20, 19, 18)) == 0
    assert knee(rungs(20)) == 0


def test_the_candidate_is_the_smallest_that_seems_enough():
    assert candidate(rungs(20, 27.8, 27.9, 28.0), NEAR) == 1
    assert candidate(rungs(20, 25, 28, 27.5), NEAR) == 2
    assert candidate(rungs(20, 25, 28), Target(psnr=24)) == 1
    assert candidate(rungs(20, 25, 24), Target(psnr=30)) == 1, "the best where none is"


def test_a_candidate_is_held_against_the_best():
    climbed = rungs(20, 27.8, 27.9, 28.0)

    def following(tried: dict[int, float], most: int = 3) -> int | None:
        return next_to_train(tried, climbed, NEAR, 5, most)

    assert following({}) == 1
    assert following({1: 30.0}) == 3
    assert following({1: 30.0, 3: 30.2}) is None, "near enough"
    assert following({1: 30.0, 3: 31.0}) == 2
    assert following({1: 30.0, 3: 31.0}, most=2) is None
    assert following({1: 30.0, 3: 31.0, 2: 30.8}, most=4) is None
    assert next_to_train({2: 30.0}, rungs(20, 25, 28), NEAR, 5, 3) is None, "the best itself"
    assert chosen({1: 30.0, 3: 30.2}, 3, NEAR) == 1
    assert chosen({1: 30.0, 3: 31.0}, 3, NEAR) == 3
    assert chosen({1: 30.0}, 3, NEAR) is None


def test_a_figure_is_met_by_a_rung_and_not_by_the_next_smaller():
    target, climbed = Target(psnr=28), rungs(25, 26, 27)

    def following(tried: dict[int, float], most: int = 3) -> int | None:
        return next_to_train(tried, climbed, target, 3, most)

    assert following({}) == 2
    assert following({2: 28.6}) == 1, "27.6 are expected, which may be wrong by half a dB"
    assert following({2: 28.4}) is None, "27.4 are expected"
    assert following({2: 28.6, 1: 27.0}) is None
    assert following({2: 28.6, 1: 28.6}) == 0
    assert following({2: 28.6, 1: 28.6, 0: 28.0}, most=9) is None
    assert following({2: 27.0}) == 3
    assert following({2: 27.0, 3: 27.5}) is None, "there is no larger one"
    assert following({2: 27.0, 3: 28.5}) is None
    assert chosen({2: 28.5, 1: 27.0}, 2, target) == 2
    assert chosen({2: 27.0, 3: 27.5}, 2, target) is None


def test_rungs_that_a_whole_training_makes_needless_are_skipped():
    """Bricks, 1500 steps: none of the rungs climbed to has 31 dB, trained in full even the fourth has."""
    target, climbed = Target(psnr=31), rungs(21.2, 23.4, 25.4, 27.4, 28.9, 29.7, 30.2)

    def following(tried: dict[int, float], most: int = 4) -> int | None:
        return next_to_train(tried, climbed, target, 7, most)

    assert following({}) == 6
    assert following({6: 33.5}) == 4, "32.2 are expected, of the next smaller one 30.7"
    assert following({6: 33.5, 4: 32.2}) == 3, "30.7 are expected"
    assert following({6: 33.5, 4: 30.9}) == 5, "what fails is not tried again, nor what is smaller"
    assert following({6: 33.5, 4: 32.2}, most=2) is None
    assert chosen({6: 33.5, 4: 32.2}, 6, target) == 4


def test_what_is_expected_of_a_rung_is_the_gain_of_the_nearest():
    assert expected(0, {2: 30.0, 1: 28.5}, rungs(26, 27, 28)) == pytest.approx(27.5)
    assert expected(1, {2: 30.0}, rungs(26, 27, 28)) == pytest.approx(29.0)
