"""Lists, sentences, and text in pages."""

from pathlib import Path

import pytest

from nerf_lightning.utils.html import address_from, script_data
from nerf_lightning.utils.text import join_truncated, subsample


@pytest.mark.parametrize(
    ("total", "count", "expected"),
    [(5, None, [0, 1, 2, 3, 4]), (3, 9, [0, 1, 2]), (9, 3, [1, 4, 7]), (10, 2, [2, 7]), (7, 1, [3]), (0, 3, [])],
)
def test_subsample_spaces_indices_evenly(total: int, count: int | None, expected: list[int]):
    assert subsample(total, count) == expected


def test_join_truncated_counts_the_rest():
    assert join_truncated(["a", "b", "c"], 2) == "a, b and 1 more" and join_truncated(["a"], 2) == "a"


def test_script_data_cannot_end_its_element():
    assert "</script>" not in script_data({"a": "</script>"})


def test_address_from_quotes_names():
    assert address_from(Path("a/b"), Path("a/c d/ü.html")) == "../c%20d/%C3%BC.html"
