"""Ladders: the sizes a kind of field comes in, smallest first. Configuration, read from YAML."""

from dataclasses import dataclass
from typing import Any

from nerf_lightning.config import conf_dir
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
    """Options of the sampler, coarsest first; none for images."""


def read_ladder(name: str) -> Ladder:
    """Reads a ladder: one of conf/ladders by name, or a YAML file of one's own.

    Raises:
        InputError: where there is none of that name, or it holds something else.
    """
    known = sorted(file.stem for file in (conf_dir() / "ladders").glob("*.yaml"))
    path = conf_dir() / "ladders" / f"{name}.yaml" if name in known else user_path(name)
    if not path.is_file():
        raise InputError("rightsize", "ladder", name, f"one of {', '.join(known)}, or a YAML file with `rungs`")
    content = read_yaml(path, "a ladder in YAML")
    lists = content if isinstance(content, dict) else {}
    for key, least in (("rungs", 2), ("samplers", 0)):
        found = lists.setdefault(key, [])
        if not isinstance(found, list) or len(found) < least or not all(isinstance(one, dict) for one in found):
            raise InputError(path, key, repr(found), f"a list of {least} or more mappings of options")
    return Ladder(lists["rungs"], lists["samplers"])
