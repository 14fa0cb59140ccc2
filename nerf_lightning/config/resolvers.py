"""OmegaConf resolvers for conf/: folders named after the command line, and the recipe's name. Imports nothing heavy."""

import hashlib
import sys
from collections.abc import Sequence

from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

from nerf_lightning.config import conf_dir

MAX_SLUG_CHARS = 120
"""Longest name of a folder, in characters."""


def slugify(text: str) -> str:
    """Converts text to a folder's name. Long text is cut and ends in a hash of the whole."""
    plain = "".join(c if c.isalnum() or c in "=.,_-+" else "-" for c in text) or "all"
    if len(plain) <= MAX_SLUG_CHARS:
        return plain
    return f"{plain[: MAX_SLUG_CHARS - 9]}-{hashlib.sha256(text.encode()).hexdigest()[:8]}"


def sweep_folder(arguments: Sequence[str]) -> str:
    """Folder of a sweep: the same command line gives the same folder.

    Named after the run's name (or else the experiment) and all other options given; flags, Hydra's settings and `overwrite` do
    not count.
    """
    words = [word.lstrip("+") for word in arguments if not word.startswith("-")]
    given = dict(word.partition("=")[::2] for word in words if not word.startswith(("hydra.", "hydra/")))
    experiment = given.pop("experiment", "run")
    name = given.pop("name", experiment)
    given.pop("overwrite", None)
    return f"outputs/{slugify(name)}/{slugify('_'.join(['sweep', *(f'{k}={v}' for k, v in sorted(given.items()))]))}"


def fixed_keys(arguments: Sequence[str]) -> list[str]:
    """Keys that a command line sets to one value, rather than to several."""
    written = [argument for argument in arguments if "=" in argument and not argument.startswith("-")]
    parsed = OverridesParser.create().parse_overrides(written)
    return sorted(override.key_or_group for override in parsed if not override.is_sweep_override())


def job_name(overrides: Sequence[str], fixed: Sequence[str]) -> str:
    """Name of a job: its overrides, without those shared by all jobs."""
    return slugify(",".join(sorted(text for text in overrides if text.lstrip("+~").partition("=")[0] not in fixed)))


def recipe_name(recipe: str | None, model: str) -> str | None:
    """The recipe's name, if it starts with that of the chosen model; None otherwise, as in `+experiment=lego model=mlp`. A
    user's recipe, in another folder, may have any name."""
    shipped = (conf_dir() / "recipe" / f"{recipe}.yaml").is_file()
    return None if shipped and not str(recipe).startswith(f"{model}_") else recipe


def register_resolvers() -> None:
    """Registers the resolvers. Values from the command line are cached, so that jobs keep them."""
    OmegaConf.register_new_resolver("sweep_folder", lambda: sweep_folder(sys.argv[1:]), use_cache=True, replace=True)
    OmegaConf.register_new_resolver("fixed_keys", lambda: fixed_keys(sys.argv[1:]), use_cache=True, replace=True)
    OmegaConf.register_new_resolver("job_name", job_name, replace=True)
    OmegaConf.register_new_resolver("recipe_name", recipe_name, replace=True)


register_resolvers()  # on import, as the processes of a sweep import nothing else of the command line
