"""Archives damaged as what they are: .npz files, .npy files, and checkpoints."""

import io
import struct
import warnings
import zipfile
import zlib
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import torch
from numpy.lib import format as npy

from benchmarks.hostile import code, trees, values

Members = list[tuple[str, bytes]]
"""Names and contents of an archive's files, in order; a name may stand twice."""
BLOCK = 1 << 20


def npy_bytes(array: np.ndarray) -> bytes:
    file = io.BytesIO()
    np.save(file, array, allow_pickle=False)
    return file.getvalue()


def npy_of(header: str, body: bytes = b"", version: int = 1) -> bytes:
    """An .npy file whose header says whatever it is given."""
    text = header.encode("latin1", "replace") + b"\n"
    size = struct.pack("<H" if version == 1 else "<I", len(text) % 2**16 if version == 1 else len(text))
    return b"\x93NUMPY" + bytes([version, 0]) + size + text + body


def header(rng: Random, array: np.ndarray) -> bytes:
    """An .npy file with a header that lies, or is none."""
    many = rng.choice((10**6, 10**9, 2**40, 2**62, 10**30))
    about = {"descr": npy.dtype_to_descr(array.dtype), "fortran_order": False, "shape": array.shape}
    texts = (
        str({**about, "shape": (many, *array.shape[1:])}),
        str({**about, "shape": (-1, *array.shape[1:])}),
        str({**about, "shape": (0, many, *array.shape[2:])}),
        str({**about, "shape": (1.5,)}),
        str({**about, "shape": (1,) * 70}),
        str({**about, "descr": rng.choice(("|O", "<U1000000000", "|V4", "<M8[ns]", "nope", "<f3", [("a", "<f4")]))}),
        str(about)[:-1],
        str(about) + "\x00",
        "(" * 150 + ")" * 150,
        "[" * values.DEEP,
        "__import__('os').getcwd()",
        "{'descr': '<f4', 'shape': (1,)}",
        "'",
        '"""',
    )
    return npy_of(rng.choice(texts), array.tobytes(), rng.choice((1, 1, 2, 3)))


def bomb(about: str, size: int) -> tuple[bytes, int]:
    """A deflated .npy file of zeros, and its unpacked size: a block that is repeated, so that it costs nothing to make."""
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    start = npy_of(about)
    packed = packer.compress(start) + packer.flush(zlib.Z_FULL_FLUSH)
    block = packer.compress(bytes(BLOCK)) + packer.flush(zlib.Z_FULL_FLUSH)
    count = size // BLOCK
    return packed + block * count + packer.flush(zlib.Z_FINISH), len(start) + count * BLOCK


def archive(members: Members, method: int = zipfile.ZIP_DEFLATED) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", method) as target, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of a name that stands twice
        for name, content in members:
            info = zipfile.ZipInfo(name)  # without the time of day: a case is the same each time
            info.compress_type = method
            target.writestr(info, content)
    return file.getvalue()


def with_bomb(members: Members, at: int, about: str, size: int) -> bytes:
    """An archive whose member `at` unpacks to `size` bytes; nothing but its checksum is wrong."""
    packed, whole = bomb(about, size)
    stored = [(name, packed if i == at else content) for i, (name, content) in enumerate(members)]
    data = bytearray(archive(stored, zipfile.ZIP_STORED))
    name = members[at][0].encode()
    for mark, method_at, sizes_at, name_at in ((b"PK\3\4", 8, 18, 30), (b"PK\1\2", 10, 20, 46)):
        found = data.find(mark)
        while found >= 0 and data[found + name_at : found + name_at + len(name)] != name:
            found = data.find(mark, found + 1)
        struct.pack_into("<H", data, found + method_at, zipfile.ZIP_DEFLATED)
        struct.pack_into("<II", data, found + sizes_at, len(packed), min(whole, 2**32 - 2))
    return bytes(data)


def values_changed(array: np.ndarray, rng: Random) -> np.ndarray:
    """One number, or all, replaced by a hostile one; or another type or shape."""
    what = rng.randrange(8)
    if what < 4 and array.size and array.dtype.kind in "fiu":
        found = array.astype(np.float64) if array.dtype.kind == "f" and rng.random() < 0.7 else array.copy()
        with np.errstate(all="ignore"):
            value = np.array(rng.choice(values.FLOATS)).astype(found.dtype)
        if rng.random() < 0.7:
            found.reshape(-1)[rng.randrange(array.size)] = value
        else:
            found[...] = value
        return found
    if what == 4:
        kind = rng.choice(("f2", "c8", "U3", "?", "i8", "u8", "M8[s]", "f8", "S1"))
        with np.errstate(all="ignore"):
            return array.astype(np.float64).astype(kind) if kind[0] != "M" else np.zeros(array.shape, kind)
    if what == 5:
        return rng.choice((array[None], array[..., None], array.reshape(-1), array.T, np.zeros(0), np.array(1.0)))
    if what == 6 and array.ndim:
        return rng.choice((array[:0], array[:1], array[..., :1], np.concatenate([array, array]), array[..., :0]))
    return rng.choice((array * 0, array + 1, -array if array.dtype.kind == "f" else array, np.roll(array, 1)))


def npy_file(data: bytes, rng: Random, marker: Path) -> tuple[bytes, str]:
    """An .npy file damaged, and what was done."""
    array = np.load(io.BytesIO(data), allow_pickle=False)
    what = rng.randrange(8)
    if what == 0:
        return code.array(rng, marker), "holds code"
    if what < 3:
        return header(rng, array), "a header that lies"
    return npy_bytes(values_changed(array, rng)), "other numbers"


def npz_file(data: bytes, rng: Random, marker: Path, room: int) -> tuple[bytes, str]:
    """An .npz file damaged, and what was done.

    Args:
        data, rng, marker: see elsewhere.
        room: bytes that a process may take; what unpacks to twice as many does not fit.
    """
    with zipfile.ZipFile(io.BytesIO(data)) as source:
        members = [(name, source.read(name)) for name in source.namelist()]
    at = rng.randrange(len(members))
    name, content = members[at]
    array = np.load(io.BytesIO(content), allow_pickle=False)
    word = name.removesuffix(".npy")
    match rng.randrange(14):
        case 0:
            members[at] = name, code.array(rng, marker)
            done = "holds code"
        case 1 | 2:
            members[at] = name, header(rng, array)
            done = "a header that lies"
        case 3:
            rows = np.atleast_1d(array)
            shape = (2 * room // max(1, rows[:1].nbytes), *rows.shape[1:])
            about = str({"descr": npy.dtype_to_descr(array.dtype), "fortran_order": False, "shape": shape})
            return with_bomb(members, at, about, 2 * room), f"{word}: unpacks to {2 * room} bytes"
        case 4:
            members.append(rng.choice(((name, content), (word, content), (name, b""), (name, npy_bytes(array * 0)))))
            done = "stands twice"
        case 5:
            other = rng.choice(
                (word, f"../{name}", f"{word}.NPY", "", "a\\b.npy", f"{word}\x00.npy", "x" * 5000, f"/{name}")
            )
            members[at] = other, content
            done = f"renamed to {other[:30]!r}"
        case 6:
            del members[at]
            done = "removed"
        case 7:
            one, two = rng.randrange(len(members)), rng.randrange(len(members))
            (first, a), (second, b) = members[one], members[two]
            members[one], members[two] = (first, b), (second, a)
            done = f"{first} and {second} swapped"
        case 8:
            members[at] = (
                name,
                rng.choice((b"", content[: len(content) // 2], b"text", content + content, code.pickled(rng, marker))),
            )
            done = "other bytes"
        case 9:
            return archive(members, rng.choice((zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA))), "packed otherwise"
        case 10:
            found = bytearray(archive(members))
            start = found.rfind(b"PK\1\2")
            struct.pack_into("<H", found, start + rng.choice((8, 10)), rng.choice((1, 9, 12, 97, 99)))
            return bytes(found), "encrypted, or packed in a way that nobody knows"
        case 11 if word == "header":
            text, done = trees.damaged(array.tobytes().decode(), rng, marker, as_json=True)
            members[at] = name, npy_bytes(np.frombuffer(text.encode("utf-8", "surrogatepass"), np.uint8))
        case _:
            members[at] = name, npy_bytes(values_changed(array, rng))
            done = "other numbers"
    return archive(members), f"{word}: {done}"


def header_spoilt(data: bytes, rng: Random, marker: Path) -> tuple[bytes, str]:
    """A compact file whose header, a document, is damaged."""
    with np.load(io.BytesIO(data), allow_pickle=False) as source:
        arrays: dict[str, Any] = {key: source[key] for key in source.files}
    text, done = trees.damaged(arrays["header"].tobytes().decode(), rng, marker, as_json=True)
    arrays["header"] = np.frombuffer(text.encode("utf-8", "surrogatepass"), np.uint8)
    return archive([(f"{key}.npy", npy_bytes(array)) for key, array in arrays.items()]), f"header: {done}"


def tensor_changed(tensor: torch.Tensor, rng: Random) -> Any:
    """A tensor with other numbers, of another shape or type, or none."""
    match rng.randrange(8):
        case 0 | 1 if tensor.is_floating_point():
            return torch.full_like(tensor, rng.choice((torch.nan, torch.inf, 3e38, -1e30, 1e-45)))
        case 2:
            return tensor.double() * 1e200 if tensor.is_floating_point() else tensor + 2**30
        case 3:
            return tensor.reshape(-1)[: tensor.numel() // 2].clone()
        case 4:
            return rng.choice(
                (tensor.to(torch.complex64), tensor.bool(), tensor.to(torch.float16), tensor.to(torch.int64))
            )
        case 5:
            return torch.zeros(1).expand(10**6, 10**6)  # four bytes in the file
        case 6:
            return rng.choice((tensor.tolist(), None, "text", tensor.to_sparse() if tensor.dim() else 0))
        case _:
            return tensor[None]


def checkpoint(data: bytes, rng: Random, marker: Path) -> tuple[bytes, str]:
    """A checkpoint damaged, and what was done."""
    if rng.random() < 0.2:
        return code.pickled(rng, marker), "holds code"
    if rng.random() < 0.15:
        plain: Any = rng.choice(
            ([], {}, "text", torch.zeros(3), {"state_dict": None}, {"state_dict": []}, 7, None, [1, 2])
        )
        return saved(plain), f"holds {str(plain)[:30]}"
    whole = {"": torch.load(io.BytesIO(data), map_location="cpu", weights_only=True)}
    by_depth: dict[int, list[trees.Place]] = {}
    for depth, place in trees.places(whole, ""):
        by_depth.setdefault(depth, []).append(place)
    node, key = rng.choice(by_depth[rng.choice(sorted(by_depth))])
    value = node[key]
    if isinstance(value, torch.Tensor):
        node[key] = tensor_changed(value, rng)
        done = "another tensor"
    elif rng.random() < 0.3 and isinstance(node, dict) and node is not whole:
        if rng.random() < 0.5:
            del node[key]
            done = "removed"
        else:
            node[f"{key}_"] = node.pop(key)
            done = "renamed"
    else:
        node[key] = values.plain(rng)
        done = f"{str(node[key])[:30]!r}"
    return saved(whole[""]), f"{str(key)[:40]}: {done}"


def saved(content: Any) -> bytes:
    file = io.BytesIO()
    torch.save(content, file)
    return file.getvalue()


def png(data: bytes, rng: Random) -> tuple[bytes, str]:
    """A PNG whose header says another size or depth, with the right checksum."""
    width, height = struct.unpack(">II", data[16:24])
    width = rng.choice((width, 0, 1, 30_000, 10**6, 2**31 - 1))
    height = rng.choice((height, 0, 1, 30_000, 2**31 - 1, 2**32 - 1))
    depth, colours = rng.choice((1, 2, 8, 16, 255)), rng.choice((0, 2, 3, 4, 6, 9))
    chunk = b"IHDR" + struct.pack(">IIBB", width, height, depth, colours) + data[26:29]
    found = data[:12] + chunk + struct.pack(">I", zlib.crc32(chunk)) + data[33:]
    return found, f"a header of {width}x{height}, {depth} bits, kind {colours}"
