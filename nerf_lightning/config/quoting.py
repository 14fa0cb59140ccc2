"""Quotes text on command lines, and escapes it in configs, where Hydra or OmegaConf would misread it, such as paths.

Hydra's grammar parses parentheses, commas, `=`, `#` and non-ASCII letters; OmegaConf takes `${` for an interpolation.
"""

import os
import re
from collections.abc import Sequence
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, Quote, QuotedString, ValueType
from hydra.errors import HydraException

TEXT_KEYS = ("resume", "name", "method", "dataset.path", "dataset.name", "dataset.folder", "dataset.url")
"""Keys whose values are literal text."""
FOLDER_KEYS = ("hydra.run.dir", "hydra.sweep.dir")
"""Keys of folders that Hydra makes: literal text, and never several values."""


def escape_interpolations(value: Any) -> Any:
    """Escapes plain values, so that OmegaConf interpolates nothing in their text."""
    if isinstance(value, dict):
        return {key: escape_interpolations(item) for key, item in value.items()}
    if isinstance(value, list):
        return [escape_interpolations(item) for item in value]
    if not isinstance(value, str):
        return value
    return re.sub(r"(\\*)\$\{", lambda match: f"{match[1] * 2}\\${{", value)  # backslashes before it escape, too


def make_override(key: str, text: str | os.PathLike[str]) -> str:
    """Command-line argument that sets a key to literal text."""
    return f"{key}={_quote(key, escape_interpolations(os.fspath(text)))}"


def quote_overrides(arguments: Sequence[str], sweep: bool) -> list[str]:
    """Quotes values that Hydra would misread: those of text keys, and all that it cannot parse.

    Names of existing files and folders are literal. Other text may hold interpolations, be quoted by the user, or be a list in
    brackets; in a sweep it may be several values, separated by commas.
    """
    return [_quote_value(argument, sweep) for argument in arguments]


def _quote_value(argument: str, sweep: bool) -> str:
    key, _, value = argument.partition("=")
    if value in ("", "null") or key.startswith(("-", "~")):
        return argument
    parsed, name = _parse(argument), key.lstrip("+")
    if name not in (*TEXT_KEYS, *FOLDER_KEYS):
        return argument if parsed else f"{key}={_quote(key, value)}"
    if os.path.exists(os.path.expanduser(value)):
        return make_override(key, value)
    is_function = parsed and parsed.is_sweep_override() and parsed.value_type is not ValueType.SIMPLE_CHOICE_SWEEP
    if parsed and (value[0] in "'\"[" or (sweep and is_function)):
        return argument
    values = [part.strip() for part in value.split(",")] if sweep and name in TEXT_KEYS else [value]
    return f"{key}={','.join(_quote(key, part) for part in values)}"


def _quote(key: str, text: str) -> str:
    """Quotes text that Hydra would misread."""
    parsed = _parse(f"{key}={text}")
    if parsed is not None and not parsed.is_sweep_override() and parsed.value() == text:
        return text
    return QuotedString(text, Quote.single).with_quotes()


def _parse(argument: str) -> Override | None:
    """Parses an argument as Hydra does; None where it cannot."""
    try:
        return OverridesParser.create().parse_override(argument)
    except HydraException:
        return None
