"""Aggregation of runs over seeds: one point (table row) per configuration."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from nerf_lightning.errors import InputError
from nerf_lightning.runs.summaries import RunSummary, flatten_config
from nerf_lightning.utils.machine import background_load
from nerf_lightning.utils.parsing import read_yaml

COSTS = {"train_seconds": "training time, s", "render_seconds": "rendering time, s per view", "bytes": "size"}
"""Cost columns and their axis labels."""
IGNORED_OPTIONS = ("callbacks", "logger", "resume", "name", "method", "recipe", "threads", "device")
"""Options that do not affect training, or that repeat others."""
IGNORED_NAMES = ("seed", "path", "folder", "url", "download", "accelerator")
"""Last key parts of options that differ between runs of one configuration, or belong to the conditions."""
BACKGROUNDS = {"[0.0, 0.0, 0.0]": "black background", "[1.0, 1.0, 1.0]": "white background"}
PUBLISHED_FILE = Path(__file__).with_name("published.yaml")
"""Published results, for comparison; never measured here."""
YAML_FORMAT = "publications as in published.yaml: source, hardware, conditions, scenes: {SCENE: {METHOD: [dB, s]}}"


class Conditions(NamedTuple):
    """Conditions that runs must share to be comparable."""

    scene: str
    resolution: str
    views: str
    """Empty for an image."""
    background: str
    machine: str
    fingerprint: str
    """Prefix of the SHA-256 of the images and their split."""


def get_conditions(run: RunSummary) -> Conditions:
    """The conditions of a run, from its results.json."""
    parts = (run.results.get("scene"), run.results.get("machine"))
    scene, machine = (part if isinstance(part, dict) else {} for part in parts)
    size, views, background = scene.get("resolution"), scene.get("views"), run.results.get("background")
    counts = [views.get(split) for split in ("train", "val")] if isinstance(views, dict) else []
    kind, chip = str(run.results.get("device")).partition(":")[0], machine.get("processor", "unknown processor")
    count = run.results.get("threads")
    threads = f"{count} {'thread' if count == 1 else 'threads'} on {machine.get('cores')} cores"
    return Conditions(
        scene=str(scene.get("name") or "unknown scene"),
        resolution="x".join(map(str, size)) if isinstance(size, list) else "unknown resolution",
        views="{} training and {} held-out views".format(*counts) if counts and counts != [1, 1] else "",
        background="" if background is None else BACKGROUNDS.get(str(background), f"background {background}"),
        machine=f"{chip}, {threads}" if kind == "cpu" else f"{machine.get('accelerator') or chip} ({kind})",
        fingerprint=str(scene.get("sha256") or "")[:8],
    )


def compute_points(runs: Sequence[RunSummary]) -> list[tuple[Conditions, pd.DataFrame]]:
    """Aggregates runs by conditions and configuration; largest groups first.

    Columns: label, method, psnr (dB, median over runs; -inf for collapsed ones), psnr_min, psnr_max, the medians of
    train_seconds, render_seconds and bytes (NaN if unknown), collapsed (count), background_load (see `utils/machine`),
    options, runs, and frontier (costs). Sorted by descending PSNR. Configurations with half or more of their runs collapsed,
    and runs without metrics, are left out.
    """
    table = pd.DataFrame([make_record(run) for run in runs if has_metrics(run)])
    groups = []
    for conditions, group in table.groupby("conditions") if len(table) else ():
        points = group.groupby("key", sort=False).agg(
            label=("label", "first"),
            method=("method", "first"),
            psnr=("psnr", "median"),
            psnr_min=("psnr", "min"),
            psnr_max=("psnr", "max"),
            **{cost: (cost, "median") for cost in COSTS},
            collapsed=("psnr", lambda psnr: int(np.isneginf(psnr).sum())),
            background_load=("background_load", "max"),
            options=("options", "first"),
            runs=("run", list),
        )
        points = points[np.isfinite(points["psnr"])].sort_values(["psnr", "train_seconds"], ascending=[False, True])
        if len(points):
            points = points.reset_index(drop=True).assign(label=name_points(points))
            fronts = {cost: find_frontier(points[cost].map(round_cost), points["psnr"]) for cost in COSTS}
            points["frontier"] = [" ".join(cost for cost in COSTS if i in fronts[cost]) for i in points.index]
            groups.append((Conditions(*conditions), points))
    return sorted(groups, key=lambda pair: -len(pair[1]))


def has_metrics(run: RunSummary) -> bool:
    """Whether a run has PSNR and training time."""
    return run.psnr is not None and (run.get_metric("train_seconds") or 0) > 0


def make_record(run: RunSummary) -> dict[str, Any]:
    """A run as a table row."""
    method, options = str(run.results.get("method") or run.get_option("method")), collect_options(run)
    return {
        "run": run,
        "conditions": get_conditions(run),
        "key": f"{method} {options}",
        "label": str(run.get_option("recipe") or method),
        "method": method,
        "psnr": -np.inf if run.status == "collapsed" else run.psnr,
        "train_seconds": run.get_metric("train_seconds"),
        "render_seconds": run.get_metric("render_seconds_per_view") or np.nan,
        "bytes": run.get_metric("artifact_bytes") or np.nan,
        "background_load": background_load(run.results),
        "options": options,
    }


def collect_options(run: RunSummary) -> dict[str, Any]:
    """Options that affect a run's result, by dotted key; its folder if they are unreadable."""
    flat = flatten_config({key: value for key, value in run.config.items() if key not in IGNORED_OPTIONS})
    options = {key: value for key, value in flat.items() if key.rpartition(".")[2] not in IGNORED_NAMES}
    return options or {"folder": str(run.folder)}


def name_points(points: pd.DataFrame) -> list[str]:
    """Labels: recipe or method, then the options that distinguish it from others of that name."""
    names = []
    for label, mine in zip(points["label"], points["options"], strict=True):
        alike = points.loc[points["label"] == label, "options"]
        varying = [key for key in mine if any(other.get(key) != mine[key] for other in alike)]
        shown = [key for key in varying if mine[key] is not None and not key.endswith("_target_")]
        names.append(", ".join([label, *(f"{key.rsplit('.', 1)[-1]} {mine[key]}" for key in shown)]))
    return names


def round_cost(value: float) -> float:
    """Rounds a cost to two significant figures, below which timings are noise."""
    return float(f"{value:.1e}")


def find_frontier(costs: pd.Series, gains: pd.Series) -> pd.Index:
    """The Pareto frontier: indices of points that no other dominates, by rising cost.

    Includes ties; excludes points of unknown cost.
    """
    table = pd.DataFrame({"cost": costs, "gain": gains}).dropna().sort_values(["cost", "gain"], ascending=[True, False])
    best_so_far = table["gain"] == table["gain"].cummax()
    cheapest = table["cost"] == table.groupby("gain")["cost"].transform("min")
    return table.index[best_so_far & cheapest]


def find_median_run(point: Any) -> RunSummary:
    """The run whose PSNR is closest to a point's median."""
    return min(point.runs, key=lambda run: abs(run.psnr - point.psnr))


def format_bytes(size: float) -> str:
    return f"{size / 1e6:.3g} MB" if size >= 1e6 else f"{size / 1e3:.0f} kB"


def read_references(file: Path) -> pd.DataFrame:
    """Reads a YAML file of publications into rows of name, psnr, seconds (of training), scene and origin.

    Raises:
        InputError: an unreadable file, or a missing or invalid value.
    """
    publications, rows = read_yaml(file, YAML_FORMAT), []
    try:
        for entry in publications.values():
            origin = f"{entry['conditions']}; {entry['hardware']}; {entry['source']}"
            for scene, methods in entry["scenes"].items():
                for name, (psnr, seconds) in methods.items():
                    if not (0 < psnr < np.inf and 0 < seconds < np.inf):
                        raise ValueError(f"{name}: {psnr} dB, {seconds} s")
                    rows.append((str(name), psnr, seconds, str(scene), origin))
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise InputError(file, "", f"no references ({type(error).__name__}: {error})", hint=YAML_FORMAT) from error
    return pd.DataFrame(rows, columns=["name", "psnr", "seconds", "scene", "origin"])
