"""Damaged files of every kind are read or refused in a line, within limits of memory and time; nothing is executed."""

import json
import pickle
import resource
import shutil
import signal
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

import numpy as np
import psutil
import pytest
import torch
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from nerf_lightning.dataset import Views, open_scene
from nerf_lightning.errors import InputError
from nerf_lightning.runs.checkpoint import RESUME_KEYS, read_checkpoint
from nerf_lightning.runs.compact import encode_system, load_compact
from nerf_lightning.runs.folder import config_to_dict, load_config, load_run
from nerf_lightning.synthetic.bricks import bricks
from nerf_lightning.utils.parsing import read_json, read_npy, read_yaml
from tests.helpers.scene_writers import write_scene

MAX_BYTES, MAX_SECONDS = 1 << 30, 10
EXAMPLES = 20
"""Damaged versions of each file: 20 seconds for all."""

Reader = Callable[[Path], object]


def read_scene(path: Path) -> object:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return open_scene(str(path))


READERS: dict[str, tuple[str, str, Reader]] = {
    # name: file to damage, what to read, reader
    "json": ("figures.json", "figures.json", lambda path: read_json(path, "figures")),
    "yaml": ("options.yaml", "options.yaml", lambda path: read_yaml(path, "options")),
    "npy": ("llff/poses_bounds.npy", "llff/poses_bounds.npy", read_npy),
    "checkpoint": ("run/checkpoints/last.ckpt", "run/checkpoints/last.ckpt", lambda p: read_checkpoint(p, RESUME_KEYS)),
    "run config": ("run/config.yaml", "run", load_config),
    "run scene": ("run/scene.json", "run", load_run),
    "compact": ("run/compact.npz", "run/compact.npz", load_compact),
    "npz": ("npz/s.npz", "npz/s.npz", read_scene),
    "transforms": ("transforms/transforms.json", "transforms", read_scene),
    "blender": ("blender/transforms_train.json", "blender", read_scene),
    "llff": ("llff/poses_bounds.npy", "llff", read_scene),
    **{f"colmap {name}": (f"colmap/sparse/0/{name}.bin", "colmap", read_scene) for name in ("cameras", "images")},
    **{f"text {name}": (f"text/sparse/0/{name}.txt", "text", read_scene) for name in ("cameras", "images")},
    "photo": ("transforms/images/0000.png", "transforms", read_scene),
}


@pytest.fixture(scope="session")
def whole(tmp_path_factory: pytest.TempPathFactory, small_run: Path, isolated_cache: None) -> Path:
    """A valid file of each kind."""
    folder = tmp_path_factory.mktemp("readers")
    views: Views = bricks(size=8, train_views=5, val_views=1).train
    for kind in ("npz", "transforms", "blender", "llff", "colmap", "text"):
        write_scene(kind, folder / kind, views)
    (folder / "figures.json").write_text(json.dumps({"psnr": 31.5, "curve": [[0.5, 10, 20.25]], "name": "ü"}))
    (folder / "options.yaml").write_text(yaml.safe_dump({"a": {"b": [1, 2.5, None, "x"]}, "day": "2020-01-02"}))
    shutil.copytree(small_run, folder / "run")
    run = load_run(folder / "run")
    (folder / "run" / "compact.npz").write_bytes(encode_system(run.system, "byte", config_to_dict(run.cfg), run.scene))
    return folder


TEXTS = (b"-1", b"1e999", b"9" * 400, b"nan", b"null", b"[]", b"{}", b"\xff", b"\0", b"- " * 2000, b"[" * 2000, b"*a")


@st.composite
def damage(draw: st.DrawFn) -> Callable[[bytes], bytes]:
    """A mutation: bits flipped, cut short, a part removed, repeated or replaced by an absurd value."""
    kind = draw(st.sampled_from(("flip", "cut", "remove", "repeat", "replace")))
    at, length = draw(st.integers(0, 9999)), draw(st.integers(1, 16))
    bit, text = draw(st.integers(0, 7)), draw(st.sampled_from(TEXTS))

    def apply(content: bytes) -> bytes:
        start = at * len(content) // 10_000
        end = start + length
        if kind == "flip":
            return content[:start] + bytes([content[start] ^ 1 << bit]) + content[start + 1 :]
        middle = {"cut": b"", "remove": content[end:], "repeat": content[start:], "replace": text + content[end:]}[kind]
        return content[: end if kind == "repeat" else start] + middle

    return apply


@contextmanager
def limit_memory() -> Iterator[None]:
    """Fails a block that allocates or lasts too much."""

    def expire(signum: int, frame: FrameType | None) -> None:
        raise TimeoutError(f"longer than {MAX_SECONDS} s")

    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    handler = signal.signal(signal.SIGPROF, expire)
    resource.setrlimit(resource.RLIMIT_AS, (psutil.Process().memory_info().vms + MAX_BYTES, hard))
    signal.setitimer(signal.ITIMER_PROF, MAX_SECONDS)  # of work, not of waiting for a core
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, handler)
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


@pytest.mark.parametrize("name", READERS)
def test_readers_damaged_files_load_or_raise(name: str, whole: Path):
    damaged, source, read = READERS[name]
    good = (whole / damaged).read_bytes()
    read(whole / source)

    @settings(max_examples=EXAMPLES)
    @given(st.lists(damage(), min_size=1, max_size=3))
    def check(mutations: list[Callable[[bytes], bytes]]) -> None:
        content = good
        for mutate in mutations:
            content = mutate(content or b"\0")
        (whole / damaged).write_bytes(content)
        try:
            with limit_memory():
                read(whole / source)
        except InputError as error:
            assert "\n" not in str(error)

    try:
        check()
    finally:
        (whole / damaged).write_bytes(good)


class Canary:
    """Pickled, it makes a file when it is unpickled."""

    def __init__(self, path: Path):
        self.path = path

    def __reduce__(self):
        return (Path.touch, (self.path,))


def test_readers_pickled_payload_is_never_executed(whole: Path, tmp_path: Path):
    canary = tmp_path / "executed"
    array = np.array([Canary(canary)], dtype=object)
    np.save(tmp_path / "a.npy", array, allow_pickle=True)
    np.savez(tmp_path / "a.npz", images_train=array, header=array)
    (tmp_path / "a.pkl").write_bytes(pickle.dumps(Canary(canary), 2))
    torch.save({"state_dict": Canary(canary)}, tmp_path / "a.ckpt")
    (tmp_path / "a.yaml").write_text(f"a: !!python/object/apply:pathlib.Path.touch [{canary}]")
    run = Path(shutil.copytree(whole / "run", tmp_path / "run"))
    config = yaml.safe_load((run / "config.yaml").read_text())
    config["model"] = {"_target_": "os.system", "command": f"touch {canary}"}
    (run / "config.yaml").write_text(yaml.safe_dump(config))
    attempts: list[tuple[Reader, str]] = [
        *((read_npy, "a.npy"), (load_compact, "a.npz"), (read_scene, "a.npz"), (read_checkpoint, "a.ckpt")),
        *((read_checkpoint, "a.pkl"), (lambda path: read_yaml(path, "options"), "a.yaml"), (load_run, "run")),
    ]
    for read, name in attempts:
        with pytest.raises(InputError):
            read(tmp_path / name)
    assert not canary.exists()
