"""Resolvers for conf/: folders named after the command line, and the recipe's name. Imports nothing heavy."""

import hashlib
import sys
from collections.abc import Sequence

from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

from nerf_lightning.config import conf_dir

MAX_SLUG_CHARS = 120
"""Most letters in a folder's name."""


def slugify(text: str) -> str:
    """Text as the name of a folder. Long text is cut and ends in a hash of the whole, so that names stay different."""
    plain = "".join(c if c.isalnum() or c in "=.,_-+" else "-" for c in text) or "all"
    if len(plain) <= MAX_SLUG_CHARS:
        return plain
    return f"{plain[: MAX_SLUG_CHARS - 9]}-{hashlib.sha256(text.encode()).hexdigest()[:8]}"


def sweep_folder(arguments: Sequence[str]) -> str:
    """Where a sweep's jobs go: the same command line finds the same folder again.

    It is named after the run's name (or else the experiment) and all other options given; flags, Hydra's own settings and
    `overwrite` do not count.
    """
    words = [word.lstrip("+") for word in arguments if not word.startswith("-")]
    given = dict(word.partition("=")[::2] for word in words if not word.startswith(("hydra.", "hydra/")))
    experiment = given.pop("experiment", "run")
    name = given.pop("name", experiment)
    given.pop("overwrite", None)
    return f"outputs/{slugify(name)}/{slugify('_'.join(['sweep', *(f'{k}={v}' for k, v in sorted(given.items()))]))}"


def fixed_keys(arguments: Sequence[str]) -> list[str]:
    """Options that a command line sets to one value, rather than to several."""
    written = [argument for argument in arguments if "=" in argument and not argument.startswith("-")]
    parsed = OverridesParser.create().parse_overrides(written)
    return sorted(override.key_or_group for override in parsed if not override.is_sweep_override())


def job_name(overrides: Sequence[str], fixed: Sequence[str]) -> str:
    """The name of a job: its overrides, without those that are the same for all jobs."""
    return slugify(",".join(sorted(one for one in overrides if one.lstrip("+~").partition("=")[0] not in fixed)))


def recipe_name(recipe: str | None, model: str) -> str | None:
    """The recipe, if the model chosen is the recipe's, after which it is named; None for another one, as in
    `+experiment=lego model=mlp`. A user's own, in another folder, may have any name."""
    shipped = (conf_dir() / "recipe" / f"{recipe}.yaml").is_file()
    return None if shipped and not str(recipe).startswith(f"{model}_") else recipe


def register_resolvers() -> None:
    """Registers the resolvers. Values from the command line are cached, so that jobs keep them."""
    OmegaConf.register_new_resolver("sweep_folder", lambda: sweep_folder(sys.argv[1:]), use_cache=True, replace=True)
    OmegaConf.register_new_resolver("fixed_keys", lambda: fixed_keys(sys.argv[1:]), use_cache=True, replace=True)
    OmegaConf.register_new_resolver("job_name", job_name, replace=True)
    OmegaConf.register_new_resolver("recipe_name", recipe_name, replace=True)


register_resolvers()  # on import, as the processes of a sweep import nothing else of the command line
