"""How a process ends when it is asked to: Ctrl-C (SIGINT) and SIGTERM do the same. Imports nothing heavy.

A signal raises `Interrupted` wherever the process is, so that blocks are left and temporary files go; inside `held` it only is
noted, until the block ends, an `interruptible` one begins, or `leave_if_asked` says that here is a good place. Exit codes are
those of shells, 128 + signal.
"""

import os
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import NoReturn

SIGNALS = (signal.SIGINT, signal.SIGTERM)
AGAIN = "the same command goes on"
_asked: int | None = None
_pending = False  # not raised yet
_holding = 0
_answer = ""  # told at once, where the process cannot end at once
_tell = sys.unraisablehook


class Interrupted(BaseException):
    """The process was asked to end.

    Not an Exception, as nothing has failed; not a KeyboardInterrupt, which Lightning would turn into an exit code of 1.

    Args:
        number: of the signal.
    """

    def __init__(self, number: int):
        super().__init__(number)
        self.number = number
        self.go_on = AGAIN
        """What the user can do, for the line that is printed."""


def listen() -> None:
    """From now on signals raise `Interrupted`; those before are forgotten."""
    global _asked, _pending, _tell
    _asked, _pending = None, False
    _take(_raise)
    if sys.unraisablehook is not _untold:
        _tell, sys.unraisablehook = sys.unraisablehook, _untold


def listen_again() -> None:
    """Takes signals back from libraries, and listens in processes that others have started."""
    _take(_raise)


def end_at_once() -> None:
    """From now on signals end the process with one line: before `listen`, while there is nothing to lose."""
    _take(_exit)


@contextmanager
def listening() -> Iterator[None]:
    """Listens for a while in somebody else's process. The signal then does there what it would have done."""
    global _asked, _pending
    before, tell = {number: signal.getsignal(number) for number in SIGNALS}, sys.unraisablehook
    listen()
    try:
        yield
    finally:
        number = _asked
        _asked, _pending = None, False
        sys.unraisablehook = tell
        if threading.current_thread() is threading.main_thread():
            for one, handler in before.items():
                signal.signal(one, handler)
        if number is not None:
            signal.raise_signal(number)


def asked() -> int | None:
    """The signal that asked this process to end, or None."""
    return _asked


def interrupt(number: int) -> NoReturn:
    """Raises `Interrupted`, once for the signals that have come so far."""
    global _pending
    _pending = False
    raise Interrupted(number)


def leave_if_asked() -> None:
    """Raises `Interrupted` if a signal has come, also one that was lost: what is raised in a clean-up is."""
    if _asked is not None:
        interrupt(_asked)


@contextmanager
def held(answer: str = "") -> Iterator[None]:
    """Holds signals back for a block that must be done whole or not at all; raises `Interrupted` after it.

    Args:
        answer: what the first signal is answered with on standard error, as soon as it comes; "" keeps what holds around it.
    """
    with _signals_in(_holding + 1, answer):
        yield
    if _pending and not _holding:
        leave_if_asked()


@contextmanager
def interruptible(answer: str) -> Iterator[None]:
    """Lets signals raise `Interrupted` in a block inside `held` that may be left at any point, such as rendering."""
    with _signals_in(0, answer):
        if _pending:
            leave_if_asked()
        yield


@contextmanager
def _signals_in(holding: int, answer: str) -> Iterator[None]:
    global _holding, _answer
    before, _holding, _answer = (_holding, _answer), holding, answer or _answer
    try:
        yield
    finally:
        _holding, _answer = before


def be_deaf() -> None:
    """From now on signals do nothing: all is done or told, and the process is on its way out."""
    _take(signal.SIG_IGN)


def leave(number: int, told: str) -> NoReturn:
    """Ends the process after a signal, with one line."""
    be_deaf()
    print(f"nerf_lightning: interrupted ({signal.Signals(number).name}); {told}", file=sys.stderr, flush=True)
    sys.exit(128 + number)


def _take(handler: object) -> None:
    if threading.current_thread() is threading.main_thread():  # elsewhere Python does not allow it
        for number in SIGNALS:
            signal.signal(number, handler)  # type: ignore[arg-type]


def _raise(number: int, frame: FrameType | None) -> None:
    global _asked, _pending
    if _asked is None and _answer:  # not printed, as a print may be going on
        os.write(2, f"nerf_lightning: {signal.Signals(number).name}: {_answer}\n".encode())
    _asked, _pending = _asked or number, True
    if not _holding:
        interrupt(_asked)


def _untold(what: "sys.UnraisableHookArgs") -> None:
    """Of what is lost in a clean-up Python prints a traceback. Of a signal nothing is: `leave_if_asked` raises it again."""
    if not isinstance(what.exc_value, Interrupted):
        _tell(what)


def _exit(number: int, frame: FrameType | None) -> None:
    os.write(2, f"nerf_lightning: interrupted ({signal.Signals(number).name}) before anything began\n".encode())
    os._exit(128 + number)
