"""Numbers, texts and pieces of documents that readers trip over."""

import math
from random import Random

FLOATS = (
    *(math.nan, math.inf, -math.inf, -0.0, 0.0, -1.0, 0.5, 1e-30, 1e-320, 1e9, 1e12, 1e19, 3.4e38, 1e39, -1e39),
    *(1e300, -1e300, 1.7e308),
)
"""Not numbers, beyond float32 or beyond what squares of it hold, denormal, or of the wrong sign."""
INTEGERS = (0, -1, 1, 2, 255, 2**31, 2**32, 2**33, 10**12, 2**63, 2**64 - 1, -(2**63), 10**400)
"""Beyond a C int, a C long, or a float."""
TEXTS = (
    *("", " ", "nan", "null", "-1", "True", "x" * 5000, "x/" * 2500, "../../x", "~nosuchuser/x", "/dev/null/x"),
    *("a\0b", "a\nb", "é\u202e\u0000", "\ud800", "%s%n", "[", "{", "'", '"', "${nope}", "${oc.env:HOME}", "${seed}"),
)
"""Empty, too long, of nobody's home, special to one layer or another, or no Unicode."""
DEEP = 5000
"""Levels of nesting: more than Python's stack takes."""
WIDE, LEVELS = 9, 9
"""Aliases a level, and levels of them: 9^9 leaves in a few hundred letters."""


def number(rng: Random) -> float | int:
    """A hostile number."""
    return rng.choice((*FLOATS, *INTEGERS))


def nested(rng: Random) -> str:
    """JSON, and so YAML, nested deeply; sometimes without an end."""
    opening, closing = rng.choice((("[", "]"), ('{"a":', "}"), ("[{", "}]")))
    return opening * DEEP + ("1" + closing * DEEP if rng.random() < 0.7 else "")


def multiplied() -> str:
    """A YAML value whose aliases multiply."""
    levels = [f"&a0 [{', '.join(['x'] * WIDE)}]"]
    levels += [f"&a{i} [{', '.join([f'*a{i - 1}'] * WIDE)}]" for i in range(1, LEVELS)]
    return f"[{', '.join(levels)}]"


def plain(rng: Random) -> object:
    """A hostile value for a tree of plain values."""
    kind = rng.randrange(8)
    if kind < 4:
        return number(rng)
    if kind == 4:
        return rng.choice(TEXTS)
    return rng.choice((None, True, False, [], {}, [[]], {"": None}, [None], ["a"], {"a": 1}, [[1.0], [1.0, 2.0]]))
