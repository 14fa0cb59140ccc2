"""Resuming: configuration, checkpoint and photos of the run to continue."""

from pathlib import Path

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from nerf_lightning.config.build import build_data, replace_photos, resolve_config
from nerf_lightning.config.quoting import escape_interpolations
from nerf_lightning.dataset import DataModule, RayDataModule, Scene
from nerf_lightning.errors import InputError
from nerf_lightning.runs.checkpoint import RESUME_KEYS, read_checkpoint
from nerf_lightning.runs.folder import load_config
from nerf_lightning.runs.reload import reload_data
from nerf_lightning.runs.scene_file import read_scene_file


def compose_resumed_config(cfg: DictConfig, folder: Path) -> tuple[DictConfig, Path]:
    """Composes the configuration of the run in `folder` with this command line's overrides.

    Returns:
        The configuration, and the run's last checkpoint, to continue from.

    Raises:
        InputError: a damaged checkpoint, or an override of an option that the run does not have.
    """
    saved = load_config(folder)
    checkpoint = folder / "checkpoints" / "last.ckpt"
    read_checkpoint(checkpoint, RESUME_KEYS)  # raises before anything starts, if it is damaged
    overridden_keys = [override.partition("=")[0].lstrip("+") for override in HydraConfig.get().overrides.task]
    if "dataset.path" in overridden_keys and cfg.dataset.path is not None:
        saved = replace_photos(saved, cfg.dataset.path)
    for key in overridden_keys:
        if key == "resume":
            continue
        if OmegaConf.select(saved, key, default=key) is key:
            raise InputError("resume", key, "the run has no such option", hint=f"see {folder}/config.yaml")
        value = OmegaConf.select(cfg, key)
        literal = escape_interpolations(resolve_config(value) if isinstance(value, DictConfig) else value)
        OmegaConf.update(saved, key, literal, merge=False)
    if "device" in overridden_keys:  # the trainer's was resolved when the run began
        OmegaConf.update(saved, "trainer.accelerator", cfg.trainer.accelerator)
    return saved, checkpoint


def load_data(cfg: DictConfig, scene: Scene | None, resumed: Path | None) -> DataModule:
    """Training data: a loaded scene, that of a resumed run in its frame, or the configuration's."""
    if resumed is not None:
        return reload_data(cfg, read_scene_file(resumed), cfg.dataset.get("path"), corrected=False)
    if scene is None:
        return build_data(cfg)
    return RayDataModule(scene, *(cfg.dataset[key] for key in ("rays", "samples", "seed", "error_sampling")))
