"""A run of the command line, in a folder of its own."""

from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf, read_write

from nerf_lightning.config.literal import escape
from nerf_lightning.runs.owner import own_folder, owned
from nerf_lightning.training.train import train


def run(cfg: DictConfig) -> float:
    """Trains in the folder that Hydra names, or, if the name is only the time and taken, in one beside it.

    Returns:
        The held-out PSNR in dB.

    Raises:
        InputError: as `train` does, and where the folder belongs to another run.
    """
    hydra: Any = HydraConfig.get()
    folder = Path(hydra.runtime.output_dir)
    if cfg.resume is not None:
        with owned(folder):
            return train(cfg)
    timed = "${now:" in str(OmegaConf.to_container(hydra.run, resolve=False))
    with own_folder(folder, cfg.overwrite, renamed=timed) as place:
        with read_write(hydra):  # further processes of this run ask Hydra
            hydra.run.dir = hydra.runtime.output_dir = escape(str(place))
        return train(cfg)
