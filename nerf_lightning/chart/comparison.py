"""Runs of one setting against each other: what a row of the chart shows and says."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from nerf_lightning.chart.advice import advice
from nerf_lightning.chart.frontier import frontier, two_figures
from nerf_lightning.chart.notes import remarks
from nerf_lightning.chart.points import Point, points_of
from nerf_lightning.chart.references import Reference, matching, provenance
from nerf_lightning.chart.setting import Setting
from nerf_lightning.runs.index import Run


@dataclass(frozen=True)
class Cost:
    """What PSNR is charted against, a panel each."""

    name: str
    label: str
    of: Callable[[Point], float | None]


COSTS = (
    Cost("training", "training, seconds", lambda point: point.seconds),
    Cost("rendering", "rendering, seconds a view", lambda point: point.render),
)


@dataclass(frozen=True)
class Comparison:
    """The points of one setting."""

    setting: Setting
    points: list[Point]
    """By method, then by time."""
    frontiers: dict[str, list[int]]
    """By the name of the cost, which points no other beats, by rising cost."""
    advice: list[str]
    remarks: list[str]
    references: list[Reference]
    provenance: list[str]

    def on_frontier(self, number: int) -> list[str]:
        """The names of the costs by which a point is on the frontier."""
        return [name for name, chosen in self.frontiers.items() if number in chosen]


def compare(
    runs: Sequence[Run],
    references: Sequence[Reference],
    within_db: float,
    seconds: float,
    smallest_within_db: float,
) -> list[Comparison]:
    """One comparison for each setting, those with most points first. For the limits see `advice`."""
    settings: dict[Setting, list[Point]] = {}
    for point in points_of(runs):
        settings.setdefault(point.setting, []).append(point)
    compared = []
    for setting, found in settings.items():
        points = sorted(found, key=lambda point: (point.method, point.seconds))
        frontiers = {cost.name: _frontier(points, cost) for cost in COSTS}
        chosen = [points[number] for number in sorted({n for front in frontiers.values() for n in front})]
        known = matching(references, setting)
        said = advice(points, within_db, seconds, smallest_within_db)
        compared.append(Comparison(setting, points, frontiers, said, remarks(points, chosen), known, provenance(known)))
    return compared


def _frontier(points: Sequence[Point], cost: Cost) -> list[int]:
    """Among the points whose cost is known."""
    known = [(number, price) for number, point in enumerate(points) if (price := cost.of(point)) is not None]
    chosen = frontier([two_figures(price) for _, price in known], [points[number].psnr for number, _ in known])
    return [known[index][0] for index in chosen]
