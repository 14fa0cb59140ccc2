"""Paths and other text that Hydra or OmegaConf would read as something else: quoted on command lines, escaped in configs.

Hydra's grammar takes parentheses, commas, `=`, `#` and non-ASCII letters apart; OmegaConf takes `${` for an interpolation.
"""

import os
import re
from collections.abc import Sequence
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, Quote, QuotedString, ValueType
from hydra.errors import HydraException

from nerf_lightning.errors import InputError
from nerf_lightning.utils.files import user_path


def escape(value: Any) -> Any:
    """Plain values as OmegaConf must be given them so that it interpolates nothing in their text."""
    if isinstance(value, dict):
        return {key: escape(one) for key, one in value.items()}
    if isinstance(value, list):
        return [escape(one) for one in value]
    if not isinstance(value, str):
        return value
    return re.sub(r"(\\*)\$\{", lambda found: f"{found[1] * 2}\\${{", value)  # backslashes before it escape, too


def override_of(key: str, text: str | os.PathLike[str]) -> str:
    """The command-line argument that sets a key to text, whatever its letters are: quoted where that is needed."""
    literal = escape(os.fspath(text))
    return f"{key}={literal if _means(parse_argument(f'{key}={literal}'), literal) else _quote(literal)}"


def parse_argument(argument: str) -> Override | None:
    """An argument as Hydra reads it; None where it cannot."""
    try:
        return OverridesParser.create().parse_override(argument)
    except HydraException:
        return None


def quote_texts(arguments: Sequence[str], keys: Sequence[str], sweep: bool | None = False) -> list[str]:
    """Quotes values that Hydra would not read as the text they are: those of some keys, and all that it cannot parse.

    The name of an existing file or folder is literal. Other text may hold interpolations, be quoted by the user, or be a list
    in brackets; in a sweep it may be several values, separated by commas.

    Args:
        arguments: of the command line.
        keys: whose values are text, such as paths.
        sweep: whether several values make several jobs; None where an experiment may say so.
    """
    return [argument if argument.startswith(("-", "~")) else _quoted(argument, keys, sweep) for argument in arguments]


def _quoted(argument: str, keys: Sequence[str], sweep: bool | None) -> str:
    key, equals, value = argument.partition("=")
    if not equals or value in ("", "null"):
        return argument
    parsed = parse_argument(argument)
    if key.lstrip("+") not in keys:
        return argument if parsed else f"{key}={_quote(value)}"
    values = [value] if key.startswith("hydra.") else [one.strip() for one in value.split(",")]
    if _exists(value):
        if sweep and len(values) > 1:
            print(f"{key}={value}: one value, as there is a file or folder of this name")
        return override_of(key, value)
    if parsed and (value[0] in "'\"[" or (sweep and _is_function(parsed))):
        return argument
    if len(values) > 1 and all(values) and (sweep or (sweep is None and all(map(_exists, values)))):
        if sweep:
            print(f"{key}: {len(values)} values to sweep: {' | '.join(values)}")
        return f"{key}={','.join(_quoted(f'{key}={one}', keys, False).partition('=')[2] for one in values)}"
    return argument if _means(parsed, value) else f"{key}={_quote(value)}"


def _quote(value: str) -> str:
    return QuotedString(value, Quote.single).with_quotes()


def _means(parsed: Override | None, text: str) -> bool:
    """Whether Hydra reads an argument's value as exactly this text."""
    return parsed is not None and not parsed.is_sweep_override() and parsed.value() == text


def _is_function(parsed: Override) -> bool:
    """Whether it is one of Hydra's sweeps, such as choice(a,b), but for values separated by commas."""
    return parsed.is_sweep_override() and parsed.value_type is not ValueType.SIMPLE_CHOICE_SWEEP


def _exists(text: str) -> bool:
    try:
        return user_path(text).exists()
    except (InputError, OSError):  # told where the path is opened
        return False
