"""Runs of one configuration, over their seeds, as one point of the chart."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any

from nerf_lightning.chart.setting import Setting, setting_of
from nerf_lightning.runs.index import Run, flat

ELSEWHERE = ("callbacks", "logger", "resume", "name", "method", "recipe", "threads", "device")
"""Options that do not change what is trained, or that repeat others."""
PLACES = ("seed", "path", "folder", "url", "download", "accelerator")
"""Last parts of options that differ between runs of one configuration, or belong to the setting."""
MOST, MOST_DB = 1e15, 1e3
"""Larger figures are nonsense: bytes or seconds, and dB."""


@dataclass(frozen=True)
class Point:
    """What one configuration reached: medians over its seeds, where one that was lost counts as the worst."""

    label: str
    method: str
    setting: Setting
    configuration: dict[str, Any]
    """All options that shape the result, with dotted keys."""
    runs: tuple[Run, ...]
    psnr: float
    """dB, held out."""
    worst: float
    """dB of the worst seed; minus infinity where one has no figure."""
    best: float
    seconds: float
    """Of training."""
    render: float | None
    """Seconds a view."""
    size: float | None
    """Bytes of the artifact."""

    @property
    def seeds(self) -> int:
        return len({str(run.results.get("seed", run.option("seed"))) for run in self.runs})

    @property
    def lost(self) -> int:
        """Runs that collapsed or have no figure."""
        return sum(map(_lost, self.runs))

    @property
    def typical(self) -> Run:
        """The run nearest to the median."""
        return min((run for run in self.runs if run.psnr is not None), key=lambda run: abs(run.psnr - self.psnr))  # type: ignore[operator]


def configuration_of(run: Run) -> dict[str, Any]:
    """The options that shape a run's result; the folder stands for them where they cannot be read."""
    if not run.config:
        return {"folder": str(run.folder)}
    plain = {key: value for key, value in run.config.items() if key not in ELSEWHERE}
    plain["budget"] = budget_of(run)
    return {key: value for key, value in flat(plain).items() if key.rsplit(".", 1)[-1] not in PLACES}


def budget_of(run: Run) -> str:
    """What ended a run's training, in words."""
    default = run.option("budget.default")
    limits = {unit: run.option(f"budget.{unit}") for unit in ("seconds", "steps")}
    if not any(limits.values()) and isinstance(default, dict):
        limits = {unit: default.get(unit) for unit in limits}
    unit = {"seconds": "s", "steps": "steps"}
    return ", ".join(f"{value:g} {unit[key]}" for key, value in limits.items() if isinstance(value, int | float))


def points_of(runs: Iterable[Run]) -> list[Point]:
    """All points, those of one setting together, settings with most points first.

    A configuration of which half of the runs or more were lost makes no point.
    """
    settings: dict[Setting, dict[str, list[Run]]] = {}
    lost: list[Run] = []
    for run in runs:
        if not _charted(run):
            lost.append(run)
        else:
            settings.setdefault(setting_of(run), {}).setdefault(_key(run), []).append(run)
    for run in lost:  # a failed seed weakens its configuration, if only one setting has that
        owners = [groups[_key(run)] for groups in settings.values() if _key(run) in groups]
        if len(owners) == 1 and run.status == "failed":
            owners[0].append(run)
    points = []
    for setting in sorted(settings, key=lambda one: (-len(settings[one]), one.words())):
        groups = list(settings[setting].values())
        for label, group in zip(labels([group[0] for group in groups]), groups, strict=True):
            point = _point(label, setting, group)
            if point is not None:
                points.append(point)
    return points


def _key(run: Run) -> str:
    return f"{kind_of(run)} {configuration_of(run)}"


def kind_of(run: Run) -> str:
    """The method, as the run itself calls it."""
    return str(run.results.get("method") or run.option("method") or "unknown")


def _charted(run: Run) -> bool:
    """Whether a run has figures that can be."""
    return run.psnr is not None and abs(run.psnr) < MOST_DB and 0 < (run.figure("train_seconds") or 0) < MOST


def _lost(run: Run) -> bool:
    return not _charted(run) or run.status == "collapsed"


def _point(label: str, setting: Setting, runs: Sequence[Run]) -> Point | None:
    """None where half of the runs or more were lost."""

    def middle(key: str) -> float | None:
        known = [value for value in (run.figure(key) for run in runs) if value is not None and 0 < value < MOST]
        return median(known) if known else None

    quality = [run.psnr if _charted(run) and run.psnr is not None else -math.inf for run in runs]
    typical = median(-math.inf if _lost(run) else value for run, value in zip(runs, quality, strict=True))
    seconds = middle("train_seconds")
    if seconds is None or typical == -math.inf:
        return None
    return Point(
        label=label,
        method=kind_of(runs[0]),
        setting=setting,
        configuration=configuration_of(runs[0]),
        runs=tuple(runs),
        psnr=typical,
        worst=min(quality),
        best=max(quality),
        seconds=seconds,
        render=middle("render_seconds_per_view"),
        size=middle("artifact_bytes"),
    )


def labels(runs: Sequence[Run]) -> list[str]:
    """A short name for each of several configurations: its recipe or method, its budget, and what else sets it apart."""
    heads = [str(run.option("recipe") or kind_of(run)) for run in runs]
    told = []
    for run, head in zip(runs, heads, strict=True):
        alike = [configuration_of(other) for other, name in zip(runs, heads, strict=True) if name == head]
        mine = configuration_of(run)
        apart = [key for key in mine if any(other.get(key) != mine[key] for other in alike) and key != "budget"]
        options = [f"{key.rsplit('.', 1)[-1]} {_text(mine[key])}" for key in apart if not key.endswith("_target_")]
        told.append(", ".join(filter(None, [head, *options, str(mine.get("budget", ""))])))
    return told


def _text(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
