"""The one reader of text files that come from outside, with limits on size, depth, aliases and numbers. Nothing is executed."""

import json
import math
from pathlib import Path
from typing import Any

import yaml

from nerf_lightning.errors import InputError
from nerf_lightning.utils.memory import check_memory

DEEPEST = 64
"""Most mappings and lists in each other. Python stops at 1000 nested calls, of which up to ten a level are taken by whatever
walks through a file (OmegaConf); files of this package have at most 8 levels."""
JSON_COST = 32
"""Bytes of memory that a byte of JSON may need: `{},` becomes 72 bytes, beside the text itself."""
YAML_SIZE = 1 << 18
"""Most bytes of a YAML file. What is read from YAML was written by hand or holds a line for each option: a run's config.yaml
has 5 kB. PyYAML takes some seconds for this size already."""
YAML_VALUES = YAML_SIZE // 8
"""Most values in a YAML file, aliases written out: as many as a file of the most bytes holds without any, 8 bytes each."""
DIGITS = 308
"""Most digits of a whole number: with more, no float can hold it."""
MOST_COUNTED = 2**53
"""More than any training has of steps or rays; a float holds every whole number up to it."""
NONSENSE = (ArithmeticError, AttributeError, LookupError, MemoryError, RuntimeError, TypeError, ValueError)
"""What Python and its libraries say to values that cannot be, where a file's content goes through code that trusts it."""


def existing_file(path: Path, expected: str = "a file", missing: str = "check the path") -> Path:
    """Refuses a folder, and what is no ordinary file: a pipe or a device may never end; `missing` is what to do without one."""
    try:
        folder, file = path.is_dir(), path.is_file()
    except (OSError, ValueError) as error:  # a name too long, or with a zero byte
        raise InputError(path, "", f"no file's name ({error})", expected, missing) from error
    if folder:
        raise InputError(path, "", "a folder", expected)
    if not file:
        raise InputError(path, "", "nothing there", expected, missing)
    return path


def read_content(path: Path, expected: str = "a file that can be read", cost: float = 1) -> bytes:
    """All bytes of a file.

    Args:
        path: the file.
        expected: for messages.
        cost: bytes of memory that will be needed for each of the file.

    Raises:
        InputError: it is not there, cannot be read, or is too large for the memory that is left.
    """
    existing_file(path, expected)
    try:
        check_memory(path, "", "content", path.stat().st_size * cost)
        return path.read_bytes()
    except OSError as error:
        raise InputError(path, "", f"something unreadable ({error})", expected) from error


def read_json(path: Path, expected: str, todo: str = "export it again") -> Any:
    """What a JSON file holds, in UTF-8, UTF-16 or UTF-32.

    Args:
        path: the file.
        expected, todo: for messages.

    Raises:
        InputError: as `read_content`, and where it is no JSON or breaks a limit.
    """
    return parsed_json(read_content(path, expected, JSON_COST), path, expected, todo)


def parsed_json(content: bytes, where: object, expected: str, todo: str = "") -> Any:
    """As `read_json`, of a file's content; `where` it came from is for messages.

    Raises:
        InputError: it is no JSON, or breaks a limit.
    """
    try:
        found = json.loads(content.decode(json.detect_encoding(content)), parse_int=_whole)
        _check_depth(found)
    except json.JSONDecodeError as error:
        broken = f"broken JSON at line {error.lineno}, column {error.colno} ({error.msg})"
        raise InputError(where, "", broken, expected, todo) from error
    except RecursionError as error:
        raise InputError(where, "", _too_deep(), expected, todo) from error
    except (ValueError, MemoryError) as error:
        unreadable = f"something unreadable ({type(error).__name__}: {error})"
        raise InputError(where, "", unreadable, expected, todo) from error
    return found


def read_yaml(path: Path, expected: str, todo: str = "") -> Any:
    """What a YAML file holds: plain values.

    Args:
        path: the file.
        expected, todo: for messages.

    Raises:
        InputError: as `read_content`, and where it is no YAML or breaks a limit.
    """
    if (size := existing_file(path, expected).stat().st_size) > YAML_SIZE:
        raise InputError(path, "", f"{size} bytes", f"{expected}, of at most {YAML_SIZE} bytes", todo)
    content = read_content(path, expected)
    try:
        return yaml.load(content.decode("utf-8-sig"), _Limited)  # noqa: S506  (a SafeLoader, and stricter)
    except (yaml.YAMLError, *NONSENSE) as error:
        # Beside its own errors, PyYAML lets through whatever Python says to a date, a number or a truth value that is none.
        raise InputError(path, "", f"no YAML ({error})", expected, todo) from error


class _Limited(yaml.SafeLoader):
    """A SafeLoader that stops at the limits, before any value is made."""

    def __init__(self, text: str):
        super().__init__(text)
        self.depth = self.values = 0
        self.written_out: dict[str, int] = {}
        """Values below each anchor."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        event = self.peek_event()
        if isinstance(event, yaml.AliasEvent):
            # One that is not there, or is being read still, has no count yet.
            if event.anchor in self.anchors and event.anchor not in self.written_out:
                raise yaml.YAMLError(f"the alias *{event.anchor} stands in what it stands for")
            self._count(self.written_out.get(str(event.anchor), 0))
            return super().compose_node(parent, index)
        before, self.depth = self.values, self.depth + 1
        if self.depth > DEEPEST:
            raise yaml.YAMLError(_too_deep())
        self._count(1)
        node = super().compose_node(parent, index)
        self.depth -= 1
        if event.anchor is not None:
            self.written_out[event.anchor] = self.values - before
        return node

    def _count(self, more: int) -> None:
        self.values += more
        if self.values > YAML_VALUES:
            raise yaml.YAMLError(f"more than {YAML_VALUES} values, aliases written out")


def number(value: Any) -> float:
    """A number that was kept in a file.

    Raises:
        TypeError, ValueError, OverflowError: it is none, or no float can hold it.
    """
    found = float(value)
    if not math.isfinite(found):
        raise ValueError(f"{found}, where a finite number was kept")
    return found


def count(value: Any) -> int:
    """How many of something, as it was kept in a file.

    Raises:
        TypeError, ValueError: it is no number, below zero, or above `MOST_COUNTED`.
    """
    if not 0 <= value <= MOST_COUNTED:
        raise ValueError(f"{str(value)[:20]}, where a count was kept")
    return int(value)


def _whole_in_yaml(loader: _Limited, node: Any) -> int:
    _check_digits(len(node.value))
    return loader.construct_yaml_int(node)


_Limited.add_constructor("tag:yaml.org,2002:int", _whole_in_yaml)


def _whole(digits: str) -> int:
    _check_digits(len(digits))
    return int(digits)


def _check_digits(digits: int) -> None:
    if digits > DIGITS:
        raise ValueError(f"a whole number of {digits} digits")


def _check_depth(value: Any) -> None:
    level = [value]
    for _ in range(DEEPEST):
        inside = [one.values() if isinstance(one, dict) else one for one in level if isinstance(one, dict | list)]
        level = [one for values in inside for one in values if isinstance(one, dict | list)]
        if not level:
            return
    raise RecursionError


def _too_deep() -> str:
    return f"more than {DEEPEST} levels of mappings and lists"
