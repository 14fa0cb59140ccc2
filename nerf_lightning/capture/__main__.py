"""python -m nerf_lightning.capture: two folders of photos become a scene file. Heavy imports wait until there is work."""

from typing import TYPE_CHECKING

from nerf_lightning.config import cli

if TYPE_CHECKING:
    from omegaconf import DictConfig


def task(cfg: "DictConfig") -> None:
    """Calibrates, places the photos, writes the scene and the report, and says where they are."""
    from nerf_lightning.capture.verb import capture_from

    capture_from(cfg)


if __name__ == "__main__":
    cli.run("capture", task)
