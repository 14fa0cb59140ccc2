"""What must never run: pickles, YAML tags and configurations that would create a file, the marker."""

import io
import os
import pickle
import zipfile
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import torch


class Code:
    """Unpickled, it creates a file."""

    def __init__(self, how: int, marker: Path):
        self.how, self.marker = how, str(marker)

    def __reduce__(self) -> tuple:
        if self.how == 0:
            return os.system, (f"touch '{self.marker}'",)
        if self.how == 1:
            return exec, (f"open({self.marker!r}, 'w').close()",)
        return open, (self.marker, "w")


def some(rng: Random, marker: Path) -> Code:
    return Code(rng.randrange(3), marker)


def pickled(rng: Random, marker: Path) -> bytes:
    """A pickle, alone or as torch.save writes it, old or new."""
    content: Any = rng.choice((some(rng, marker), {"state_dict": some(rng, marker)}, [some(rng, marker)]))
    kind = rng.randrange(4)
    if kind == 0:
        return pickle.dumps(content, protocol=rng.choice((0, 2, 4)))
    file = io.BytesIO()
    if kind == 1:
        torch.save(content, file)
    elif kind == 2:
        torch.save(content, file, _use_new_zipfile_serialization=False)
    else:
        with zipfile.ZipFile(file, "w") as archive:  # as TorchScript lays its files out
            archive.writestr("archive/data.pkl", pickle.dumps(content, protocol=2))
            archive.writestr("archive/constants.pkl", pickle.dumps(content, protocol=2))
            archive.writestr("archive/code/__torch__.py", f"import os\nos.system({'touch ' + str(marker)!r})\n")
            archive.writestr("archive/version", "3\n")
    return file.getvalue()


def array(rng: Random, marker: Path) -> bytes:
    """An .npy file of objects."""
    file = io.BytesIO()
    np.save(file, np.array([some(rng, marker)], dtype=object), allow_pickle=True)
    return file.getvalue()


def tree(rng: Random, marker: Path) -> dict[str, Any]:
    """A node of a configuration that names what it should not."""
    shell, statement = f"touch '{marker}'", f"open({str(marker)!r}, 'w').close()"
    return rng.choice(
        (
            {"_target_": "os.system", "_args_": [shell]},
            {"_target_": "builtins.exec", "_args_": [statement]},
            {"_target_": "subprocess.check_call", "_args_": [["touch", str(marker)]]},
            {"_target_": "nerf_lightning.utils.files.write_json", "_args_": [str(marker), {}]},
            {"_target_": "hydra.utils.get_method", "path": "os.system"},
            {"_target_": "torch.load", "_args_": [str(marker)], "_partial_": True},
        )
    )


def yaml_text(rng: Random, marker: Path) -> str:
    """A value of YAML with a tag that some loaders follow, or that is none."""
    return rng.choice(
        (
            f"!!python/object/apply:os.system [\"touch '{marker}'\"]",
            f"!!python/object/new:subprocess.Popen [['touch', '{marker}']]",
            "!!python/name:os.system",
            *("!!binary x", "!nope 1", "*nothing", "&a *a", "{a: 1, a: 2", "@", "1:2:3", "2001-99-99", "<<: 1", "- -"),
            *("0b" + "1" * 400, "1_0" * 50, ".inf", "~", "? [a]", "!!float x", "!!int " + "9" * 5000),
        )
    )
