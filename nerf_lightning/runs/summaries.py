"""Run summaries for tables and charts: tolerant of damaged runs, never executing their content."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeGuard

from nerf_lightning.errors import InputError
from nerf_lightning.utils.parsing import read_json, read_yaml

FINISHED = ("finished", "collapsed")
"""Status of completed runs."""
FIELD_PAGE = "field.html"
"""Web page of a run, in its folder."""


@dataclass(frozen=True)
class RunSummary:
    """Configuration, results and status of a run."""

    folder: Path
    config: dict[str, Any]
    """Resolved; empty if unreadable."""
    results: dict[str, Any]
    """Content of results.json; empty if missing or damaged."""
    status: str
    """As in results.json; "unfinished" without one; or "unreadable"."""
    diagnosis: str

    def get_option(self, key: str) -> Any:
        """The value at a dotted key of the configuration, or None."""
        node: Any = self.config
        for part in key.split("."):
            node = node.get(part) if isinstance(node, dict) else None
        return node

    def get_metric(self, key: str) -> float | None:
        """A finite number from the results, or None."""
        value = self.results.get(key)
        return float(value) if _is_finite(value) else None

    @property
    def psnr(self) -> float | None:
        return self.get_metric("psnr")

    @property
    def psnr_text(self) -> str:
        return "no figure" if self.psnr is None else f"{self.psnr:.2f} dB"

    @property
    def curve(self) -> list[tuple[float, float, float]]:
        """(training seconds, step, PSNR) of each finite point."""
        points = self.results.get("curve")
        triples = [p for p in points if isinstance(p, list) and len(p) == 3] if isinstance(points, list) else []
        return [(p[0], p[1], p[2]) for p in triples if all(map(_is_finite, p))]


def _is_finite(value: Any) -> TypeGuard[float]:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def read_run(folder: Path) -> RunSummary:
    """Summarizes a run folder; `status` and `diagnosis` say what is missing or damaged."""
    try:
        config = read_yaml(folder / "config.yaml", "a run's configuration in YAML")
    except InputError:  # reported by commands that open the run
        config = {}
    plain = config if isinstance(config, dict) else {}
    if not (folder / "results.json").exists():
        return RunSummary(folder, plain, {}, "unfinished", "no results.json yet")
    try:
        results = read_json(folder / "results.json", "figures", "train it again")
    except InputError as error:
        return RunSummary(folder, plain, {}, "unreadable", f"results.json: {error.problem}")
    if not isinstance(results, dict):
        return RunSummary(folder, plain, {}, "unreadable", f"results.json: a {type(results).__name__}, not a mapping")
    diagnosis = str(results.get("diagnosis") or "")
    return RunSummary(folder, plain, results, str(results.get("status") or "unreadable"), diagnosis)


def find_runs(root: Path) -> list[RunSummary]:
    """All runs in a folder and below it, sorted by path.

    Raises:
        InputError: the folder does not exist or holds no run.
    """
    if not root.is_dir():
        raise InputError(root, "", "no such folder", hint="look below outputs/")
    folders = {path.parent for name in ("results.json", "config.yaml") for path in root.rglob(name)}
    if not folders:
        raise InputError(root, "", "no run in it: no config.yaml or results.json")
    return [read_run(folder) for folder in sorted(folders)]


def flatten_config(config: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Flattens a nested configuration to dotted keys; lists stay whole."""
    pairs: dict[str, Any] = {}
    for key, value in config.items():
        name = f"{prefix}{key}"
        pairs |= flatten_config(value, f"{name}.") if isinstance(value, dict) else {name: value}
    return pairs


def find_varying_options(runs: Sequence[RunSummary]) -> list[str]:
    """Dotted keys of the options in which runs differ; `recipe` and `method` replace the options they set."""
    options = [flatten_config(run.config) for run in runs if run.config]
    common = [key for key in (options[0] if options else {}) if all(key in other for other in options)]
    keys = [key for key in common if any(other[key] != options[0][key] for other in options)]
    if "recipe" in keys and all(other["recipe"] for other in options):
        keys = [key for key in keys if key == "recipe" or not _is_set_by_recipe(key, options)]
    if "method" in keys:
        keys = [key for key in keys if not key.startswith("model.")]
    unique: dict[tuple[str, str], str] = {}
    for key in sorted(keys, key=lambda key: key.count(".")):  # dataset.seed only repeats seed
        unique.setdefault((key.rsplit(".", 1)[-1], str([other[key] for other in options])), key)
    return [key for key in keys if key in unique.values() and not key.endswith("_target_")]


def _is_set_by_recipe(key: str, options: Sequence[dict[str, Any]]) -> bool:
    """Whether runs of the same recipe share the value at `key`."""
    return len({(other["recipe"], str(other[key])) for other in options}) == len({other["recipe"] for other in options})
