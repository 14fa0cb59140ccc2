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
    """Train methods on small scenes made to be hard, and say which broke down.

    Leaves heatmap.png, heatmap_2d.png, worst.png and stability.json. The same command continues where it stopped.

    Args:
        suite: quick: a few conditions, a quarter of an hour; full: all of them, in an hour or two.
        methods: Some of those in conf/stability.yaml, such as hashgrid "2D mlp"; default: all, with controls that must fail.
        seeds: Trainings of each condition and method.
        steps: Of each training.
        workers: Trainings at a time, of one thread each; default: one a core.
        output: Folder for all of it.

    Returns:
        What stability.json holds: `suite`, `summary` in sentences, and `cells` (an outcome for each training).

    Raises:
        InputError: where a method is not known, or another process writes into the folder.
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
    conditions = [one.name for one in CONDITIONS.values() if suite == "full" or one.quick]
    trials, root = list_trials(conditions, chosen, seeds, steps), check_output_path(output)
    with lock_folder(root):
        done = run_trials(trials, root, min(workers or available_cores(), len(trials)))
        return write_report(list(track_progress(done, len(trials), "trainings")), suite, root)
