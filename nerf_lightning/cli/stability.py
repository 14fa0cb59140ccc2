"""nerf_lightning stability."""

from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter

from nerf_lightning.cli.command import command
from nerf_lightning.errors import InputError
from nerf_lightning.utils.option_checks import Ge, Le


@command
def stability(
    *,
    suite: Literal["quick", "full"] = "quick",
    methods: Annotated[list[str] | None, Parameter(consume_multiple=True)] = None,
    seeds: Annotated[int, Ge(1), Le(1000)] = 8,
    steps: Annotated[int, Ge(1)] = 300,
    workers: Annotated[int, Ge(1)] | None = None,
    output: Annotated[Path, Parameter(alias="-o")] = Path("outputs/stability"),
) -> dict[str, Any]:
    """Train methods on small scenes under adverse conditions, and report which fail.

    Writes heatmap.png, heatmap_2d.png, worst.png and stability.json. If interrupted, the same command continues.

    Args:
        suite: quick (a few conditions, 15 minutes) or full (all, one to two hours).
        methods: Names in conf/stability.yaml, such as hashgrid "2D mlp"; default: all, with controls that must fail.
        seeds: Seeds per condition and method.
        steps: Steps per training.
        workers: Parallel trainings, of one thread each; default: one per core.
        output: Folder for all files.

    Returns:
        The content of stability.json: `suite`, `summary` in sentences, and `cells` (a result per training).

    Raises:
        InputError: an unknown method, or another process writes into the folder.
    """
    from nerf_lightning.runs.run_lock import lock_folder
    from nerf_lightning.stability.conditions import CONDITIONS, METHODS
    from nerf_lightning.stability.report import write_report
    from nerf_lightning.stability.trial import list_trials, run_trials
    from nerf_lightning.utils.files import check_output_path
    from nerf_lightning.utils.machine import available_cores
    from nerf_lightning.utils.progress import track_progress

    chosen = list(METHODS) if methods is None else methods
    unknown = [name for name in chosen if name not in METHODS]
    if unknown or not chosen:
        raise InputError("stability", "methods", ", ".join(unknown) or "none", f"some of {', '.join(METHODS)}")
    conditions = [condition.name for condition in CONDITIONS.values() if suite == "full" or condition.quick]
    trials, root = list_trials(conditions, chosen, seeds, steps), check_output_path(output)
    with lock_folder(root):
        done = run_trials(trials, root, min(workers or available_cores(), len(trials)))
        return write_report(list(track_progress(done, len(trials), "trainings")), suite, root)
