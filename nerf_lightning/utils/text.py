"""Helpers for lists and messages."""

import difflib
from collections.abc import Iterable, Sequence


def subsample(total: int, count: int | None) -> list[int]:
    """`count` evenly spaced indices of range(total); all of them for None."""
    if count is None or count >= total:
        return list(range(total))
    return [round((i + 0.5) * total / count - 0.5) for i in range(count)]


def suggest(name: str, known: Iterable[str], prefix: str = "") -> str:
    """ "did you mean PREFIX+NAME?" with the closest known name; "" if none is close."""
    near = difflib.get_close_matches(name, list(known), 1)
    return f"did you mean {prefix}{near[0]}?" if near else ""


def join_truncated(names: Sequence[str], limit: int) -> str:
    """Joins at most `limit` names and appends the number left out."""
    rest = f" and {len(names) - limit} more" if len(names) > limit else ""
    return ", ".join(names[:limit]) + rest
