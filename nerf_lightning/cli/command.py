"""Shared types of the commands' parameters, and the check of their values. Imports nothing heavy."""

import functools
import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, ParamSpec, TypeVar, get_args, get_type_hints

from cyclopts import Parameter

from nerf_lightning.utils.option_checks import check_options

P = ParamSpec("P")
VAR_POSITIONAL = inspect.Parameter.VAR_POSITIONAL
T = TypeVar("T")

Output = Annotated[Path | None, Parameter(alias="-o")]
"""What a command writes; each says where None puts it."""
RunPath = Annotated[
    Path | None,
    Parameter(help="A run's folder or compact.npz, or a folder of runs for its newest; default: the latest run."),
]
Photos = Annotated[Path | None, Parameter(help="The photos, if they have moved since training.")]
Device = Annotated[str, Parameter(help="auto, cpu, cuda or mps; auto takes the best there is.")]


def command(function: Callable[P, T]) -> Callable[P, T]:
    """Makes a function check its arguments against its annotations, wherever it is called from; text stands for a path.

    Raises:
        InputError: by the function, for a value that its annotation excludes.
    """
    signature, hints = inspect.signature(function), get_type_hints(function)
    parameters = signature.parameters

    @functools.wraps(function)
    def checked(*args: P.args, **kwargs: P.kwargs) -> T:
        bound = signature.bind(*args, **kwargs)
        for key, value in bound.arguments.items():
            if Path not in get_args(hints[key]) + (hints[key],):
                continue
            if isinstance(value, str):
                bound.arguments[key] = Path(value)
            elif isinstance(value, tuple):  # of *paths
                bound.arguments[key] = tuple(map(Path, value))
        given = {key: value for key, value in bound.arguments.items() if parameters[key].kind is not VAR_POSITIONAL}
        check_options("", function, given, source=function.__name__.replace("_", "-"))
        return function(*bound.args, **bound.kwargs)

    return checked
