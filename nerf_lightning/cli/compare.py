"""nerf_lightning compare."""

from pathlib import Path
from typing import Annotated, Any

from nerf_lightning.cli.command import Output, command
from nerf_lightning.utils.option_checks import Ge


@command
def compare(
    *runs: Path,
    seconds: Annotated[float, Ge(0)] = 15.0,
    within_db: Annotated[float, Ge(0)] = 0.5,
    references: str = "published",
    output: Output = None,
) -> Any:
    """Compare runs by quality, time and size: an HTML page, a figure, a table and recommendations.

    Medians over seeds, grouped by scene and machine. `train +experiment=pareto` makes runs to compare.

    Args:
        runs: Folders to search for runs; default: outputs/.
        seconds: Also recommend the best within this training time.
        within_db: Allowed distance of the fastest and the smallest from the best, dB.
        references: Published results of the same scene: published, none, or a YAML file.
        output: Folder for compare.html, compare.png and compare.csv; default: compare/ in the first folder.

    Returns:
        The pandas.DataFrame that compare.csv holds.

    Raises:
        InputError: a missing folder, no runs, or invalid references.
    """
    from nerf_lightning.comparison.points import PUBLISHED_FILE, read_references
    from nerf_lightning.comparison.report import write_comparison
    from nerf_lightning.runs.find import OUTPUT_ROOT
    from nerf_lightning.runs.summaries import find_runs
    from nerf_lightning.utils.files import check_output_path, expand_user_path

    folders = [expand_user_path(folder) for folder in runs] or [OUTPUT_ROOT]
    folder = folders[0] / "compare" if output is None else check_output_path(output)
    file = PUBLISHED_FILE if references in ("published", "none") else expand_user_path(references)
    published = read_references(file)
    published = published.head(0) if references == "none" else published
    summaries = {run.folder.resolve(): run for folder in folders for run in find_runs(folder)}
    return write_comparison(list(summaries.values()), folder, published, within_db, seconds)
