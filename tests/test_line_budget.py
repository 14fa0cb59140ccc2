"""The lines that CONTRIBUTING.md grants."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
ROWS = re.findall(r"^\| `(\w+)/` \| ([\d,]+) \|$", (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8"), re.MULTILINE)


def test_line_budget_names_all_folders():
    assert [folder for folder, _ in ROWS] == ["nerf_lightning", "benchmarks", "tests"]


@pytest.mark.parametrize(("folder", "budget"), ROWS)
def test_line_budget_of_folder_is_kept(folder: str, budget: str):
    lines = sum(len(file.read_bytes().splitlines()) for file in (ROOT / folder).rglob("*.py"))
    assert lines <= int(budget.replace(",", "")), f"{folder}: {lines} lines, {budget} at most: see CONTRIBUTING.md"
