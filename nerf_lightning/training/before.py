"""What a folder holds of a run with the same configuration, so that a sweep or a search goes on where it was stopped."""

from pathlib import Path

from omegaconf import DictConfig

from nerf_lightning.errors import InputError
from nerf_lightning.runs.checkpoint import RESUMED, read_checkpoint
from nerf_lightning.runs.folder import plain_config
from nerf_lightning.runs.index import FINISHED, Run


def left_of(run: Run, cfg: DictConfig) -> tuple[Run | None, Path | None]:
    """What there is of a run, if it has this configuration.

    Returns:
        The run, if it is finished; otherwise its last checkpoint, if there is one to go on from.
    """
    if run.config != plain_config(cfg):
        return None, None
    if run.status in FINISHED:
        return run, None
    last = run.folder / "checkpoints" / "last.ckpt"
    try:
        read_checkpoint(last, RESUMED)
    except InputError:  # none yet, or a broken one: from the start
        return None, None
    return None, last
