"""Picks a few of many views."""


def evenly(total: int, count: int | None) -> list[int]:
    """`count` indices spread over range(total); all of them for None."""
    if count is None or count >= total:
        return list(range(total))
    return [round((i + 0.5) * total / count - 0.5) for i in range(count)]
