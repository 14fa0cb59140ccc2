"""Checks options against the signature they configure, so that errors name the config's keys."""

import difflib
import inspect
import types
import typing
from collections.abc import Callable, Container, Mapping
from dataclasses import dataclass
from typing import Annotated, Any

from nerf_lightning.errors import InputError


@dataclass(frozen=True)
class AtLeast:
    """A lower bound on an option, stated in its annotation."""

    value: float


Count = Annotated[int, AtLeast(1)]
"""A whole number of at least one."""


def check_options(
    where: str, target: Callable, options: Mapping[str, Any], given: Container[str] = (), complete: bool = True
) -> None:
    """Raises InputError if an option is unknown, missing, of the wrong type or below its bound.

    Args:
        where: the config group, for the message; "" for the top level.
        target: the class or function that takes the options.
        options: names and plain values.
        given: names of further arguments that will be passed.
        complete: whether the target gets no other arguments later.
    """
    parameters = inspect.signature(target).parameters
    hints = typing.get_type_hints(target.__init__ if inspect.isclass(target) else target, include_extras=True)
    open_ended = any(p.kind is inspect.Parameter.VAR_KEYWORD for p in parameters.values())
    prefix = f"{where}." if where else ""
    for name, value in options.items():
        if name not in parameters:
            if open_ended:
                continue
            near = difflib.get_close_matches(name, parameters, 1)
            known = ", ".join(key for key in parameters if key not in given and key != "self")
            raise InputError(
                "config",
                prefix + name,
                "an unknown option",
                f"one of {known}",
                f"did you mean {near[0]}?" if near else "",
            )
        hint = hints.get(name, Any)
        if not _fits(value, hint):
            raise InputError("config", prefix + name, repr(value), _describe(hint))
    for name, parameter in parameters.items():
        required = parameter.default is inspect.Parameter.empty and parameter.kind in (
            inspect.Parameter.POSITIONAL_OR_KEYWORD,
            inspect.Parameter.KEYWORD_ONLY,
        )
        if complete and required and name not in options and name not in given:
            raise InputError(
                "config", prefix + name, "nothing", _describe(hints.get(name, Any)), f"give {prefix}{name}=..."
            )


def _fits(value: Any, hint: Any) -> bool:
    """Whether a value from YAML fits an annotation; annotations other than plain values always fit."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin is Annotated:
        bounds = [bound.value for bound in arguments[1:] if isinstance(bound, AtLeast)]
        return _fits(value, arguments[0]) and (isinstance(value, bool) or all(value >= bound for bound in bounds))
    if origin in (typing.Union, types.UnionType):
        return any(_fits(value, argument) for argument in arguments)
    if origin is list:
        return isinstance(value, list) and all(_fits(item, arguments[0]) for item in value)
    if origin is dict:
        return isinstance(value, Mapping) and all(_fits(item, arguments[1]) for item in value.values())
    if hint is float:
        return isinstance(value, int | float) and not isinstance(value, bool)
    if hint is int:
        return isinstance(value, int) and not isinstance(value, bool)
    if hint in (str, bool, type(None)):
        return isinstance(value, hint)
    # YAML cannot hold other classes, but a mapping may describe one (with a target of its own).
    return not inspect.isclass(hint) or isinstance(value, Mapping | list)


def _describe(hint: Any) -> str:
    """An annotation in words."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin is Annotated:
        bounds = [f"at least {bound.value:g}" for bound in arguments[1:] if isinstance(bound, AtLeast)]
        return " ".join([_describe(arguments[0]), *bounds])
    if origin in (typing.Union, types.UnionType):
        return " or ".join(_describe(argument) for argument in arguments)
    if origin is list:
        return f"a list, each {_describe(arguments[0])}"
    if origin is dict:
        return f"names, each with {_describe(arguments[1])}"
    words = {int: "a whole number", float: "a number", str: "text", bool: "true or false", type(None): "null"}
    return words.get(hint, "a value")
