"""Published figures, to stand beside one's own: never measured here, and always drawn as such."""

from pathlib import Path

import numpy as np
import pandas as pd

from nerf_lightning.errors import InputError
from nerf_lightning.utils.parsing import read_yaml

PUBLISHED = Path(__file__).with_name("published.yaml")
FORMAT = "publications as in published.yaml: source, hardware, scene, conditions, methods: {NAME: [dB, seconds]}"


def read_references(file: Path) -> pd.DataFrame:
    """Reads a YAML file of publications: a row for each method, with name, psnr, seconds (of training), scene and origin.

    Raises:
        InputError: where it cannot be read, or an entry lacks something or has an impossible value.
    """
    publications, rows = read_yaml(file, FORMAT), []
    try:
        for entry in publications.values():
            origin = f"{entry['conditions']}; {entry['hardware']}; {entry['source']}"
            for name, (psnr, seconds) in entry["methods"].items():
                if not (0 < psnr < np.inf and 0 < seconds < np.inf):
                    raise ValueError(f"{name}: {psnr} dB, {seconds} s")
                rows.append((str(name), psnr, seconds, str(entry["scene"]), origin))
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise InputError(file, "", f"{type(error).__name__}: {error}", FORMAT) from error
    return pd.DataFrame(rows, columns=["name", "psnr", "seconds", "scene", "origin"])
