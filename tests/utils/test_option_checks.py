"""Options against the annotations of what takes them."""

import math
from typing import Annotated

import pytest

from nerf_lightning.errors import InputError
from nerf_lightning.model import HashGridField
from nerf_lightning.utils.option_checks import Ge, Gt, Le, Lt, check_options


def target(
    seconds: float | None = None, steps: int = 1, color: str | list[float] = "scene",
    share: Annotated[float, Ge(0), Le(1)] = 0.5, decay: Annotated[float, Gt(0), Lt(1)] = 0.5,
) -> None:  # fmt: skip
    """Takes options of the usual kinds."""


def test_check_options_finite_numbers_within_bounds_pass():
    check_options("group", target, {"seconds": 3.4e38, "steps": 2**63 - 1, "color": [0.5, 1], "share": 1, "decay": 0.9})


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"seconds": math.nan}, "group.seconds: found nan, expected a number or null"),
        ({"color": [math.inf]}, "group.color"),
        ({"steps": 2**63}, "group.steps.*a whole number"),
        ({"steps": "many"}, "group.steps"),
        ({"share": 1.5}, "group.share: found 1.5, expected a number at least 0 and at most 1"),
        ({"decay": 1.0}, "group.decay: found 1.0, expected a number above 0 and below 1"),
        ({"step": 1}, "group.step: found an unknown option.*did you mean steps?"),
    ],
)
def test_check_options_wrong_option_raises(options: dict, words: str):
    with pytest.raises(InputError, match=words):
        check_options("group", target, options)


def test_check_options_field_size_above_bound_raises():
    with pytest.raises(InputError, match="at most"):
        check_options("model", HashGridField, {"log2_hashmap_size": 10**9}, bound_arguments=["bounds"])
