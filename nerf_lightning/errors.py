"""The exception for bad input: one line that a user can act on."""

from typing import Any


class InputError(ValueError):
    """Bad input from outside: a file, a config key, a command-line value.

    The message is one line that names where, what key, what was found, what was expected and what to do.
    The command line prints it and exits with code 2.

    Args:
        where: file, folder or config key with the problem.
        key: entry inside it ("" if `where` is enough).
        found: what is there, in words.
        expected: what should be there, in words.
        todo: what the user can do about it ("" if `expected` is enough).
    """

    def __init__(self, where: object, key: str, found: str, expected: str, todo: str = ""):
        place = f"{where}: {key}" if key else f"{where}"
        line = f"{place}: found {found}, expected {expected}" + (f"; {todo}" if todo else "")
        super().__init__(" ".join(line.split()))

    def __reduce__(self) -> tuple[Any, ...]:
        """So that it comes back whole from another process."""
        return _told, (type(self), str(self))


def _told(kind: type[InputError], line: str) -> InputError:
    error = kind.__new__(kind)
    error.args = (line,)
    return error


class NoRoom(InputError):
    """A disk, a quota or a limit on files is full. Told as bad input is: the user can make room and go on."""
