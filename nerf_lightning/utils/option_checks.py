"""Checks of options against the signature they configure, with errors that name the config key."""

import inspect
import operator
import types
import typing
from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, Literal

from nerf_lightning.errors import InputError
from nerf_lightning.utils.text import suggest

MAX_INT = 2**63 - 1
"""Largest int64."""
MAX_FLOAT = (2 - 2**-23) * 2.0**127
"""Largest float32, the precision of nearly all computation."""


@dataclass(frozen=True)
class Bound:
    """A bound on an option, part of its annotation."""

    phrase: str
    compare: Callable[[Any, float], bool]
    value: float


Ge, Le = partial(Bound, "at least", operator.ge), partial(Bound, "at most", operator.le)
Gt, Lt = partial(Bound, "above", operator.gt), partial(Bound, "below", operator.lt)

PositiveFloat = Annotated[float, Gt(0)]
LossWeight = Annotated[float, Ge(0)]
"""Weight of a loss term; 0 disables it."""
Count = Annotated[int, Ge(1)]
GridSize = Annotated[int, Ge(1), Le(2**20)]
"""Grid resolution per axis: float32 resolves 16 positions per cell, and the cell count stays below `MAX_INT`."""
Log2Size = Annotated[int, Ge(1), Le(30)]
"""Log2 of a table's number of entries, which are indexed with 32 bits."""
Layers = Annotated[int, Ge(1), Le(1024)]
"""Number of layers or levels."""
Frequencies = Annotated[int, Ge(0), Le(127)]
"""Number of octaves of a frequency encoding: 2^128 overflows float32."""
Fraction = Annotated[float, Ge(0), Le(1)]
SHDegree = Annotated[int, Ge(0), Le(3)]
"""Degree of spherical harmonics."""
Seed = Annotated[int, Ge(0), Le(2**32 - 1)]
Port = Annotated[int, Ge(0), Le(65535)]
FramesPerSecond = Annotated[float, Ge(0.01), Le(1000)]
"""Frame rate: videos store frame durations in milliseconds."""


def check_options(
    where: str,
    target: Callable,
    options: Mapping[str, Any],
    bound_arguments: Container[str] = (),
    require_all: bool = True,
    source: str = "config",
) -> None:
    """Checks options against the parameters of a class or function.

    Args:
        where: config group, for the message; "" for the top level.
        target: class or function that takes the options.
        options: plain values by name.
        bound_arguments: names of arguments passed separately.
        require_all: whether missing options are errors.
        source: file or command that holds the options, for the message.

    Raises:
        InputError: an option is unknown, missing, of the wrong type, not finite or out of bounds.
    """
    parameters = inspect.signature(target).parameters
    hints = typing.get_type_hints(target.__init__ if inspect.isclass(target) else target, include_extras=True)
    open_ended = any(p.kind is inspect.Parameter.VAR_KEYWORD for p in parameters.values())
    prefix = f"{where}." if where else ""
    for name, value in options.items():
        if name not in parameters and open_ended:
            continue
        if name not in parameters:
            known = ", ".join(key for key in parameters if key not in bound_arguments and key != "self")
            raise InputError(source, prefix + name, "an unknown option", f"one of {known}", suggest(name, parameters))
        annotation = hints.get(name, Any)
        if not _matches_type(value, annotation):
            raise InputError(source, prefix + name, repr(value)[:60], _describe_type(annotation))
    for name, parameter in parameters.items():
        kinds = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)
        required = parameter.default is inspect.Parameter.empty and parameter.kind in kinds
        if require_all and required and name not in options and name not in bound_arguments:
            hint = f"give {prefix}{name}=, {_describe_type(hints.get(name, Any))}"
            raise InputError(source, prefix + name, "missing", hint=hint)


def _matches_type(value: Any, annotation: Any) -> bool:
    """Whether a YAML value matches an annotation; class annotations match any mapping or list."""
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is Annotated:
        bounds = [bound for bound in arguments[1:] if isinstance(bound, Bound)]
        return _matches_type(value, arguments[0]) and all(bound.compare(value, bound.value) for bound in bounds)
    if origin in (typing.Union, types.UnionType):
        return any(_matches_type(value, argument) for argument in arguments)
    if origin is Literal:
        return value in arguments
    if origin in (list, Sequence):
        return isinstance(value, list | tuple) and all(_matches_type(item, arguments[0]) for item in value)
    if annotation is dict:
        return isinstance(value, Mapping)
    if annotation is float:
        return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= MAX_FLOAT
    if annotation is int:
        return isinstance(value, int) and not isinstance(value, bool) and abs(value) <= MAX_INT
    if annotation in (str, bool, type(None)):
        return isinstance(value, annotation)
    # YAML holds no other classes, but a mapping may describe one (by its `_target_`).
    return annotation is Any or not inspect.isclass(annotation) or isinstance(value, (annotation, Mapping, list))


def _describe_type(annotation: Any) -> str:
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is Annotated:
        bounds = [f"{bound.phrase} {bound.value:.12g}" for bound in arguments[1:] if isinstance(bound, Bound)]
        return f"{_describe_type(arguments[0])} {' and '.join(bounds)}"
    if origin in (typing.Union, types.UnionType):
        return " or ".join(_describe_type(argument) for argument in arguments)
    if origin is Literal:
        return f"one of {', '.join(map(str, arguments))}"
    if origin in (list, Sequence):
        return f"a list, each {_describe_type(arguments[0])}"
    words = {int: "a whole number", float: "a number", str: "text", bool: "true or false", dict: "options by name"}
    return words.get(annotation, "null" if annotation is type(None) else "a value")
