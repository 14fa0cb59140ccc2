"""Bounds on options: what no number of them may be."""

import math
from typing import Annotated

import pytest

from nerf_lightning.callbacks import Budget
from nerf_lightning.errors import InputError
from nerf_lightning.model import HashGridField, MLPField
from nerf_lightning.utils.options import AtLeast, AtMost, check_options


def target(
    seconds: float | None = None,
    steps: int = 1,
    colour: str | list[float] = "scene",
    share: Annotated[float, AtLeast(0), AtMost(1)] = 0.5,
) -> None:
    """Takes options of the usual kinds."""


@pytest.mark.parametrize(
    "good", [{"seconds": 3.4e38}, {"seconds": -3}, {"steps": 2**63 - 1}, {"colour": [0.5, 1, -1e-320]}, {"share": 1}]
)
def test_finite_numbers_within_bounds_fit(good: dict):
    check_options("group", target, good)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 3.5e38, -1e300, 10**400])
@pytest.mark.parametrize(("name", "wrap"), [("seconds", False), ("colour", True), ("share", False)])
def test_numbers_that_single_precision_does_not_hold_do_not_fit(value: float, name: str, wrap: bool):
    with pytest.raises(InputError, match=f"config: group.{name}: found") as caught:
        check_options("group", target, {name: [value] if wrap else value})
    assert wrap or "numbers are finite" in str(caught.value)


@pytest.mark.parametrize("value", [2**63, -(2**64), 10**400])
def test_whole_numbers_beyond_64_bits_do_not_fit(value: int):
    with pytest.raises(
        InputError, match=r"config: group.steps: found .*, expected a whole number; .* at most 9.22e\+18"
    ):
        check_options("group", target, {"steps": value})


def test_an_upper_bound_is_told():
    with pytest.raises(InputError, match=r"share: found 1.5, expected a number at least 0 and at most 1$"):
        check_options("group", target, {"share": 1.5})


@pytest.mark.parametrize(
    ("field", "options"),
    [
        (HashGridField, {"levels": 10**9}),
        (HashGridField, {"log2_entries": 10**9}),
        (HashGridField, {"finest": 2**20 + 1}),
        (MLPField, {"depth": 10**9}),
        (MLPField, {"position_frequencies": 128}),
    ],
)
def test_parts_that_are_made_one_by_one_have_an_upper_bound(field: type, options: dict):
    with pytest.raises(InputError, match="at most"):
        check_options("model", field, options, given=["bounds"])


@pytest.mark.parametrize("key", ["seconds", "patience"])
@pytest.mark.parametrize("value", [0, math.nan, math.inf])
def test_a_budget_is_finite(key: str, value: float):
    with pytest.raises(InputError, match=f"budget.{key}: found {value}, expected more than 0"):
        Budget(**{"steps": 1, key: value})
