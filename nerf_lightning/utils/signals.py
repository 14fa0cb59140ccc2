"""SIGINT (Ctrl-C) and SIGTERM: the first shuts down cleanly with exit code 128 + signal, the second exits at once."""

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from types import FrameType

SIGNALS = (signal.SIGINT, signal.SIGTERM)
RESUME_HINT = "the same command continues"
_received_signal: int | None = None
_is_deferred = False


class SignalInterrupt(BaseException):
    """Raised for a signal; `hint` says how to continue. Not a KeyboardInterrupt, which Lightning turns into exit code 1."""

    def __init__(self, signum: int, hint: str = RESUME_HINT):
        super().__init__(signum)
        self.signum, self.hint = signum, hint


@contextmanager
def handle_signals() -> Iterator[None]:
    """Makes signals raise `SignalInterrupt`, at the end of an enclosing `defer_signals`. No effect when nested."""
    global _received_signal
    handlers = {signum: signal.getsignal(signum) for signum in SIGNALS}
    if _handle in handlers.values() or threading.current_thread() is not threading.main_thread():
        yield
        return
    install_handlers()
    hook = sys.unraisablehook
    sys.unraisablehook = partial(_resend_signal, hook)
    try:
        yield
    finally:
        _received_signal, sys.unraisablehook = None, hook
        for signum, handler in handlers.items():
            signal.signal(signum, handler)


def install_handlers() -> None:
    """Installs both handlers, also over Lightning's, whose SIGTERM handler exits with code 0."""
    if threading.current_thread() is threading.main_thread():
        for signum in SIGNALS:
            signal.signal(signum, _handle)


@contextmanager
def exit_on_signal() -> Iterator[None]:
    """As `handle_signals`, but prints one line and exits."""
    with handle_signals():
        try:
            yield
        except BaseException as error:  # a library may have wrapped `SignalInterrupt`
            if _received_signal is None:
                raise
            hint = error.hint if isinstance(error, SignalInterrupt) else RESUME_HINT
            name = signal.Signals(_received_signal).name
            print(f"nerf_lightning: interrupted ({name}); {hint}", file=sys.stderr, flush=True)
            sys.exit(128 + _received_signal)


@contextmanager
def defer_signals(deferred: bool = True) -> Iterator[None]:
    """Defers the first signal to the end of a block; False allows it again inside such a block."""
    global _is_deferred
    before, _is_deferred = _is_deferred, deferred
    try:
        if not deferred:
            raise_if_signalled()
        yield
    finally:
        _is_deferred = before
    if not _is_deferred:
        raise_if_signalled()


def received_signal() -> int | None:
    """The signal received, or None."""
    return _received_signal


def raise_if_signalled() -> None:
    if _received_signal is not None:
        raise SignalInterrupt(_received_signal)


def _resend_signal(hook: Callable[["sys.UnraisableHookArgs"], object], lost: "sys.UnraisableHookArgs") -> None:
    """Resends a signal whose `SignalInterrupt` was swallowed, as in Numba's compiler callbacks."""
    global _received_signal
    if isinstance(lost.exc_value, SignalInterrupt):
        _received_signal = None
        threading.Timer(0.02, os.kill, (os.getpid(), lost.exc_value.signum)).start()
    else:
        hook(lost)


def _handle(signum: int, frame: FrameType | None) -> None:
    global _received_signal
    if _received_signal is not None:
        os._exit(128 + signum)
    _received_signal = signum
    if _is_deferred:  # os.write, as a print may be under way
        os.write(2, f"nerf_lightning: {signal.Signals(signum).name}: stopping soon; again stops at once\n".encode())
    else:
        raise_if_signalled()
