"""Shared parameter types of commands, and validation of their values. Fast to import."""

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
"""Output path; each command documents its default."""
RunPath = Annotated[
    Path | None,
    Parameter(help="A run's folder or compact.npz, or a folder of runs for its newest; default: the latest run."),
]
Photos = Annotated[Path | None, Parameter(help="Photos, if they have moved since training.")]
Device = Annotated[str, Parameter(help="auto (the best available), cpu, cuda or mps.")]


def command(function: Callable[P, T]) -> Callable[P, T]:
    """Decorator: checks arguments against annotations, and converts text to paths.

    Raises:
        InputError: (when called) a value violates its annotation.
    """
    signature, hints = inspect.signature(function), get_type_hints(function)
    parameters = signature.parameters

    @functools.wraps(function)
    def call_checked(*args: P.args, **kwargs: P.kwargs) -> T:
        bound = signature.bind(*args, **kwargs)
        for key, value in bound.arguments.items():
            if Path not in get_args(hints[key]) + (hints[key],):
                continue
            if isinstance(value, str):
                bound.arguments[key] = Path(value)
            elif isinstance(value, tuple):  # *paths
                bound.arguments[key] = tuple(map(Path, value))
        named = {key: value for key, value in bound.arguments.items() if parameters[key].kind is not VAR_POSITIONAL}
        check_options("", function, named, source=function.__name__.replace("_", "-"))
        return function(*bound.args, **bound.kwargs)

    return call_checked
