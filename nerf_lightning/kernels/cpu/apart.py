"""Compiling in a process of its own: LLVM and numba keep some 0.2 GB of what they took until the process ends, and a run on a
new machine would hold that beside its photos."""

import os
import pickle
import subprocess
import sys
from importlib import import_module
from threading import Lock, Timer

from numba.core.dispatcher import Dispatcher

IDLE = 10.0
"""Seconds without a request after which the other process ends."""
START = f"import pickle, sys; sys.path[:] = pickle.load(sys.stdin.buffer); from {__name__} import serve; serve()"

_asking = Lock()
_helper: subprocess.Popen | None = None


def compile_apart(dispatcher: Dispatcher, signature: tuple) -> object:
    """Numba's `Dispatcher.compile`, but what its cache lacks is first put there by another process.

    Where that fails, for want of a folder, memory or time, it is compiled here, as numba would by itself.
    """
    cache = dispatcher._cache
    # Its list is read, not the kernel: numba loads that itself, and would do so twice.
    if cache._index_key(signature, dispatcher.targetctx.codegen()) not in cache._cache_file._load_index():
        ask(dispatcher, signature)
    return Dispatcher.compile(dispatcher, signature)


def ask(dispatcher: Dispatcher, signature: tuple) -> None:
    """Has the other process compile a kernel, and waits until it has."""
    function = dispatcher.py_func
    with _asking:
        try:
            helper = _started()
            pickle.dump((function.__module__, function.__qualname__, signature), helper.stdin)
            helper.stdin.flush()
            helper.stdout.readline()
        except (OSError, pickle.PicklingError):
            return  # the caller compiles


def _started() -> subprocess.Popen:
    """The other process, which finds modules where this one does; a new one where the last has ended."""
    global _helper
    if _helper is None or _helper.poll() is not None:
        pipe = subprocess.PIPE
        # A session of its own: a Ctrl-C is for those who wait for it. It ends when its input does.
        _helper = subprocess.Popen(
            [sys.executable, "-c", START], stdin=pipe, stdout=pipe, stderr=subprocess.DEVNULL, start_new_session=True
        )
        pickle.dump(sys.path, _helper.stdin)
    return _helper


def serve() -> None:
    """Compiles what is asked for on standard input, and answers each with an empty line."""
    answers = sys.stdout.buffer
    while True:
        end = Timer(IDLE, os._exit, (0,))
        end.daemon = True
        end.start()
        try:
            module, name, signature = pickle.load(sys.stdin.buffer)
        except EOFError:
            return
        end.cancel()
        try:
            Dispatcher.compile(getattr(import_module(module), name), signature)
        finally:
            answers.write(b"\n")
            answers.flush()
