"""Files damaged as bytes or words, whatever they hold."""

import math
import struct
from random import Random

from benchmarks.hostile import values


def as_bytes(data: bytes, rng: Random) -> tuple[bytes, str]:
    """A file's content with some of its bytes changed, and what was done."""
    size = len(data)
    if not size:
        return rng.randbytes(rng.choice((1, 100))), "random bytes"
    at, length = rng.randrange(size), rng.choice((1, 8, 64, max(1, size // 4)))
    other = rng.randrange(size)
    match rng.randrange(10):
        case 0 | 1:
            found = bytearray(data)
            for _ in range(rng.choice((1, 2, 8, 64))):
                found[rng.randrange(size)] ^= 1 << rng.randrange(8)
            return bytes(found), "bits flipped"
        case 2:
            return data[:at], f"cut to {at} of {size} bytes"
        case 3:
            return data[:at] + bytes(length) + data[at + length :], f"zeros from {at}"
        case 4:
            return data[:at] + rng.randbytes(length) + data[at + length :], f"random bytes from {at}"
        case 5:
            return data[:at] + data[at : at + length] + data[at:], f"a stretch from {at} twice"
        case 6:
            low, high = sorted((at, other))
            return data[:low] + data[high : high + length] + data[low:high] + data[high + length :], "a stretch moved"
        case 7:
            return data + rng.choice((data, b"\0", rng.randbytes(100))), "more at the end"
        case 8:
            return rng.choice(
                (b"", b"\0", b"{}", b"[]", b"null", b"PK", b"\xff\xfe", b"\x80\x02", b"a" * 10_000)
            ), "little"
        case _:
            return planted(data, rng)


def planted(data: bytes, rng: Random) -> tuple[bytes, str]:
    """A hostile number in the place of another, at a multiple of four bytes."""
    form = rng.choice("dddfqQiI")
    number = values.number(rng)
    if form in "df":
        packed = struct.pack("<" + form, clipped(number, form))
    else:
        whole = int(number) if math.isfinite(clipped(number, "d")) else 0
        bits = 8 * struct.calcsize("<" + form)
        packed = (whole % 2**bits).to_bytes(bits // 8, "little")
    at = 4 * rng.randrange(max(1, len(data) // 4))
    return data[:at] + packed + data[at + len(packed) :], f"{str(number)[:20]} as {form} at {at}"


def clipped(number: float, form: str) -> float:
    """The number as a float of some size: infinite where that cannot hold it."""
    try:
        return struct.unpack("<" + form, struct.pack("<" + form, float(number)))[0]
    except OverflowError:
        return math.inf if number > 0 else -math.inf


def as_words(text: str, rng: Random) -> tuple[str, str]:
    """A text with one of its words changed, and what was done."""
    words = text.split(" ")
    at = rng.randrange(len(words))
    match rng.randrange(4):
        case 0 | 1:
            words[at] = str(values.number(rng)) if rng.random() < 0.9 else "9" * 6000
            return " ".join(words), f"word {at}: {words[at][:30]}"
        case 2:
            words[at] = rng.choice(values.TEXTS)
            return " ".join(words), f"word {at}: {words[at][:30]!r}"
        case _:
            del words[at]
            return " ".join(words), f"word {at} removed"
