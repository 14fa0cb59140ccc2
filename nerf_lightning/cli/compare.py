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
    """Compare runs: which method is worth its time and bytes, as a page, a figure, a table and advice in words.

    Medians over seeds; runs of other scenes or machines stand apart. `train +experiment=pareto` makes runs to compare.

    Args:
        runs: Folders with runs in them or below them; default: outputs/.
        seconds: Name the best after this much training, too.
        within_db: How near to the best the fastest and the smallest must be, dB.
        references: Published figures of the same scene: published, none, or a YAML file of your own.
        output: Folder for compare.html, compare.png and compare.csv; default: compare/ in the first folder.

    Returns:
        The pandas.DataFrame that compare.csv holds.

    Raises:
        InputError: for a folder that is not there or holds no run, and for references that cannot be read.
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
    found = {run.folder.resolve(): run for folder in folders for run in find_runs(folder)}
    return write_comparison(list(found.values()), folder, published, within_db, seconds)
