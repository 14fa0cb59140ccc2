"""nerf_lightning train: Hydra's command line. Imports nothing heavy."""

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
from nerf_lightning.utils.files import output_path, remove_empty, user_path
from nerf_lightning.utils.text import suggest

if TYPE_CHECKING:
    from omegaconf import DictConfig

TEXT_KEYS = ("resume", "name", "method", "dataset.path", "dataset.name", "dataset.folder", "dataset.url")
"""Keys whose values are text, whatever its letters."""
FOLDER_KEYS = ("hydra.run.dir", "hydra.sweep.dir")
"""Keys of folders that Hydra makes."""


def is_override(word: str) -> bool:
    """Whether a command line's first word is for Hydra: KEY=VALUE, +KEY=VALUE, ~KEY, or one of its flags."""
    if word in ("-h", "--help", "--version", "--install-completion"):
        return False
    return word.startswith(("+", "~", "-")) or re.match(r"[\w./@]+=", word) is not None


def describe_groups() -> str:
    """The options of the groups that users choose most, a line a group."""
    lines = []
    for group in ("dataset", "model", "sampler", "refine", "recipe", "experiment"):
        names = ", ".join(sorted(file.stem for file in (conf_dir() / group).glob("*.yaml")))
        lines.append(f"{'+' * (group == 'experiment')}{group}: {names}")
    return "\n".join(lines)


def train(*overrides: Annotated[str, Parameter(allow_leading_hyphen=True, show=False)]) -> None:
    """Train a field from photos, or from a single image.

    train dataset=photos dataset.path=SCENE    for 90 s; then view, or export html
    train +experiment=lego                     the Lego scene, or built-in bricks
    train +experiment=picture                  a single image: dataset.path=IMAGE

    SCENE: a folder of photos, or a video, whose cameras COLMAP finds (pycolmap);
    or photos with cameras: a folder of nerfstudio or instant-ngp (transforms.json),
    Blender (transforms_train.json), COLMAP (sparse/0), LLFF (poses_bounds.npy); or
    FILE.npz, as capture writes it

    budget.seconds=60   for a minute; or budget.steps=1000
    model=mlp           another field; recipe=NAME brings settings that suit it
    seed=1 name=mine    results go to outputs/mine/TIME
    resume=RUN          continue a run that was interrupted
    -m seed=0,1,2       a sweep: a run for each value; run again, it continues
    hydra.run.dir=DIR   the run's folder; overwrite=true replaces a run in it
    --cfg job           all keys with their values

    Groups, GROUP=OPTION:
    """
    run_hydra(overrides)


def run_hydra(overrides: Sequence[str]) -> None:
    """Composes the configuration from a command line and trains.

    Raises:
        InputError: for what the user can mend.
    """
    import hydra
    from hydra._internal.utils import get_args_parser
    from hydra.core.hydra_config import HydraConfig
    from hydra.errors import HydraException
    from omegaconf import OmegaConf, read_write
    from omegaconf.errors import OmegaConfBaseException

    from nerf_lightning.cli.app import fail, find_cause
    from nerf_lightning.config import resolvers  # noqa: F401  (conf/ uses the resolvers)
    from nerf_lightning.config.literal import escape, quote_texts
    from nerf_lightning.config.options import replace_nulls

    def job(cfg: "DictConfig") -> float | None:
        try:
            runtime: Any = HydraConfig.get().runtime
            plain: Any = OmegaConf.to_container(runtime)
            with read_write(runtime):  # Hydra does not escape the path that it puts there
                runtime.output_dir = escape(plain["output_dir"])
            return train_job(cfg)
        except Exception as error:
            known = error if isinstance(error, OmegaConfBaseException) else find_cause(error)
            if known is None:
                raise
            remove_empty(Path(HydraConfig.get().runtime.output_dir))
            fail(known)  # here, as Hydra would print a line of its own

    def refuse(message: str) -> None:
        raise InputError(
            "command line", "", message, "KEY=VALUE, or flags that --hydra-help lists", _suggest_flag(message)
        )

    parser = get_args_parser()
    parser.allow_abbrev = False  # --experiment is not --experimental-rerun
    parser.error = refuse  # type: ignore[method-assign,assignment]
    flags = parser.parse_args(list(overrides))
    if flags.experimental_rerun:  # it unpickles a file, which may run anything
        refuse("--experimental-rerun")
    for word in flags.overrides:
        if ("=" not in word and not word.startswith("~")) or os.path.exists(word):
            todo = f"to train on photos: dataset=photos {shlex.quote(f'dataset.path={word}')}"
            raise InputError("command line", "", word, "KEY=VALUE", todo)
    given = replace_nulls(_find_experiments(_resume_overrides(overrides)))
    sys.argv[1:] = _expand_folders(quote_texts(given, (*TEXT_KEYS, *FOLDER_KEYS), flags.multirun or None))
    os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra then raises, instead of printing a report and exiting with 1
    try:
        hydra.main(version_base="1.3", config_path=str(conf_dir()), config_name="config")(job)()
    except (HydraException, OmegaConfBaseException) as error:
        raise translate_error(error) from error


def train_job(cfg: "DictConfig") -> float | None:
    """Trains one run, or one job of a sweep.

    Returns:
        Held-out PSNR in dB, which a sweep optimises; None for a sweep's job that failed.

    Raises:
        InputError: as `training.train.train`, and where the folder belongs to another run.
    """
    from hydra.core.hydra_config import HydraConfig
    from hydra.types import RunMode
    from omegaconf import OmegaConf, read_write

    from nerf_lightning.config.literal import escape
    from nerf_lightning.config.options import check_run_options
    from nerf_lightning.utils.signals import Interrupted

    hydra: Any = HydraConfig.get()
    if hydra.mode == RunMode.MULTIRUN:
        from nerf_lightning.training.sweep import job

        return job(cfg)
    check_run_options(cfg, hydra.runtime.choices)
    from nerf_lightning.runs.owner import own_folder, owned
    from nerf_lightning.training.train import train as train_run

    folder = Path(hydra.runtime.output_dir)
    try:
        if cfg.resume is not None:
            with owned(folder):
                return train_run(cfg)
        timed = "${now:" in str(OmegaConf.to_container(hydra.run, resolve=False))
        with own_folder(folder, cfg.overwrite, renamed=timed) as folder:
            with read_write(hydra):  # further processes of this run ask Hydra
                hydra.run.dir = hydra.runtime.output_dir = escape(str(folder))
            return train_run(cfg)
    except Interrupted as interrupted:
        if (folder / "checkpoints" / "last.ckpt").exists():
            argument = shlex.quote(f"resume={os.path.relpath(folder)}")
            interrupted.hint = f"continue with: nerf_lightning train {argument}"
        raise


def _resume_overrides(arguments: Sequence[str]) -> list[str]:
    """A command line that, if it resumes a run, continues in that run's folder and may set any of that run's options."""
    from nerf_lightning.config.literal import override_of

    resumed = [argument.removeprefix("resume=") for argument in arguments if argument.startswith("resume=")]
    if not resumed or resumed[-1] in ("", "null"):
        return [*arguments]
    folder = user_path(resumed[-1])
    if folder.is_file():  # Hydra would try to make a folder of this name
        raise InputError(folder, "", "a file", "the folder of a run", "give resume=FOLDER")
    # conf/ composes another run than the resumed one, with other options in its groups: ++ sets also those that only this has.
    options = [f"++{one}" if re.match(r"(?!hydra\.)\w+\.[\w.]+=", one) else one for one in arguments]
    return [*options, override_of("hydra.run.dir", folder.absolute()) if folder.is_dir() else "hydra.run.dir=${resume}"]


def _find_experiments(arguments: Sequence[str]) -> list[str]:
    """Rewrites +experiment=FILE.yaml so that Hydra finds it: relative to the shipped experiments.

    Raises:
        InputError: where such a file is no YAML.
    """
    from nerf_lightning.config.literal import override_of
    from nerf_lightning.utils.parsing import read_yaml

    rewritten = []
    for argument in arguments:
        key, _, value = argument.partition("=")
        if key == "+experiment" and value.endswith(".yaml") and (path := user_path(value)).is_file():
            read_yaml(path, "an experiment in YAML")  # Hydra reads without limits
            argument = override_of(key, os.path.relpath(path.with_suffix(""), conf_dir() / "experiment"))
        rewritten.append(argument)
    return rewritten


def _expand_folders(arguments: Sequence[str]) -> list[str]:
    """Rewrites the folders that Hydra makes, with ~ filled in.

    Raises:
        InputError: where there can be no such folder.
    """
    from nerf_lightning.config.literal import override_of, parse_argument

    rewritten = []
    for argument in arguments:
        key = argument.partition("=")[0]
        parsed = parse_argument(argument) if key in FOLDER_KEYS else None
        if parsed is not None and isinstance(text := parsed.value(), str) and "${" not in text:
            folder = output_path(text)
            if folder.exists() and not folder.is_dir():
                raise InputError(folder, "", "a file", f"a folder to write into ({key})", "give another one")
            argument = override_of(key, folder)
        rewritten.append(argument)
    return rewritten


def _suggest_flag(message: str) -> str:
    """What may be meant by a flag that Hydra does not know, such as --experiment=lego."""
    found = re.search(r"--([\w.]+)(=\S+)?", message)
    if found is None:
        return ""
    key = f"+{found[1]}" if found[1] == "experiment" else found[1]
    return f"did you mean {key}{found[2] or '=...'}?"


def translate_error(error: Exception) -> InputError:
    """An error of Hydra or OmegaConf as bad input, with the nearest key where one is not known."""
    line = " ".join(str(error).split("Config search path")[0].split())
    if (unknown := re.match(r"Could not override '([^']+)'", line)) is not None:
        node = getattr(error.__cause__, "parent_node", None)
        known = [str(key) for key in node] if node is not None else []
        parent, dot, key = unknown[1].rpartition(".")
        todo = suggest(key, known, parent + dot) or "--cfg job lists all"
        return InputError("command line", unknown[1], "an unknown key", f"one of {', '.join(sorted(known))}", todo)
    if re.search(r"hydra/(launcher|sweeper)", line):
        line += "; joblib, submitit_local, submitit_slurm and optuna come with pip install 'nerf_lightning[sweeps]'"
    return InputError("command line", "", line, "what nerf_lightning train --help describes")
