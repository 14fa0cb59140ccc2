"""Turns off library warnings that tell users nothing, or tell them again."""

import logging
import os
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress

NOISY = ("lightning.pytorch", "lightning.fabric", "lightning.pytorch.utilities.rank_zero")
"""Loggers that report hardware and advice."""


def quiet() -> None:
    """Silences Lightning's remarks on hardware and settings that this package chooses itself."""
    for name in NOISY:
        logging.getLogger(name).setLevel(logging.WARNING)
    for message in (
        "does not have many workers",
        "GPU available but not used",
        "isinstance.treespec",
        "all_gather is dep",
    ):
        warnings.filterwarnings("ignore", f".*{message}.*")


class _Errors:
    """The process's standard error while libraries have none."""

    def __init__(self) -> None:
        self.lock = threading.Lock()
        self.users = 0
        self.kept: int | None = None

    def take(self) -> None:
        with self.lock:
            self.users += 1
            if self.users == 1:
                with suppress(OSError):  # without a terminal there is nothing to hide
                    self.kept = os.dup(2)
                    nothing = os.open(os.devnull, os.O_WRONLY)
                    os.dup2(nothing, 2)
                    os.close(nothing)

    def give_back(self) -> None:
        with self.lock:
            self.users -= 1
            if self.users == 0 and self.kept is not None:
                os.dup2(self.kept, 2)
                os.close(self.kept)
                self.kept = None


_ERRORS = _Errors()


@contextmanager
def native_errors_hidden() -> Iterator[None]:
    """Hides what libraries in C write to standard error, such as libpng, which has no other way to say what is wrong.

    Several threads may be inside at once. What Python writes there meanwhile is lost too: nothing long should run inside.
    """
    _ERRORS.take()
    try:
        yield
    finally:
        _ERRORS.give_back()
