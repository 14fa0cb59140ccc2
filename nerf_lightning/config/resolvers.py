"""Folders named after what the user asked for, as resolvers for conf/. Imports nothing heavy."""

import hashlib
import sys
from collections.abc import Sequence

import yaml
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf

from nerf_lightning.config import conf_dir

LONGEST = 120
"""Letters of a folder's name."""


def slug(text: str) -> str:
    """Text as the name of a folder. What is too long for one ends in a digest of the whole, so that names stay apart."""
    plain = "".join(c if c.isalnum() or c in "=.,_-+" else "-" for c in text) or "all"
    if len(plain) <= LONGEST:
        return plain
    return f"{plain[: LONGEST - 9]}-{hashlib.sha256(text.encode()).hexdigest()[:8]}"


def sweep_folder(arguments: Sequence[str]) -> str:
    """Where a sweep's jobs go: the same command line finds the same folder again.

    It is named after the run's name or else the experiment, and after all that is varied or fixed besides; flags and Hydra's
    own settings do not count.
    """
    given: dict[str, str] = {}
    for argument in arguments:
        key, equals, value = argument.lstrip("+").partition("=")
        if (equals or key.startswith("~")) and not key.startswith(("-", "hydra.", "hydra/")):
            given[key] = value
    experiment = given.pop("experiment", "run")
    name = given.pop("name", experiment)
    return f"outputs/{slug(name)}/{slug('_'.join(['sweep', *(f'{k}={v}' for k, v in sorted(given.items()))]))}"


def fixed_keys(arguments: Sequence[str]) -> list[str]:
    """Options that a command line sets to one value, rather than to several."""
    written = [argument for argument in arguments if "=" in argument and not argument.startswith("-")]
    parsed = OverridesParser.create().parse_overrides(written)
    return sorted(override.key_or_group for override in parsed if not override.is_sweep_override())


def job_name(overrides: Sequence[str], fixed: Sequence[str]) -> str:
    """What sets one job apart: those of its overrides that are not the same for all."""
    return slug(",".join(sorted(one for one in overrides if one.lstrip("+~").partition("=")[0] not in fixed)))


def recipe_of(recipe: str | None, model: str) -> str | None:
    """A recipe that was chosen, while the model it is for is still the one: `+experiment=lego model=mlp` takes another."""
    file = conf_dir() / "recipe" / f"{recipe}.yaml"
    if not file.is_file():
        return recipe  # a user's own, elsewhere
    for entry in yaml.safe_load(file.read_text(encoding="utf-8"))["defaults"]:
        if isinstance(entry, str):
            return recipe if recipe_of(entry, model) else None
        if "override /model" in entry:
            return recipe if entry["override /model"] == model else None
    return recipe


def register() -> None:
    """Makes the names known to configurations. What comes from the command line is cached: jobs take it over."""

    OmegaConf.register_new_resolver("sweep_folder", lambda: sweep_folder(sys.argv[1:]), use_cache=True, replace=True)
    OmegaConf.register_new_resolver("fixed_keys", lambda: fixed_keys(sys.argv[1:]), use_cache=True, replace=True)
    OmegaConf.register_new_resolver("job_name", job_name, replace=True)
    OmegaConf.register_new_resolver("recipe_of", recipe_of, replace=True)


register()  # on import: the processes of a sweep import this module, and nothing else of the command line
