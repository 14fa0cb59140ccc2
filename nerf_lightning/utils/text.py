"""Small helpers for lists and sentences."""

from collections.abc import Sequence


def subsample(total: int, count: int | None) -> list[int]:
    """`count` evenly spaced indices of range(total); all of them for None."""
    if count is None or count >= total:
        return list(range(total))
    return [round((i + 0.5) * total / count - 0.5) for i in range(count)]


def join_truncated(names: Sequence[str], most: int) -> str:
    """At most so many of the names, and how many more there are."""
    rest = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + rest
