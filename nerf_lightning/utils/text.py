"""Small helpers for lists, sentences and web pages."""

import json
import os
from collections.abc import Sequence
from pathlib import Path
from urllib.parse import quote


def subsample(total: int, count: int | None) -> list[int]:
    """`count` evenly spaced indices of range(total); all of them for None."""
    if count is None or count >= total:
        return list(range(total))
    return [round((i + 0.5) * total / count - 0.5) for i in range(count)]


def join_truncated(names: Sequence[str], most: int) -> str:
    """At most so many of the names, and how many more there are."""
    rest = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + rest


def script_data(content: object) -> str:
    """Strict JSON in which nothing can end the script element that holds it."""
    return json.dumps(content, allow_nan=False).replace("<", "\\u003c")


def relative_url(folder: Path, file: Path) -> str:
    """The relative address of a file for a page in a folder."""
    return quote(Path(os.path.relpath(file, folder)).as_posix())
