"""The chart as a table: a CSV, the terminal, and TensorBoard's HParams tab."""

import csv
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from nerf_lightning.chart.advice import in_bytes
from nerf_lightning.chart.comparison import Comparison
from nerf_lightning.config.resolvers import slug
from nerf_lightning.runs.index import Run
from nerf_lightning.utils.files import atomic, atomic_folder

FIGURES = ("psnr", "psnr_worst_seed", "psnr_best_seed", "train_seconds", "render_seconds_per_view", "artifact_bytes")
CAPTION = "train, view: seconds; runs -n: n of them lost; best: on the frontier of T(raining) or R(endering)"


def rows_of(comparisons: Sequence[Comparison]) -> list[dict[str, Any]]:
    """A row for each point, in the order of the chart."""
    rows = []
    for one in comparisons:
        setting = vars(one.setting)
        for number, point in enumerate(one.points):
            figures = (point.psnr, point.worst, point.best, point.seconds, point.render, point.size)
            known = [None if value is None or math.isinf(value) else value for value in figures]
            rows.append(
                {
                    "point": point.label,
                    "method": point.method,
                    **dict(zip(FIGURES, known, strict=True)),
                    "seeds": point.seeds,
                    "runs": len(point.runs),
                    "lost": point.lost,
                    "frontier": " ".join(one.on_frontier(number)),
                    **setting,
                    "folders": ";".join(str(run.folder) for run in point.runs),
                }
            )
    return rows


def write_csv(path: Path, comparisons: Sequence[Comparison], left_out: Sequence[Run]) -> None:
    """A line for each point; then one for each run that is in none, with its status and diagnosis."""
    rows = rows_of(comparisons)
    columns = [*(rows[0] if rows else ("point", "folders")), "status", "diagnosis"]
    with atomic(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns)
        writer.writeheader()
        writer.writerows({**row, "status": "charted"} for row in rows)
        for run in left_out:
            told = {"point": run.folder.name, "folders": str(run.folder)}
            writer.writerow({**told, "status": run.status, "diagnosis": run.diagnosis})


def print_tables(comparisons: Sequence[Comparison], troubles: Sequence[str]) -> None:
    """The same on the terminal: a table for each setting, with its advice and warnings."""
    console = Console(highlight=False)
    for one in comparisons:
        table = Table(title=escape(one.setting.words()), box=None, caption=CAPTION)
        table.add_column("point", overflow="fold")
        for heading in ("dB", "worst", "runs", "train", "view", "bytes"):
            table.add_column(heading, justify="right", no_wrap=True)
        table.add_column("best")
        for number in sorted(range(len(one.points)), key=lambda number: -one.points[number].psnr):
            point = one.points[number]
            figures = [f"{point.psnr:.2f}", "lost" if math.isinf(point.worst) else f"{point.worst:.2f}"]
            figures += [f"{len(point.runs)}" + (f" -{point.lost}" if point.lost else ""), f"{point.seconds:.3g}"]
            figures += ["-" if point.render is None else f"{point.render:.2g}", in_bytes(point.size or 0)]
            table.add_row(escape(point.label), *figures, " ".join(name[0].upper() for name in one.on_frontier(number)))
        console.print(table)
        for text in (*one.advice, *one.remarks, *one.provenance):
            console.print(text, markup=False, soft_wrap=True)
    for text in troubles:
        console.print(text, style="red", markup=False, soft_wrap=True)


def write_hparams(folder: Path, comparisons: Sequence[Comparison]) -> None:
    """The table as event files: a session for each point. What stood in the folder before is replaced."""
    from torch.utils.tensorboard import SummaryWriter

    with atomic_folder(folder) as temporary, SummaryWriter(str(temporary)) as writer:
        for number, row in enumerate(rows_of(comparisons)):
            told = {key: value for key, value in row.items() if key not in (*FIGURES, "folders")}
            measured = {f"chart/{key}": row[key] for key in FIGURES if row[key] is not None}
            writer.add_hparams(told, measured, run_name=f"{number:03d}_{slug(row['point'])}")
