"""What a folder holds of a run with the same configuration, so that a sweep or a search continues where it was stopped."""

from pathlib import Path

from omegaconf import DictConfig

from nerf_lightning.errors import InputError
from nerf_lightning.runs.checkpoint import RESUME_KEYS, read_checkpoint
from nerf_lightning.runs.folder import plain_config
from nerf_lightning.runs.index import FINISHED, Run


def left_of(run: Run, cfg: DictConfig) -> tuple[Run | None, Path | None]:
    """What there is of a run, if it has this configuration.

    Returns:
        The run, if it is finished; otherwise its last checkpoint, if there is one to continue from.
    """
    if run.config != plain_config(cfg):
        return None, None
    if run.status in FINISHED:
        return run, None
    last = run.folder / "checkpoints" / "last.ckpt"
    try:
        read_checkpoint(last, RESUME_KEYS)
    except InputError:  # none yet, or a broken one: from the start
        return None, None
    return None, last
