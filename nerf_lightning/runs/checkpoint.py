"""Checkpoints as they are read back: tensors and plain values, whole to the last bit, and never code."""

import math
import pickle
import warnings
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from nerf_lightning.errors import InputError
from nerf_lightning.utils.memory import check_memory
from nerf_lightning.utils.untrusted import MOST_COUNTED, NONSENSE, existing_file

EXPECTED = "a whole checkpoint of tensors and plain values"
RENDERED: dict[str, type] = {"state_dict": dict}
"""What rendering needs."""
RESUMED: dict[str, type] = {
    **dict.fromkeys(("state_dict", "loops", "callbacks"), dict),
    **dict.fromkeys(("optimizer_states", "lr_schedulers"), list),
    **dict.fromkeys(("epoch", "global_step"), int),
}
"""What training needs to go on, as Lightning writes it."""
COUNTED = ("ready", "started", "processed", "completed", "_batches_that_stepped")
"""What Lightning counts of batches, steps and epochs."""
DAMAGED = (zipfile.BadZipFile, pickle.UnpicklingError, EOFError, OSError, *NONSENSE)
"""What zipfile and PyTorch raise for a damaged file."""


def read_checkpoint(path: Path, needed: Mapping[str, type] = RENDERED) -> dict[str, Any]:
    """Reads a checkpoint, which must hold what is `needed`.

    It is an archive that keeps a checksum (CRC-32) of each of its parts, as all versions of PyTorch since 1.6 write it. PyTorch
    does not compare them when it loads: here they are compared first, which takes half as long as loading does.

    Raises:
        InputError: where the file is missing, truncated, changed since it was written, larger than memory, or holds anything
            else than a state.
    """
    existing_file(path, "a checkpoint", "the run may have ended before its first one")
    check_memory(path, "", "a checkpoint", path.stat().st_size)
    best = path.with_name("best.ckpt")
    todo = f"{best.name} may be whole: copy it over this one" if path != best and best.exists() else ""
    try:
        with zipfile.ZipFile(path) as archive:
            packed = [one.filename for one in archive.infolist() if one.compress_type != zipfile.ZIP_STORED]
            changed = packed[0] if packed else archive.testzip()  # what is packed may have any size
        if changed is not None:
            raise InputError(path, changed, "other bytes than were written", EXPECTED, todo)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of kinds of files that are refused in a line
            state = torch.load(path, map_location="cpu", weights_only=True)
        if not isinstance(state, dict):
            raise InputError(path, "", f"a {type(state).__name__}", EXPECTED)
        for key, kind in needed.items():
            if not isinstance(state.get(key), kind):
                raise InputError(path, key, f"a {type(state.get(key)).__name__}", f"a {kind.__name__}", todo)
        _check_weights(path, state["state_dict"])
        for key, value in {**state, **state.get("callbacks", {})}.items():
            if isinstance(value, Tensor):  # which would take a name for an index
                raise InputError(path, str(key), "a tensor", "plain values by name", todo)
        if "loops" in needed and not _counts(state["loops"]):
            raise InputError(path, "loops", "something else", "counts of steps", todo)
        if "optimizer_states" in needed and not all(map(_of_optimizer, state["optimizer_states"])):
            raise InputError(path, "optimizer_states", "something else", "states of optimizers", todo)
    except InputError:
        raise
    except DAMAGED as error:
        raise InputError(path, "", str(error).split(".")[0], EXPECTED, todo) from error
    return state


def _check_weights(path: Path, weights: Mapping[str, Any]) -> None:
    for name, tensor in weights.items():
        # A view may show one number any amount of times: it asks for more memory than the file has bytes.
        if not isinstance(tensor, Tensor) or tensor.nbytes > tensor.untyped_storage().nbytes():
            raise InputError(path, f"state_dict.{name}", type(tensor).__name__, "a tensor with a number in each place")


def _counts(value: Any, name: str = "") -> bool:
    """Whether Lightning's progress is made of what it counts."""
    if isinstance(value, list):  # the states of data loaders
        return bool(value) and all(isinstance(one, dict) and _counts(one) for one in value)
    if isinstance(value, dict):
        return name not in COUNTED and all(_counts(one, str(key)) for key, one in value.items())
    return isinstance(value, int) and 0 <= value <= MOST_COUNTED


def _of_optimizer(value: Any) -> bool:
    """Whether it is made as PyTorch keeps an optimizer's state: values of each parameter, and groups of options, by name."""
    found = (value.get("state"), value.get("param_groups")) if isinstance(value, dict) else (None, None)
    if not isinstance(found[0], dict) or not isinstance(found[1], list):
        return False
    return all(isinstance(one, dict) for one in [*found[0].values(), *found[1]])


def check_optimizer(path: Path, optimizer: torch.optim.Optimizer) -> None:
    """Refuses a state that an optimizer has taken from a file, and could not make a step with.

    Raises:
        InputError: where an option is missing, of another kind than that which it was built with, or not finite; or where what
            it keeps of a parameter is of another shape, or less than of another one.
    """
    todo = "start the run anew"
    kept = {key for state in optimizer.state.values() for key in state}
    for group in optimizer.param_groups:
        if missing := sorted({*optimizer.defaults, "initial_lr"} - group.keys()):
            raise InputError(path, f"optimizer_states.{missing[0]}", "nothing", "what it was saved with", todo)
        for key, value in group.items():
            if key != "params" and not _alike(value, optimizer.defaults.get(key, 0.0)):
                raise InputError(path, f"optimizer_states.{key}", repr(value)[:60], "what it was saved with", todo)
        for parameter in group["params"]:
            state = optimizer.state[parameter]
            if state and (missing := sorted(kept - state.keys())):
                raise InputError(path, f"optimizer_states.{missing[0]}", "nothing", "what is kept of the others", todo)
            for key, value in state.items():
                if not _dense(value) or (value.shape != parameter.shape and value.numel() != 1):
                    found = f"{value.dtype} {tuple(value.shape)}" if isinstance(value, Tensor) else repr(value)[:60]
                    expected = f"a dense tensor of shape {tuple(parameter.shape)}"
                    raise InputError(path, f"optimizer_states.{key}", found, expected, todo)


def _dense(value: Any) -> bool:
    """Whether it is a tensor with a fraction in each place."""
    return isinstance(value, Tensor) and value.layout is torch.strided and value.is_floating_point()


def _alike(value: Any, built: Any) -> bool:
    """Whether an option of an optimizer can stand where another one did."""
    if isinstance(built, tuple | list):
        return isinstance(value, tuple | list) and len(value) == len(built) and all(map(_alike, value, built))
    if built is None or isinstance(built, bool):
        return value is None or value is False or value is built  # what is on asks for more of its state
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def check_finite(module: torch.nn.Module, where: object) -> None:
    """Refuses a system of which nothing can be drawn.

    Raises:
        InputError: where a weight is not a finite number. Training keeps them finite, unless it has broken down.
    """
    for name, tensor in module.state_dict().items():
        if tensor.is_floating_point() and not bool(tensor.isfinite().all()):
            todo = "the run has broken down: see its results.json"
            raise InputError(where, name, "nan or infinity", "weights that are finite numbers", todo)
