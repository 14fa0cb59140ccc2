"""Ladders: the sizes a kind of field comes in, smallest first. Configuration, read from YAML."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nerf_lightning.errors import InputError
from nerf_lightning.utils.files import user_path
from nerf_lightning.utils.parsing import read_yaml

Options = dict[str, Any]


@dataclass(frozen=True)
class Ladder:
    """What there is to choose from."""

    rungs: list[Options]
    """Options of the model, smallest first."""
    samplers: list[Options]
    """Options of the sampler, coarsest first; none for pictures."""


def read_ladder(name: str, folder: Path) -> Ladder:
    """Reads a ladder.

    Args:
        name: one of those in the folder, or a YAML file of one's own.
        folder: where the shipped ones are.

    Raises:
        InputError: where there is none of that name, or it holds something else.
    """
    own = name.endswith((".yaml", ".yml"))
    known = sorted(one.stem for one in folder.glob("*.yaml"))
    if not own and name not in known:
        raise InputError("config", "ladder", repr(name), f"one of {', '.join(known)}, or a YAML file with `rungs`")
    path = user_path(name) if own else folder / f"{name}.yaml"
    plain = read_yaml(path, "a ladder in YAML")
    if not isinstance(plain, dict) or not _options(plain.get("rungs")) or len(plain["rungs"]) < 2:
        raise InputError(
            path, "rungs", "something else", "a list of two or more mappings of model options, each a plain value"
        )
    samplers = plain.get("samplers", [])
    if not _options(samplers):
        raise InputError(path, "samplers", "something else", "a list of mappings of sampler options")
    return Ladder(plain["rungs"], samplers)


def _options(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(one, dict) and all(map(_plain, one.values())) for one in value)


def _plain(value: Any) -> bool:
    return isinstance(value, int | str | None) or (isinstance(value, float) and math.isfinite(value))


def overrides(group: str, options: Options) -> list[str]:
    """Options as a command line would give them."""
    return [f"{group}.{key}={'null' if value is None else value}" for key, value in options.items()]
