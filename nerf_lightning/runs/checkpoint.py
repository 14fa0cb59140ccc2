"""Safe loading of checkpoints: checksums verified, tensors and plain values only."""

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
"""Checkpoint entries, as Lightning names them, that rendering and resuming need."""


def read_checkpoint(path: Path, keys: Sequence[str] = RENDER_KEYS) -> dict[str, Any]:
    """Reads a checkpoint with the given keys.

    Verifies the CRC-32 of each archive member first, which PyTorch does not; this takes half as long as loading.

    Raises:
        InputError: the file is missing, damaged, larger than free memory, or no checkpoint.
    """
    require_file(path, "a checkpoint", "the run may have ended before its first checkpoint")
    try:
        with zipfile.ZipFile(path) as archive:
            check_memory(path, "", "a checkpoint", sum(part.file_size for part in archive.infolist()))
            damaged = archive.testzip()
        if damaged is not None:
            raise InputError(path, damaged, "damaged: its checksum differs", hint="copy it again")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about file types that are rejected below
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
    """Checks that all weights are finite: NaN and infinity mean that training diverged.

    Raises:
        InputError: for the first tensor that is not.
    """
    for name, tensor in module.state_dict().items():
        if tensor.is_floating_point() and not bool(tensor.isfinite().all()):
            hint = "training diverged: see the run's results.json"
            raise InputError(where, name, "weights are not finite", hint=hint)
