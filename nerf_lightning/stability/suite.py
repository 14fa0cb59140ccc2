"""All cells of a suite, side by side on the machine's cores, each done once."""

import multiprocessing
import os
import signal
import time
from collections.abc import Generator, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from pathlib import Path
from threading import Thread

import psutil

from nerf_lightning.errors import InputError
from nerf_lightning.stability.cell import Cell, Outcome, run
from nerf_lightning.stability.conditions import CONDITIONS
from nerf_lightning.stability.methods import METHODS
from nerf_lightning.utils.machine import cores
from nerf_lightning.utils.memory import check_memory
from nerf_lightning.utils.signals import CONTINUE, defer_signals

QUICK = (
    *("clean", "white, small object", "rate x10", "wrong background flag", "OpenGL poses", "shuffled poses"),
    *("2D: clean", "2D: rate x10", "2D: L = 40"),
)
"""Conditions of the shortest suite."""
GRACE = 5.0
"""Seconds that processes have to end by themselves."""


def cells_of(conditions: Sequence[str], methods: Sequence[str], seeds: int, steps: int) -> list[Cell]:
    """The cells to train: one seed of conditions that must be refused, and no control method under a control condition."""
    chosen = [
        Cell(condition.name, method, seed, steps)
        for condition in CONDITIONS
        if condition.name in conditions
        for method in methods
        if METHODS[method].flat == condition.flat and not (METHODS[method].control and condition.control)
        for seed in range(1 if condition.hopeless else seeds)
    ]
    return [cell for cell in chosen if cell.options is not None]


def run_all(cells: Sequence[Cell], root: Path, workers: int | None) -> Generator[tuple[Cell, Outcome]]:
    """Trains cells in processes of one thread each; yields them as they end. They end with this process: cells that are done
    have been written down.

    Raises:
        InputError: where memory does not do for the processes.
    """
    count = min(workers or cores(), len(cells))
    if workers is not None:  # each is about as large as this process
        check_memory("config", "workers", f"{count:,} processes", count * psutil.Process().memory_info().rss)
    context = multiprocessing.get_context("spawn")  # numba and torch's threads do not survive a fork
    with ProcessPoolExecutor(count, context, _prepare) as pool:
        try:
            with _unheard(), defer_signals():
                pending = {pool.submit(run, cell, root): cell for cell in cells}
            for done in as_completed(pending):
                yield pending[done], done.result()
        except BaseException as error:
            with defer_signals():
                pool.shutdown(wait=False, cancel_futures=True)
                _end(multiprocessing.active_children())
            if isinstance(error, BrokenProcessPool):
                lost, enough = "a process that the system ended", f"memory for {count:,} of them"
                raise InputError("config", "workers", lost, enough, f"give fewer; {CONTINUE}") from error
            raise


def _end(children: Sequence[multiprocessing.process.BaseProcess]) -> None:
    """Asks processes to end, and ends those that do not: one may wait for what another held when that ended."""
    for child in children:
        child.terminate()
    end = time.monotonic() + GRACE
    for child in children:
        child.join(max(0.0, end - time.monotonic()))
        child.kill()


@contextmanager
def _unheard() -> Iterator[None]:
    """Processes that start meanwhile never hear Ctrl-C, which a terminal sends to them too: their parent ends them."""
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _prepare() -> None:
    """Of a process: it ends with its parent, and computes in one thread, since more would wait for each other."""
    Thread(target=_end_with_parent, daemon=True).start()
    os.environ["OMP_NUM_THREADS"] = "1"
    import torch

    torch.set_num_threads(1)


def _end_with_parent() -> None:
    """Where the parent was killed, nobody else ends its processes."""
    parent = multiprocessing.parent_process()
    assert parent is not None  # the pool's
    parent.join()
    os._exit(1)
