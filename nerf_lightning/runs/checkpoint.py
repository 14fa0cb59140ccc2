"""Checkpoints as they are read back: tensors and plain values, whole to the last bit, and never code."""

import pickle
import warnings
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from nerf_lightning.errors import InputError
from nerf_lightning.utils.memory import check_memory
from nerf_lightning.utils.parsing import DAMAGE_ERRORS, require_file

RENDER_KEYS = ("state_dict",)
RESUME_KEYS = (*RENDER_KEYS, "loops", "callbacks", "optimizer_states", "lr_schedulers", "epoch", "global_step")
"""What rendering and training need, as Lightning writes it."""


def read_checkpoint(path: Path, keys: Sequence[str] = RENDER_KEYS) -> dict[str, Any]:
    """Reads a checkpoint with the given keys.

    It is an archive with a checksum (CRC-32) of each part. PyTorch does not compare them when it loads: here they are compared
    first, which takes half as long as loading does.

    Raises:
        InputError: the file is missing, truncated, changed since it was written, larger than memory, or no state.
    """
    require_file(path, "a checkpoint", "the run may have ended before its first one")
    try:
        with zipfile.ZipFile(path) as archive:
            check_memory(path, "", "a checkpoint", sum(part.file_size for part in archive.infolist()))
            damaged = archive.testzip()
        if damaged is not None:
            raise InputError(path, damaged, "damaged: its checksum differs", hint="copy it again")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about kinds of files that are refused below
            state = torch.load(path, map_location="cpu", weights_only=True)
    except (pickle.UnpicklingError, *DAMAGE_ERRORS) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(path, "", f"no checkpoint of tensors and plain values ({str(error).split('.')[0]})") from error
    missing = [key for key in keys if not isinstance(state, dict) or key not in state]
    if missing:
        raise InputError(path, missing[0], "missing")
    return state


def check_finite(module: torch.nn.Module, where: object) -> None:
    """Refuses weights that are not finite: training keeps them finite unless it has broken down.

    Raises:
        InputError: for the first.
    """
    for name, tensor in module.state_dict().items():
        if tensor.is_floating_point() and not bool(tensor.isfinite().all()):
            hint = "the run has broken down: see its results.json"
            raise InputError(where, name, "weights are not finite", hint=hint)
