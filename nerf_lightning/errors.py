"""The exception for bad input: one line that a user can act on."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

MAX_FOUND_CHARS = 500
"""Most letters of a problem: a file may hold any amount, and the line is for a terminal."""


class InputError(ValueError):
    """Bad input from outside. Its message is one line, which the command line prints before it exits with code 2:

    "where: key: found X, expected Y; hint" for a wrong value, "where: key: problem; hint" for all else (missing, damaged, ...).

    Args:
        where: file, folder, config group or command.
        key: entry in it, or "".
        problem: the value in words; without `expected` what is wrong, as a clause: "no such file".
        expected: the valid values in words.
        hint: what the user can do about it.
    """

    def __init__(self, where: object, key: str, problem: str, expected: str = "", hint: str = ""):
        location = f"{where}: {key}" if key else f"{where}"
        if len(problem) > MAX_FOUND_CHARS:
            problem = f"{problem[:MAX_FOUND_CHARS]}..."
        self.location, self.problem, self.expected, self.hint = location, problem, expected, hint
        text = f"found {problem}, expected {expected}" if expected else problem
        line = f"{location}: {text}" + (f"; {hint}" if hint else "")
        super().__init__(" ".join(line.split()))

    def __reduce__(self) -> tuple[Any, ...]:
        """So that it comes back whole from another process."""
        return type(self), (self.location, "", self.problem, self.expected, self.hint)


class DiskFullError(InputError):
    """A disk, a quota or a limit on file sizes is full; the user can free space and resume."""


@contextmanager
def attribute_errors_to(path: object) -> Iterator[None]:
    """Messages about options name the file that holds them, instead of the command line's configuration."""
    try:
        yield
    except InputError as error:
        key = error.location.removeprefix("config").removeprefix(": ")
        raise InputError(path, key, error.problem, error.expected, error.hint) from error
