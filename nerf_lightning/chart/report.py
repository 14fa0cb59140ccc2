"""Everything a chart leaves behind."""

import io
from collections.abc import Sequence
from pathlib import Path

import matplotlib
from matplotlib.figure import Figure

from nerf_lightning.chart.comparison import compare
from nerf_lightning.chart.figure import chart_figure
from nerf_lightning.chart.notes import troubles
from nerf_lightning.chart.page import chart_page
from nerf_lightning.chart.references import Reference
from nerf_lightning.chart.table import print_tables, write_csv, write_hparams
from nerf_lightning.drawing.ink import pixels_of
from nerf_lightning.drawing.panels import write_png
from nerf_lightning.runs.index import Run
from nerf_lightning.utils.files import atomic


def write_report(
    runs: Sequence[Run], references: Sequence[Reference], limits: tuple[float, float, float], output: Path
) -> None:
    """Compares runs, writes chart.png, .svg, .html, .csv and tensorboard/ into a folder, and prints the table.

    Args:
        runs: all that were found, the broken ones too.
        references: published figures.
        limits: within_db, seconds and smallest_within_db of `advice`.
        output: the folder.
    """
    comparisons = compare(runs, references, *limits)
    charted = {run.folder for one in comparisons for point in one.points for run in point.runs}
    bad = troubles(runs)
    figure = chart_figure(comparisons, bad)
    write_png(output / "chart.png", pixels_of(figure))
    svg = as_svg(figure)
    for name, text in (("chart.svg", svg), ("chart.html", chart_page(svg, comparisons, output))):
        with atomic(output / name) as temporary:
            temporary.write_text(text, encoding="utf-8")
    write_csv(output / "chart.csv", comparisons, [run for run in runs if run.folder not in charted])
    write_hparams(output / "tensorboard", comparisons)
    print_tables(comparisons, bad)
    print(f"chart: {output}/chart.html (also .png, .svg, .csv); tensorboard --logdir {output}/tensorboard")


def as_svg(figure: Figure) -> str:
    """A figure as SVG, the same text for the same figure."""
    buffer = io.StringIO()
    with matplotlib.rc_context({"svg.hashsalt": "nerf_lightning"}):
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    return buffer.getvalue()
