"""python -m nerf_lightning.export: a run as something else. Heavy imports wait until there is work."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from nerf_lightning import cli
from nerf_lightning.errors import InputError
from nerf_lightning.options import AtLeast, check_options

if TYPE_CHECKING:
    from omegaconf import DictConfig


def task(cfg: "DictConfig") -> None:
    """Checks the configuration and exports."""
    from omegaconf import OmegaConf

    given = {str(key): cfg[key] for key in cfg if key != "dataset" and not OmegaConf.is_missing(cfg, key)}
    given["path"] = cfg.dataset.path
    check_options("", export, given)
    export(**given)


def export(
    run: str,
    format: str,
    output: str | None,
    precision: str | None,
    loss: Annotated[float, AtLeast(0)],
    path: str | None,
) -> None:
    """Writes a run's last state in another format.

    Args:
        run: its folder.
        format: "compact".
        output: the file; None puts it into the folder.
        precision: "half" or "byte"; None takes the smaller one that is allowed.
        loss: dB of held-out PSNR that may be lost.
        path: of the photos, where they are no longer where the run found them.

    Raises:
        InputError: where the folder is no run's, the photos are not there, or more would be lost.
    """
    if format != "compact":
        raise InputError("config", "format", repr(format), "compact")
    if precision not in (None, "half", "byte"):
        raise InputError(
            "config", "precision", repr(precision), "half, byte, or null for the smaller one that is allowed"
        )

    from nerf_lightning.build import build_data
    from nerf_lightning.export.smallest import smallest
    from nerf_lightning.files import atomic
    from nerf_lightning.kernels import use_kernels
    from nerf_lightning.run_folder import load_run, plain_config
    from nerf_lightning.training import quiet

    quiet()
    folder = Path(run).expanduser()
    found = load_run(folder)
    use_kernels(found.cfg.kernels)
    if path is not None:
        found.cfg.dataset.path = path
    data = build_data(found.cfg)
    before = sum(tensor.numel() * tensor.element_size() for tensor in found.system.state_dict().values())
    compact = smallest(found.system, data, plain_config(found.cfg), loss, precision)
    target = folder / "compact.npz" if output is None else Path(output).expanduser()
    with atomic(target) as temporary:
        temporary.write_bytes(compact.content)
    print(
        f"{target}: {len(compact.content) / 1000:,.1f} kB of {before / 1000:,.1f} kB (precision={compact.precision}),"
        f" held-out PSNR {compact.before:.2f} -> {compact.psnr:.2f} dB, {max(compact.loss, 0):.3f} dB lost"
    )


if __name__ == "__main__":
    cli.run("export", task)
