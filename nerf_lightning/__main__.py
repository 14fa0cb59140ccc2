"""Train: compose -> build -> fit -> test -> results.json. Heavy imports wait until they are needed."""

import os
import re
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode

from nerf_lightning.config import cli
from nerf_lightning.config.literal import override_of
from nerf_lightning.errors import InputError
from nerf_lightning.utils.files import user_path
from nerf_lightning.utils.signals import Interrupted

if TYPE_CHECKING:
    from omegaconf import DictConfig


def train(cfg: "DictConfig") -> float | None:
    """Trains one run. Returns the held-out PSNR in dB, which a sweep optimises; None for a sweep's job that failed."""
    if HydraConfig.get().mode == RunMode.MULTIRUN:
        from nerf_lightning.training.sweep import job

        return job(cfg)
    from nerf_lightning.training.command import run

    try:
        return run(cfg)
    except Interrupted as interrupted:
        folder = Path(HydraConfig.get().runtime.output_dir)
        if (folder / "checkpoints" / "last.ckpt").exists():
            given = shlex.quote(f"resume={os.path.relpath(folder)}")
            interrupted.hint = f"continue with: python -m nerf_lightning {given}"
        raise


TEXTS = ("resume", "name", "method", "dataset.path", "dataset.name", "dataset.folder", "dataset.url")
"""Keys whose values are text."""


def resume_arguments(arguments: Sequence[str]) -> list[str]:
    """A command line whose run, if it resumes one, continues in that one's folder and may set any of that one's options."""
    resumed = [argument.removeprefix("resume=") for argument in arguments if argument.startswith("resume=")]
    if not resumed or resumed[-1] in ("", "null"):
        return [*arguments]
    if os.path.isfile(resumed[-1]):  # Hydra would try to make a folder of this name
        raise InputError(resumed[-1], "", "a file", "the folder of a run", "give resume=FOLDER")
    # conf/ composes another run than the resumed one, with other options in its groups: ++ sets also those that only this has.
    found = [f"++{one}" if re.match(r"(?!hydra\.)\w+\.[\w.]+=", one) else one for one in arguments]
    folder = user_path(resumed[-1])
    return [*found, override_of("hydra.run.dir", folder.absolute()) if folder.is_dir() else "hydra.run.dir=${resume}"]


def main() -> None:
    """The command line."""
    try:
        sys.argv[1:] = resume_arguments(sys.argv[1:])
    except InputError as error:
        cli.give_up(error)
    cli.run("config", train, texts=TEXTS)


if __name__ == "__main__":
    main()
