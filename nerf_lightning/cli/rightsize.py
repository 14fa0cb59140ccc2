"""nerf_lightning rightsize."""

from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from nerf_lightning.cli.command import command
from nerf_lightning.errors import InputError
from nerf_lightning.utils.option_checks import Ge

IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".webp", ".heic")
"""Suffixes that select 2D training."""


@command
def rightsize(
    scene: str,
    /,
    *overrides: str,
    within_db: Annotated[float, Ge(0)] | None = None,
    psnr: float | None = None,
    ladder: str | None = None,
    output: Annotated[Path, Parameter(alias="-o")] = Path("outputs/rightsize"),
) -> dict[str, Any]:
    """Find the smallest model that is good enough, and train it.

    One training grows along a ladder of sizes while the gain justifies the bytes. The candidate size and a neighbor are then
    trained in full. Writes runs (rung_N), compact.npz, chart.png, rightsize.json, and best.yaml for
    train +experiment=best.yaml. If interrupted, the same command continues.

    Args:
        scene: Path of a scene or image, or the name of an experiment or built-in scene, such as lego.
        overrides: Training options, such as budget.seconds=60 recipe=tensorf_small.
        within_db: Allowed loss against the best reachable PSNR, dB; default: 0.3.
        psnr: Alternatively, the required held-out PSNR, dB.
        ladder: Sizes to try: a name in conf/ladders, or a YAML file; default: the model's.
        output: Folder for all files.

    Returns:
        The content of rightsize.json: `rung`, `model` (its options), `psnr`, `artifact_bytes` and more.

    Raises:
        InputError: an invalid option or scene, or the folder holds something else.
    """
    if within_db is not None and psnr is not None:
        raise InputError("rightsize", "psnr", f"{psnr:g} and within_db={within_db:g}", "one of the two")
    from hydra.errors import HydraException
    from omegaconf.errors import OmegaConfBaseException

    from nerf_lightning.cli.train import translate_error
    from nerf_lightning.config.compose import compose_config
    from nerf_lightning.runs.run_lock import lock_folder
    from nerf_lightning.sizing.choose import Target, read_ladder
    from nerf_lightning.sizing.report import REPORT_FILE, explain_choice, write_report
    from nerf_lightning.sizing.search import search_sizes, write_or_check_plan
    from nerf_lightning.utils.files import check_output_path
    from nerf_lightning.utils.parsing import read_json

    folder = check_output_path(output)
    try:
        cfg = compose_config([*describe_scene(scene), *overrides], folder)
    except (HydraException, OmegaConfBaseException) as error:
        raise translate_error(error) from error
    sizes = read_ladder(ladder or str(cfg.method))
    target = Target(psnr, 0.3 if within_db is None else within_db)
    with lock_folder(folder):
        if (folder / REPORT_FILE).is_file():
            write_or_check_plan(folder, cfg, target, sizes)
            result = read_json(folder / REPORT_FILE, "a finished search")
        else:
            result = search_sizes(cfg, target, sizes, folder)
            write_report(result, cfg, folder)
    print(explain_choice(result, folder))
    return result


def describe_scene(scene: str) -> list[str]:
    """Overrides that select a scene by its path, or an experiment by its name."""
    from nerf_lightning.config import conf_dir
    from nerf_lightning.config.quoting import make_override
    from nerf_lightning.utils.files import expand_user_path

    for key in ("+experiment", "dataset"):
        if scene.isidentifier() and (conf_dir() / key.lstrip("+") / f"{scene}.yaml").is_file():
            return [f"{key}={scene}"]
    path = expand_user_path(scene)
    if not path.exists():
        raise InputError("rightsize", "scene", scene, "a path, or a name in conf/experiment or conf/dataset")
    kind = "+experiment=picture" if path.suffix.lower() in IMAGE_SUFFIXES else "dataset=photos"
    return [kind, make_override("dataset.path", path)]
