"""Names in a sentence."""

from collections.abc import Sequence


def first_few(names: Sequence[str], most: int) -> str:
    """At most so many of the names, and how many more there are."""
    rest = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + rest
