"""The Pareto frontier against its definition."""

import itertools
import random

import pytest

from nerf_lightning.chart.frontier import frontier, two_figures


def by_definition(costs: list[float], gains: list[float]) -> set[int]:
    """Every point to which no other is at least equal in both and better in one."""
    points = list(zip(costs, gains, strict=True))
    return {
        i
        for i, (cost, gain) in enumerate(points)
        if not any(c <= cost and g >= gain and (c < cost or g > gain) for c, g in points)
    }


def test_every_arrangement_of_few_points():
    """Ties in one respect, in the other and in both: all sets of four points on a 3 x 3 grid."""
    for points in itertools.product(itertools.product((1.0, 2.0, 3.0), (20.0, 21.0, 22.0)), repeat=4):
        costs, gains = ([point[k] for point in points] for k in (0, 1))
        found = frontier(costs, gains)
        assert set(found) == by_definition(costs, gains) and len(found) == len(set(found))
        assert [costs[i] for i in found] == sorted(costs[i] for i in found)


def test_many_points_with_ties():
    chance = random.Random(0)
    for _ in range(50):
        costs = [float(chance.randint(1, 12)) for _ in range(40)]
        gains = [float(chance.randint(1, 12)) for _ in range(40)]
        assert set(frontier(costs, gains)) == by_definition(costs, gains)


def test_an_example():
    costs, gains = [5.0, 5.0, 15.0, 15.0, 60.0], [25.0, 27.0, 27.0, 30.0, 29.0]
    assert frontier(costs, gains) == [1, 3]
    assert frontier([], []) == []


@pytest.mark.parametrize(
    ("value", "rounded"), [(5.01, 5.0), (5.03, 5.0), (0.0487, 0.049), (60.2, 60.0), (123.0, 120.0)]
)
def test_costs_count_to_two_figures(value: float, rounded: float):
    assert two_figures(value) == rounded
