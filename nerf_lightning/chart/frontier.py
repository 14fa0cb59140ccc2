"""Which points no other beats."""

from collections.abc import Sequence


def two_figures(value: float) -> float:
    """A cost to two significant figures: what differs by less is noise of the clock (5.01 s and 5.03 s are both 5.0)."""
    return float(f"{value:.1e}")


def frontier(costs: Sequence[float], gains: Sequence[float]) -> list[int]:
    """The Pareto frontier: points to which no other is at least equal in both respects and better in one.

    Args:
        costs: of each point, less is better.
        gains: of each point, more is better.

    Returns:
        Their indices by rising cost; points that are equal in both are all on it, in the order given.
    """
    order = sorted(range(len(costs)), key=lambda i: (costs[i], -gains[i], i))
    chosen: list[int] = []
    for i in order:
        last = chosen[-1] if chosen else None
        if last is None or gains[i] > gains[last] or (gains[i] == gains[last] and costs[i] == costs[last]):
            chosen.append(i)
    return chosen
