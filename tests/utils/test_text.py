"""Lists, sentences, and text in pages."""

from pathlib import Path

import pytest

from nerf_lightning.utils.html import json_for_script, relative_url
from nerf_lightning.utils.text import join_truncated, subsample


@pytest.mark.parametrize(
    ("total", "count", "expected"),
    [(5, None, [0, 1, 2, 3, 4]), (3, 9, [0, 1, 2]), (9, 3, [1, 4, 7]), (10, 2, [2, 7]), (7, 1, [3]), (0, 3, [])],
)
def test_subsample_indices_are_evenly_spaced(total: int, count: int | None, expected: list[int]):
    assert subsample(total, count) == expected


def test_join_truncated_long_list_counts_the_rest():
    assert join_truncated(["a", "b", "c"], 2) == "a, b and 1 more" and join_truncated(["a"], 2) == "a"


def test_json_for_script_escapes_closing_tag():
    assert "</script>" not in json_for_script({"a": "</script>"})


def test_relative_url_special_characters_are_quoted():
    assert relative_url(Path("a/b"), Path("a/c d/ü.html")) == "../c%20d/%C3%BC.html"
