"""Where a search begins, or goes on: its folder says what is searched for."""

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from nerf_lightning.errors import InputError
from nerf_lightning.rightsize.choose import Target
from nerf_lightning.rightsize.ladder import Ladder
from nerf_lightning.runs.folder import plain_config
from nerf_lightning.runs.owner import LOCK
from nerf_lightning.utils.files import write_json
from nerf_lightning.utils.parsing import read_json

PLAN, REPORT = "search.json", "rightsize.json"
"""What is searched for; and what was found, written last."""


def begin(output: Path, cfg: DictConfig, target: Target, ladder: Ladder) -> None:
    """Writes down what is searched for, unless the same search was interrupted here.

    Raises:
        InputError: where the folder holds anything else, or a search that is done.
    """
    plan = {"target": asdict(target), "ladder": asdict(ladder), "config": plain_config(cfg)}
    plan = json.loads(json.dumps(plan), parse_constant=str)  # as it is read, without nan and infinity
    if output.exists() and (not output.is_dir() or any(one.name != LOCK for one in output.iterdir())):
        try:
            found: dict[str, Any] | None = read_json(output / PLAN, "what a search is for")
        except InputError:
            found = None
        if found == plan and not (output / REPORT).exists():
            print(f"{output}: goes on with the search that was interrupted", flush=True)
            return
        what = "something" if found is None else "another search" if found != plan else "a finished search"
        raise InputError(output, "", f"{what} in it already", "a folder for this search alone", "give output=DIR")
    write_json(output / PLAN, plan)
