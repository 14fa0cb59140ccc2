"""nerf_lightning train: Hydra's command line. Fast to import."""

import os
import re
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from nerf_lightning.config import conf_dir
from nerf_lightning.errors import InputError
from nerf_lightning.utils.files import expand_user_path, remove_empty_folders
from nerf_lightning.utils.text import suggest

if TYPE_CHECKING:
    from omegaconf import DictConfig


def is_override(word: str) -> bool:
    """Whether a command line's first word is Hydra's: KEY=VALUE, +KEY=VALUE, ~KEY, or one of its flags."""
    if word in ("-h", "--help", "--version", "--install-completion"):
        return False
    return word.startswith(("+", "~", "-")) or re.match(r"[\w./@]+=", word) is not None


def describe_groups() -> str:
    """The options of the main config groups, one line per group."""
    lines = []
    for group in ("dataset", "model", "sampler", "refine", "recipe", "experiment"):
        names = ", ".join(sorted(file.stem for file in (conf_dir() / group).glob("*.yaml")))
        lines.append(f"{'+' * (group == 'experiment')}{group}: {names}")
    return "\n".join(lines)


def train(*overrides: Annotated[str, Parameter(allow_leading_hyphen=True, show=False)]) -> None:
    """Train a field from photos, or from a single image.

    train dataset=photos dataset.path=SCENE    90 s by default; then view, or export html
    train +experiment=lego                     the Lego scene, or built-in bricks
    train +experiment=picture                  a single image: dataset.path=IMAGE

    SCENE: a folder of photos, or a video, whose cameras COLMAP finds (pycolmap);
    or photos with cameras: a folder of nerfstudio or instant-ngp (transforms.json),
    Blender (transforms_train.json), COLMAP (sparse/0), LLFF (poses_bounds.npy); or
    FILE.npz, as capture writes it

    budget.seconds=60   training time; or budget.steps=1000
    model=mlp           another field; recipe=NAME selects a tuned preset
    seed=1 name=mine    results go to outputs/mine/TIME
    resume=RUN          continue an interrupted run
    -m seed=0,1,2       a sweep: one run per value; if interrupted, the same command continues
    hydra.run.dir=DIR   the run's folder; overwrite=true replaces a run in it
    --cfg job           all keys with their values

    Groups, GROUP=OPTION:
    """
    run_hydra(overrides)


def run_hydra(overrides: Sequence[str]) -> None:
    """Composes the configuration from a command line and trains.

    Raises:
        InputError: invalid overrides or options.
    """
    import hydra
    from hydra._internal.utils import get_args_parser
    from hydra.core.hydra_config import HydraConfig
    from hydra.errors import HydraException
    from omegaconf import OmegaConf, read_write
    from omegaconf.errors import OmegaConfBaseException

    from nerf_lightning.cli.app import exit_with_error, find_input_error
    from nerf_lightning.config import resolvers  # noqa: F401  (conf/ uses the resolvers)
    from nerf_lightning.config.quoting import escape_interpolations

    def job(cfg: "DictConfig") -> float | None:
        try:
            runtime: Any = HydraConfig.get().runtime
            plain: Any = OmegaConf.to_container(runtime)
            with read_write(runtime):  # Hydra does not escape this path
                runtime.output_dir = escape_interpolations(plain["output_dir"])
            return train_job(cfg)
        except Exception as error:
            known = error if isinstance(error, OmegaConfBaseException) else find_input_error(error)
            if known is None:
                raise
            remove_empty_folders(Path(HydraConfig.get().runtime.output_dir))
            exit_with_error(known)  # exit here: Hydra would print its own message

    def refuse(message: str) -> None:
        raise InputError("command line", "", message, hint="give KEY=VALUE, or flags that --hydra-help lists")

    parser = get_args_parser()
    parser.allow_abbrev = False  # --experiment is not --experimental-rerun
    parser.error = refuse  # type: ignore[method-assign,assignment]
    flags = parser.parse_args(list(overrides))
    if flags.experimental_rerun:  # unpickles a file, which may execute code
        refuse("--experimental-rerun")
    for word in flags.overrides:
        if ("=" not in word and not word.startswith("~")) or os.path.exists(word):
            hint = f"to train on photos: dataset=photos {shlex.quote(f'dataset.path={word}')}"
            raise InputError("command line", "", word, "KEY=VALUE", hint)
    sys.argv[1:] = rewrite_overrides(overrides, flags.multirun)
    os.environ["HYDRA_FULL_ERROR"] = "1"  # makes Hydra raise instead of printing and exiting with 1
    try:
        hydra.main(version_base="1.3", config_path=str(conf_dir()), config_name="config")(job)()
    except (HydraException, OmegaConfBaseException) as error:
        raise translate_error(error) from error


def train_job(cfg: "DictConfig") -> float | None:
    """Trains one run, or one job of a sweep.

    Returns:
        Held-out PSNR in dB, the objective of a sweep; None for a failed job of a sweep.

    Raises:
        InputError: as `training.train.train`, and if the folder holds another run.
    """
    from hydra.core.hydra_config import HydraConfig
    from hydra.types import RunMode
    from omegaconf import OmegaConf, read_write

    from nerf_lightning.config.options import check_run_options
    from nerf_lightning.config.quoting import escape_interpolations
    from nerf_lightning.utils.signals import SignalInterrupt

    hydra: Any = HydraConfig.get()
    if hydra.mode == RunMode.MULTIRUN:
        from nerf_lightning.training.job import run_job

        return run_job(cfg)
    check_run_options(cfg, hydra.runtime.choices)
    from nerf_lightning.runs.run_lock import lock_folder, lock_new_run_folder
    from nerf_lightning.training.train import train as train_run

    folder = Path(hydra.runtime.output_dir)
    try:
        if cfg.resume is not None:
            with lock_folder(folder):
                return train_run(cfg)
        timed = "${now:" in str(OmegaConf.to_container(hydra.run, resolve=False))
        with lock_new_run_folder(folder, cfg.overwrite, allow_suffix=timed) as folder:
            with read_write(hydra):  # other processes of this run read it
                hydra.run.dir = hydra.runtime.output_dir = escape_interpolations(str(folder))
            return train_run(cfg)
    except SignalInterrupt as interrupted:
        if (folder / "checkpoints" / "last.ckpt").exists():
            argument = shlex.quote(f"resume={os.path.relpath(folder)}")
            interrupted.hint = f"continue with: nerf_lightning train {argument}"
        raise


def rewrite_overrides(words: Sequence[str], sweep: bool) -> list[str]:
    """Rewrites a command line into Hydra's grammar: null groups, experiment files, `~`, and quoting.

    A resumed run continues in its folder and may override any of its options.

    Raises:
        InputError: null for a required group, an invalid experiment file, or a missing run.
    """
    from nerf_lightning.config.options import replace_nulls
    from nerf_lightning.config.quoting import FOLDER_KEYS, make_override, quote_overrides
    from nerf_lightning.utils.parsing import read_yaml

    resumes = [word for word in words if word.startswith("resume=") and word not in ("resume=", "resume=null")]
    rewritten = []
    for word in replace_nulls(words):
        key, _, value = word.partition("=")
        if key == "+experiment" and value.endswith(".yaml") and (file := expand_user_path(value)).is_file():
            read_yaml(file, "an experiment in YAML")  # Hydra reads without a size limit
            word = make_override(key, os.path.relpath(file.with_suffix(""), conf_dir() / "experiment"))
        elif key in FOLDER_KEYS and value.startswith("~"):
            word = make_override(key, expand_user_path(value))
        elif resumes and re.match(r"(?!hydra\.)\w+\.[\w.]+=", word):
            word = f"++{word}"  # adds keys that only the resumed run has
        rewritten.append(word)
    if resumes:
        folder = expand_user_path(resumes[-1].removeprefix("resume="))
        if not folder.is_dir():
            raise InputError(folder, "", "no such folder", hint="give resume=FOLDER, that of a run")
        rewritten.append(make_override("hydra.run.dir", folder.absolute()))
    return quote_overrides(rewritten, sweep)


def translate_error(error: Exception) -> InputError:
    """Converts an error of Hydra or OmegaConf to an InputError; suggests the closest key for an unknown one."""
    line = " ".join(str(error).split("Config search path")[0].split())
    if (unknown := re.match(r"Could not override '([^']+)'", line)) is not None:
        node = getattr(error.__cause__, "parent_node", None)
        known = [str(key) for key in node] if node is not None else []
        parent, dot, key = unknown[1].rpartition(".")
        hint = suggest(key, known, parent + dot) or "--cfg job lists all keys"
        return InputError("command line", unknown[1], "an unknown key", f"one of {', '.join(sorted(known))}", hint)
    if re.search(r"hydra/(launcher|sweeper)", line):
        line += "; joblib, submitit_local, submitit_slurm and optuna come with pip install 'nerf_lightning[sweeps]'"
    return InputError("command line", "", line, hint="see nerf_lightning train --help")
