"""What is damaged, and which command lines read it."""

import os
import shutil
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from random import Random

from benchmarks.hostile import archives, code, damage, grammar, trees
from benchmarks.hostile.case import Command
from benchmarks.hostile.good import FIELDS, HASHGRID, ON_RAYS, PICTURE

UNHARMED = 0.03
"""Share of the cases whose input is left as it is: the command line must take it."""
AROUND = 0.08
"""Share of those whose file is not damaged inside, but is missing, a folder, a link, or another file."""


@dataclass(frozen=True)
class Kind:
    """A kind of input."""

    name: str
    weight: int
    """How many of the cases are about it, against the others."""
    copied: tuple[str, ...]
    """Of the good inputs."""
    harmed: tuple[str, ...]
    """Patterns of the files that are damaged, one of which is taken."""
    commands: tuple[tuple[str, ...], ...]
    """Verb and arguments, one of which is taken; training on rays gets a field of a few numbers."""


def of_photos(path: str) -> tuple[tuple[str, ...], ...]:
    return (
        ("train", *ON_RAYS, f"dataset.path={path}"),
        ("train", *ON_RAYS, f"dataset.path={path}"),
        ("inspect", f"scene={path}"),
    )


def of_run(path: str) -> tuple[tuple[str, ...], ...]:
    """Verbs on a run's folder or its compact file."""
    return (
        ("render", f"run={path}", "frames=1", "output=film"),
        ("render", f"run={path}", "frames=2", "output=film.webp", "channels=depth"),
        ("evaluate", f"run={path}", "output=evaluated"),
        ("export", f"run={path}", "loss=100", "output=small.npz"),
        ("export", f"run={path}", "format=npz", "resolution=4", "output=voxels.npz"),
    )


def of_folder(path: str) -> tuple[tuple[str, ...], ...]:
    return (
        *of_run(path),
        ("train", f"resume={path}", "budget.steps=2"),
        ("export", f"run={path}", "format=transforms", "output=posed"),
    )


POSES = "poses_bounds.npy"
ON_SCENE = ("train", *ON_RAYS, "dataset.path=scene.npz")
CHARTS = (("chart", "runs=runs"), ("gallery", "runs=runs"))
ALONG = ("render", "run=compact.npz", "output=film")
ANY = (
    *(
        *of_photos("scene.npz"),
        *of_photos("scene.npz"),
        *of_run("run"),
        ("train", *PICTURE, "dataset.path=picture.png"),
    ),
    *(("capture", "print=page.pdf"), ("chart", "runs=run"), ("gallery", "runs=run")),
)
KINDS = (
    Kind("npz", 10, ("scene.npz",), ("scene.npz",), of_photos("scene.npz")),
    Kind("blender", 7, ("blender",), ("*.json", "*.json", "*/*.png"), of_photos("blender")),
    Kind("nerfstudio", 9, ("nerfstudio",), (*["transforms.json"] * 3, "images/*.png"), of_photos("nerfstudio")),
    Kind("COLMAP, binary", 7, ("colmap",), ("sparse/0/*.bin",), of_photos("colmap")),
    Kind("COLMAP, text", 5, ("colmap_text",), ("sparse/0/*.txt",), of_photos("colmap_text")),
    Kind("LLFF", 6, ("llff",), (POSES, POSES, POSES, "images/*.png"), of_photos("llff")),
    Kind("picture", 4, ("picture.png",), ("picture.png",), (("train", *PICTURE, "dataset.path=picture.png"),)),
    Kind("photo", 2, ("photo.jpg",), ("photo.jpg",), (("train", *PICTURE, "dataset.path=photo.jpg"),)),
    Kind("checkpoint", 10, ("run", "scene.npz"), ("checkpoints/last.ckpt",), of_folder("run")),
    Kind("compact file", 9, ("compact.npz", "scene.npz"), ("compact.npz",), of_run("compact.npz")),
    Kind("run folder", 10, ("run", "scene.npz"), ("config.yaml", "scene.json"), of_folder("run")),
    Kind("results", 6, ("runs",), ("*/results.json", "*/results.json", "*/config.yaml"), CHARTS),
    Kind(
        "tag layout", 3, ("layout.yaml",), ("layout.yaml",), (("capture", "print=page.pdf", "tags.layout=layout.yaml"),)
    ),
    Kind(
        *("ladder", 1, ("ladder.yaml", "scene.npz"), ("ladder.yaml",)),
        (("rightsize", *ON_SCENE[1:], *HASHGRID, "ladder=ladder.yaml", "output=sized"),),
    ),
    Kind("camera path", 2, ("path.json", "compact.npz"), ("path.json",), ((*ALONG, "path=path.json"),)),
    Kind("viewer's path", 1, ("viewer.json", "compact.npz"), ("viewer.json",), ((*ALONG, "path=viewer.json"),)),
    Kind(
        *("experiment", 4, ("experiment.yaml", "scene.npz"), ("experiment.yaml",)),
        ((*ON_SCENE, "+experiment=experiment.yaml"),),
    ),
    Kind("command line", 30, ("scene.npz", "run", "picture.png"), (), ANY),
    Kind("command of a suite", 2, (), (), (("stability", "methods=[nosuch]"),)),
)


def module(verb: str) -> str:
    """What stands behind its `python -m`."""
    return "nerf_lightning" if verb == "train" else f"nerf_lightning.{verb}"


@dataclass(frozen=True)
class Case:
    """A case, before its input is written: it follows from its seed and number alone."""

    seed: int
    number: int

    @property
    def kind(self) -> Kind:
        return self.random().choices(KINDS, [kind.weight for kind in KINDS])[0]

    def random(self) -> Random:
        return Random(f"{self.seed} {self.number}")


def prepare(
    case: Case, good: Path, room: int, options: Mapping[str, Mapping[str, str]], work: Path, marker: Path
) -> tuple[Command, str]:
    """Writes a case's input into `work`; returns the command line and what was done to it, "" if nothing.

    Args:
        case: which.
        good: folder of the good inputs.
        room: bytes that the process may take.
        options: of each verb, see `good.VERBS`.
        work, marker: see `case.run`.
    """
    rng, kind = Random(f"{case.seed} {case.number} input"), case.kind
    for name in kind.copied:
        place = good / name if name != "compact.npz" else good / "run" / name
        (shutil.copytree if place.is_dir() else shutil.copyfile)(place, work / name)
    verb, *arguments = rng.choice(kind.commands)
    if verb == "train" and "dataset=photos" in arguments:
        arguments += rng.choice(FIELDS)
    command = Command(module(verb), tuple(arguments), good=bool(kind.harmed))
    if rng.random() < UNHARMED and kind.copied:  # the others have no good input that ends soon
        return command, ""
    if not kind.harmed:
        return grammar.spoilt(command, rng, options)
    found = sorted((work / kind.copied[0]).glob(rng.choice(kind.harmed))) if (work / kind.copied[0]).is_dir() else []
    target = rng.choice(found) if found else work / rng.choice(kind.harmed)
    words = (around if rng.random() < AROUND else inside)(target, rng, marker, room, good)
    return command, f"{target.relative_to(work)}: {words}"


def around(path: Path, rng: Random, marker: Path, room: int, good: Path) -> str:
    """Damages not what a file holds but what it is."""
    kind = rng.randrange(9)
    if kind == 0:
        path.rename(path.with_name(path.stem + "_" + path.suffix))
        return "renamed"
    if kind == 1:
        other = rng.choice(sorted(one for one in good.rglob("*") if one.is_file() and one.stat().st_size))
        shutil.copyfile(other, path)
        return f"is {other.relative_to(good)} instead"
    if kind == 2:
        path.write_bytes(code.pickled(rng, marker))
        return "a pickle instead"
    path.unlink()
    if kind == 3:
        path.mkdir()
        return "a folder"
    if kind == 4:
        path.symlink_to("nowhere")
        return "a link to nowhere"
    if kind == 5:
        path.symlink_to(path.name)
        return "a link to itself"
    if kind == 6:
        os.mkfifo(path)
        return "a pipe"
    if kind == 7:
        path.write_bytes(b"")
        return "empty"
    return "missing"


def inside(path: Path, rng: Random, marker: Path, room: int, good: Path) -> str:
    """Damages what a file holds: as what it is, or as bytes."""
    data = path.read_bytes()
    found, words = damage.as_bytes(data, rng)
    if rng.random() < 0.75 and path.suffix in AS_WHAT_IT_IS:
        found, words = AS_WHAT_IT_IS[path.suffix](data, rng, marker, room)
    path.write_bytes(found)
    return words


def _json(data: bytes, rng: Random, marker: Path, room: int) -> tuple[bytes, str]:
    text, words = trees.damaged(data.decode(), rng, marker, as_json=True)
    return text.encode("utf-8", "surrogatepass"), words


def _yaml(data: bytes, rng: Random, marker: Path, room: int) -> tuple[bytes, str]:
    head = data[: data.index(b"\n") + 1] if data.startswith(b"#") else b""
    if rng.random() < 0.15:
        return head + grammar.yaml_text(rng).encode("utf-8", "surrogatepass"), "another document"
    text, words = trees.damaged(data.decode(), rng, marker, as_json=False)
    return head + text.encode("utf-8", "surrogatepass"), words


def _npz(data: bytes, rng: Random, marker: Path, room: int) -> tuple[bytes, str]:
    if b"header.npy" in data and rng.random() < 0.4:
        return archives.header_spoilt(data, rng, marker)
    return archives.npz_file(data, rng, marker, room)


def _words(data: bytes, rng: Random, marker: Path, room: int) -> tuple[bytes, str]:
    text, words = damage.as_words(data.decode(), rng)
    return text.encode("utf-8", "surrogatepass"), words


AS_WHAT_IT_IS: dict[str, Callable[[bytes, Random, Path, int], tuple[bytes, str]]] = {
    ".json": _json,
    ".yaml": _yaml,
    ".npz": _npz,
    ".txt": _words,
    ".npy": lambda data, rng, marker, room: archives.npy_file(data, rng, marker),
    ".ckpt": lambda data, rng, marker, room: archives.checkpoint(data, rng, marker),
    ".bin": lambda data, rng, marker, room: damage.planted(data, rng),
    ".png": lambda data, rng, marker, room: archives.png(data, rng),
}
"""How files are damaged as what they are, by suffix."""
