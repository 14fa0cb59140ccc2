"""Progress bars for loops and callbacks."""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from typing import TypeVar

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

T = TypeVar("T")


def format_duration(seconds: float) -> str:
    """Seconds as 1:02:03 or 2:03."""
    minutes, second = divmod(round(seconds), 60)
    hours, minute = divmod(minutes, 60)
    return f"{hours}:{minute:02d}:{second:02d}" if hours else f"{minute}:{second:02d}"


def is_interactive(console: Console) -> bool:
    """Whether a console can animate a bar: a terminal, or a notebook with ipywidgets."""
    return console.is_terminal or (console.is_jupyter and find_spec("ipywidgets") is not None)


def track_progress(items: Iterable[T], total: int, description: str) -> Iterator[T]:
    """Yields items while an interactive console shows their count and the time left."""
    with progress_bar(total, description) as step:
        for item in items:
            yield item
            step(1)


@contextmanager
def progress_bar(total: int, description: str) -> Iterator[Callable[[int], None]]:
    """Yields a function that advances the bar by a number of items."""
    console = Console(stderr=True)
    columns = TextColumn(description), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    with Progress(*columns, console=console, transient=True, disable=not is_interactive(console)) as bar:
        task = bar.add_task(description, total=total)
        yield lambda count: bar.advance(task, count)
