"""The exception for bad input: one line that a user can act on."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

MAX_FOUND_CHARS = 500
"""Most letters of what was found: a file may hold any amount, and the line is for a terminal."""


class InputError(ValueError):
    """Bad input from outside: a file, a config key, a command-line value.

    The message is one line that names where, what key, what was found, what was expected and what to do.
    The command line prints it and exits with code 2.

    Args:
        where: file, folder or config key with the problem.
        key: entry inside it ("" if `where` is enough).
        found: what is there, in words.
        expected: what should be there, in words.
        hint: what the user can do about it ("" if `expected` is enough).
    """

    def __init__(self, where: object, key: str, found: str, expected: str, hint: str = ""):
        location = f"{where}: {key}" if key else f"{where}"
        if len(found) > MAX_FOUND_CHARS:
            found = f"{found[:MAX_FOUND_CHARS]}..."
        self.location, self.found, self.expected, self.hint = location, found, expected, hint
        line = f"{location}: found {found}, expected {expected}" + (f"; {hint}" if hint else "")
        super().__init__(" ".join(line.split()))

    def __reduce__(self) -> tuple[Any, ...]:
        """So that it comes back whole from another process."""
        return type(self), (self.location, "", self.found, self.expected, self.hint)


class DiskFullError(InputError):
    """A disk, a quota or a limit on files is full. Told as bad input is: the user can make room and go on."""


@contextmanager
def attribute_errors_to(path: object) -> Iterator[None]:
    """Messages about options name the file that holds them, instead of the command line's configuration."""
    try:
        yield
    except InputError as error:
        key = error.location.removeprefix("config").removeprefix(": ")
        raise InputError(path, key, error.found, error.expected, error.hint) from error
