"""What every command line of the package shares, such as errors in one line. Imports nothing heavy."""

import functools
import os
import re
import sys
import traceback
from argparse import Namespace
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NoReturn

import hydra
from hydra._internal.utils import get_args_parser
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf, read_write
from omegaconf.errors import OmegaConfBaseException

from nerf_lightning.config import conf_dir, resolvers  # noqa: F401  (conf/ uses the resolvers)
from nerf_lightning.config.keys import check_keys, without_nulls
from nerf_lightning.config.literal import escape, override_of, parse_argument, quote_texts
from nerf_lightning.errors import InputError
from nerf_lightning.utils.files import full_disk, no_room, output_path, remove_empty, user_path
from nerf_lightning.utils.libraries import shorten_openmp_waits
from nerf_lightning.utils.signals import Interrupted, exit_on_signal

BAD_INPUT = InputError | HydraException | OmegaConfBaseException
"""What a user can mend. Hydra and OmegaConf also notice it late, as a reference to a key that is not there."""
FOLDERS = ("hydra.run.dir", "hydra.sweep.dir")
"""Keys whose values are folders that Hydra makes."""
TRACEBACK = "NERF_LIGHTNING_TRACEBACK"
"""Environment variable: set to 1, errors come with the full traceback."""


def by_path(arguments: Sequence[str], folder: Path) -> list[str]:
    """Rewrites +experiment=PATH.yaml so that Hydra finds it: relative to the shipped experiments.

    Args:
        arguments: of the command line.
        folder: where conf/ is.

    Raises:
        InputError: where such a file is no YAML, or breaks a limit.
    """
    found = []
    for argument in arguments:
        key, _, value = argument.partition("=")
        if key == "+experiment" and value.endswith(".yaml") and (path := user_path(value)).is_file():
            from nerf_lightning.utils.parsing import read_yaml

            read_yaml(path, "an experiment in YAML")  # Hydra reads without limits
            argument = override_of(key, os.path.relpath(path.with_suffix(""), folder / "experiment"))
        found.append(argument)
    return found


def to_folders(arguments: Sequence[str]) -> list[str]:
    """Rewrites the folders that Hydra makes, with ~ filled in.

    Args:
        arguments: as `quote_texts` gives them.

    Raises:
        InputError: where there can be no such folder.
    """
    found = []
    for argument in arguments:
        key = argument.partition("=")[0]
        parsed = parse_argument(argument) if key in FOLDERS else None
        if parsed is not None and isinstance(text := parsed.value(), str) and "${" not in text:
            folder = output_path(text)
            if folder.exists() and not folder.is_dir():
                raise InputError(folder, "", "a file", f"a folder to write into ({key})", "give another one")
            argument = override_of(key, folder)
        found.append(argument)
    return found


def check_flags(arguments: Sequence[str]) -> Namespace:
    """Parses the flags. Raises InputError for those that Hydra does not know, which it would answer with its usage."""

    def refused(message: str) -> NoReturn:
        raise InputError("command line", "", message, "flags that --hydra-help lists, and KEY=VALUE")

    parser = get_args_parser()
    parser.error = refused  # type: ignore[method-assign]
    flags = parser.parse_args(arguments)
    if flags.experimental_rerun:  # it unpickles a file, which may run anything
        refused("--experimental-rerun")
    return flags


def given_of(cfg: DictConfig) -> dict[str, Any]:
    """The keys of a verb on a run that have a value, as plain values; `dataset.path` becomes `photos`."""
    given = {str(key): cfg[key] for key in cfg if key != "dataset" and not OmegaConf.is_missing(cfg, key)}
    given |= {key: OmegaConf.to_container(value) for key, value in given.items() if OmegaConf.is_config(value)}
    return {**given, "photos": cfg.dataset.path}


def run(config: str, task: Callable[[DictConfig], object], texts: Sequence[str] = ()) -> None:
    """Composes `conf/<config>.yaml` with the command line and calls `task`; exits with 2 on bad input or a full disk, with 130
    after Ctrl-C and with 143 after SIGTERM.

    The values of the keys in `texts` may hold commas and other characters that are special to Hydra, see `quote_texts`.

    Bad input is anything the user can fix: it gets one line. Anything else is a defect and keeps its traceback.
    """
    os.environ["HYDRA_FULL_ERROR"] = "1"  # Hydra then raises, instead of printing its own report and exiting with 1
    shorten_openmp_waits()
    started = False

    @functools.wraps(task)
    def job(cfg: DictConfig) -> object:
        nonlocal started
        started = True
        try:
            runtime: Any = HydraConfig.get().runtime
            plain: Any = OmegaConf.to_container(runtime)
            with read_write(runtime):  # Hydra does not escape the path that it puts there
                runtime.output_dir = escape(plain["output_dir"])
            check_keys(cfg, config, runtime.choices)
            return task(cfg)
        except (Exception, Interrupted) as error:
            told = as_told(error)
            if isinstance(told, BAD_INPUT | Interrupted):
                remove_empty(Path(HydraConfig.get().runtime.output_dir))
            if isinstance(told, BAD_INPUT):
                give_up(told)  # here, as Hydra would add a line
            raise

    try:
        with exit_on_signal():
            flags = check_flags(sys.argv[1:])
            given = without_nulls(by_path(sys.argv[1:], conf_dir()))
            sweep = flags.multirun or (None if config == "config" else False)
            sys.argv[1:] = to_folders(quote_texts(given, (*texts, *FOLDERS), sweep))
            hydra.main(version_base="1.3", config_path=str(conf_dir()), config_name=config)(job)()
    except Exception as error:
        # Before the task starts only Hydra is at work, on the command line: any error then is bad input.
        told = as_told(error)
        if started and not isinstance(told, BAD_INPUT):
            raise
        give_up(told)


def as_told(error: BaseException) -> BaseException:
    """An error as it is; a full disk, or memory that ran out, wherever it showed, as bad input."""
    if isinstance(error, InputError):
        return error
    told: InputError | None = None
    if full_disk(error):
        told = no_room(getattr(error, "filename", None) or Path.cwd())
    elif isinstance(error, MemoryError | RuntimeError):
        from nerf_lightning.utils.memory import out_of_memory

        told = out_of_memory(error)
    if told is None:
        return error
    told.__cause__ = error
    return told


def give_up(error: BaseException) -> NoReturn:
    """Prints the error in one line, with its traceback if the environment asks for it, and exits with 2."""
    if os.environ.get(TRACEBACK) == "1":
        traceback.print_exception(error)
    line = " ".join(str(error).split("Config search path")[0].split())
    unknown = re.match(r"Could not override '([^']+)'", line)
    if unknown:
        line = f"command line: found {unknown[1]}, expected a key or group that --cfg job or --help lists"
    if re.search(r"hydra/(launcher|sweeper)", line):
        line += "; joblib, submitit_local, submitit_slurm and optuna come with pip install 'nerf_lightning[sweeps]'"
    print(f"nerf_lightning: {line} ({TRACEBACK}=1 shows the traceback)", file=sys.stderr)
    sys.exit(2)
