"""Train: compose -> build -> fit -> test -> results.json. Heavy imports wait until they are needed."""

import os
import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode

from nerf_lightning.config import cli
from nerf_lightning.errors import InputError
from nerf_lightning.utils.ending import Interrupted

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
            interrupted.go_on = f"go on with: python -m nerf_lightning {given}"
        raise


def main() -> None:
    """The command line. A resumed run continues in its own folder."""
    resumed = [argument.removeprefix("resume=") for argument in sys.argv[1:] if argument.startswith("resume=")]
    if resumed and resumed[-1] not in ("", "null"):
        if os.path.isfile(resumed[-1]):  # Hydra would try to make a folder of this name
            cli.give_up(InputError(resumed[-1], "", "a file", "the folder of a run", "give resume=FOLDER"))
        sys.argv.append(f"hydra.run.dir='{Path(resumed[-1]).absolute()}'")
    cli.run("config", train, texts=("resume",))


if __name__ == "__main__":
    main()
