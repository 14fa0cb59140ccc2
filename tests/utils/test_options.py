"""Options against the annotations of what takes them."""

import math
from typing import Annotated

import pytest

from nerf_lightning.errors import InputError
from nerf_lightning.model import HashGridField
from nerf_lightning.utils.options import Above, AtLeast, AtMost, Below, check_options


def target(
    seconds: float | None = None,
    steps: int = 1,
    colour: str | list[float] = "scene",
    share: Annotated[float, AtLeast(0), AtMost(1)] = 0.5,
    decay: Annotated[float, Above(0), Below(1)] = 0.5,
) -> None:
    """Takes options of the usual kinds."""


def test_check_options_takes_finite_numbers_within_bounds():
    check_options(
        "group", target, {"seconds": 3.4e38, "steps": 2**63 - 1, "colour": [0.5, 1], "share": 1, "decay": 0.9}
    )


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"seconds": math.nan}, "group.seconds: found nan, expected a number or null"),
        ({"colour": [math.inf]}, "group.colour"),
        ({"steps": 2**63}, "group.steps.*a whole number"),
        ({"steps": "many"}, "group.steps"),
        ({"share": 1.5}, "group.share: found 1.5, expected a number at least 0 and at most 1"),
        ({"decay": 1.0}, "group.decay: found 1.0, expected a number above 0 and below 1"),
        ({"step": 1}, "group.step: found an unknown option.*did you mean steps?"),
    ],
)
def test_check_options_refuses(options: dict, words: str):
    with pytest.raises(InputError, match=words):
        check_options("group", target, options)


def test_sizes_of_fields_have_an_upper_bound():
    with pytest.raises(InputError, match="at most"):
        check_options("model", HashGridField, {"log2_entries": 10**9}, given=["bounds"])
