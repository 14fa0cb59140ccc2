"""python -m nerf_lightning.rightsize: the smallest model that is good enough. Heavy imports wait until there is work."""

from typing import TYPE_CHECKING

from nerf_lightning.config import cli, conf_dir
from nerf_lightning.utils.files import output_path
from nerf_lightning.utils.options import check_options

if TYPE_CHECKING:
    from omegaconf import DictConfig

OWN = ("target", "ladder", "output")
"""Keys that are not a run's."""
WITHIN_DB = 0.3


def options(ladder: str | None, output: str) -> None:
    """The verb's keys at the top level, for checking."""


def targets(psnr: float | None, within_db: float | None) -> None:
    """The keys of `target`, for checking."""


def task(cfg: "DictConfig") -> None:
    """Checks the configuration and searches.

    Raises:
        InputError: for a wrong key, or a folder that holds something else already.
    """
    from hydra.core.hydra_config import HydraConfig
    from omegaconf import OmegaConf

    from nerf_lightning.runs.owner import owned

    given = OmegaConf.to_container(cfg.target)
    assert isinstance(given, dict)  # of a DictConfig
    target = {str(key): value for key, value in given.items()}
    check_options("", options, {"ladder": cfg.ladder, "output": cfg.output})
    check_options("target", targets, target)
    if target["psnr"] is None and target["within_db"] is None:
        target["within_db"] = WITHIN_DB
    output = output_path(cfg.output)

    from nerf_lightning.rightsize.choose import Target
    from nerf_lightning.rightsize.ladder import read_ladder
    from nerf_lightning.rightsize.report import write_report
    from nerf_lightning.rightsize.search import search

    goal = Target(**target)
    ladder = read_ladder(cfg.ladder or cfg.method, conf_dir() / "ladders")
    run = OmegaConf.masked_copy(cfg, [str(key) for key in cfg if key not in OWN])
    with owned(output):
        found = search(run, goal, ladder, output)
        write_report(found, run, dict(HydraConfig.get().runtime.choices), output)


if __name__ == "__main__":
    cli.run("rightsize", task)
