"""Fixtures that all tests share."""

import copy
import logging
import os
import signal
import sys
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

# Before OpenMP starts, here and in processes that tests start: threads that wait would spin, and take the cores from the tests
# beside them.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")
# Before anything imports Triton: its interpreter runs the GPU kernels on CPU tensors.
os.environ["TRITON_INTERPRET"] = "1"

# While the hook below loads a module it looks for all compiled files under a name of its own, those of libraries too, and so
# would compile thousands again: what takes long to import comes first.
import cv2  # noqa: F401
import lightning.pytorch  # noqa: F401
import matplotlib.figure  # noqa: F401
import numba  # noqa: F401
import scipy.signal  # noqa: F401
import torch.utils.tensorboard
from jaxtyping import install_import_hook

import tests.helpers.typechecker  # noqa: F401  (the hook below imports the first package of its name alone)

# As training sets it, and before any thread starts: threads inherit it. A test that trains would otherwise leave it set for its
# own thread alone, and what several threads compute after it would depend on which of them computed what.
torch.set_flush_denormal(True)

ROOT = Path(__file__).resolve().parents[1]
KERNELS = ("nerf_lightning.kernels.cpu.", "nerf_lightning.kernels.gpu.")
DEFAULT_HANDLERS = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: signal.SIG_DFL}
"""Python's own: a shell that starts tests in the background has them ignore Ctrl-C."""


def checked_modules() -> list[str]:
    """All modules but those in `KERNELS`, whose functions numba and Triton must see undecorated, and packages of these."""
    files = (file.relative_to(ROOT).with_suffix("") for file in (ROOT / "nerf_lightning").rglob("*.py"))
    names = {".".join(file.parts).removesuffix(".__init__") for file in files}
    # The hook takes a name for everything below it.
    return sorted(n for n in names if not any(k.startswith(f"{n}.") or n.startswith(k) for k in KERNELS))


# Before anything imports the package: from here on a wrong shape fails the test that met it.
install_import_hook(checked_modules(), "tests.helpers.typechecker.check")

# ruff: noqa: E402
import pytest
import yaml
from filelock import FileLock
from hypothesis import HealthCheck, settings
from numba.core.dispatcher import Dispatcher
from torch.nn.functional import normalize

from benchmarks.synthetic.photos import Flaws, Truth, write_capture
from nerf_lightning.cameras import Bounds, Rays
from nerf_lightning.kernels import set_kernels
from tests.helpers.fake_device import device, device_without_float64  # noqa: F401  (fixtures)
from tests.helpers.shared_fixtures import make_once, shared_folder

# The same examples on every machine, none kept: a failure is found again by running the test again.
settings.register_profile(
    "tests", derandomize=True, deadline=None, database=None, max_examples=30, suppress_health_check=list(HealthCheck)
)
settings.load_profile("tests")


@pytest.fixture(scope="session")
def real_data() -> Path:
    """The folder of real scenes next to the checkout."""
    folder = ROOT.parent / "shared" / "data"
    if not folder.is_dir():
        pytest.skip("no shared/data next to the checkout")
    return folder


@pytest.fixture(autouse=True, scope="session")
def isolated_cache(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Tests neither read nor fill the user's cache."""
    os.environ["NERF_LIGHTNING_CACHE"] = str(tmp_path_factory.mktemp("cache"))


@pytest.fixture(autouse=True, scope="session")
def compile_kernels_once(tmp_path_factory: pytest.TempPathFactory) -> None:
    """On a new machine each kernel is compiled by one test process, itself; the others wait and load what it has cached."""
    compile, folder = Dispatcher.compile, shared_folder(tmp_path_factory)

    def compile_once(self: Dispatcher, signature: object) -> object:
        # One lock object a file: a kernel that needs itself in another signature does not wait for itself.
        with FileLock(folder / f"{self.py_func.__module__}.{self.py_func.__qualname__}.lock", is_singleton=True):
            return compile(self, signature)

    Dispatcher.compile = compile_once


@pytest.fixture(autouse=True, scope="session")
def parse_conf_once() -> None:
    """Hydra parses the files of conf/ again for each command line, which is a fifth of what composing one takes."""
    load, parsed = yaml.load, {}

    def load_once(stream: Any, Loader: type) -> Any:
        if not hasattr(stream, "seek"):
            return load(stream, Loader)
        key = Loader.__qualname__, stream.read()
        stream.seek(0)
        if key not in parsed:
            parsed[key] = load(stream, Loader)
        return copy.deepcopy(parsed[key])

    yaml.load = load_once


@pytest.fixture(autouse=True)
def seed_torch() -> None:
    torch.manual_seed(0)


@pytest.fixture(autouse=True)
def restore_signal_handlers() -> None:
    """Each test starts with Python's own handlers."""
    for number, handler in DEFAULT_HANDLERS.items():
        signal.signal(number, handler)


@pytest.fixture(autouse=True)
def restore_fast_kernels() -> Iterator[None]:
    """Whatever a test switches, the next one finds the fast kernels."""
    yield
    set_kernels("auto")


@pytest.fixture(params=["auto", "reference"])
def kernels(request: pytest.FixtureRequest, restore_fast_kernels: None) -> str:
    """Runs a test with the fast kernels, and again with the reference."""
    set_kernels(request.param)
    return request.param


@pytest.fixture
def run_main(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]):
    """Runs a verb's `main` with arguments in this process, in an empty folder; returns exit code, output and errors."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("NERF_LIGHTNING_TRACEBACK", raising=False)

    def run(main: Callable[[], None], *arguments: str) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["nerf_lightning", *arguments])
        code = 0
        try:
            main()
        except SystemExit as end:
            code = int(end.code or 0)
        return code, *capfd.readouterr()

    yield run
    logging.getLogger().handlers.clear()  # they write to what was captured


@pytest.fixture
def run_cli(run_main):
    """Likewise, of `python -m nerf_lightning`."""
    from nerf_lightning.__main__ import main

    return partial(run_main, main)


@pytest.fixture(scope="session")
def small_run(tmp_path_factory: pytest.TempPathFactory, isolated_cache: None) -> Path:
    """The folder of a finished run on the built-in scene, seconds long."""
    from nerf_lightning.config.compose import compose_config
    from nerf_lightning.training.train import train

    def make(folder: Path) -> Path:
        options = ["+experiment=smoke_3d", "dataset.size=16", "budget.steps=10", "callbacks.orbit.frames=0"]
        train(compose_config(options, folder))
        return folder

    return make_once(tmp_path_factory, "small_run", make)


@pytest.fixture(scope="session")
def tag_capture(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Truth]:
    """A synthetic capture with a sheet of six tags: folders `calibration` and `photos`, eight photos each, those of
    the object a third of the way around it. Read only."""
    from tests.helpers.tag_views import SIX_TAGS, SMALL_LENS

    def make(folder: Path) -> tuple[Path, Truth]:
        return folder, write_capture(folder, SIX_TAGS, SMALL_LENS, 8, 8, Flaws(), seed=3, steps=24, samples=2)

    return make_once(tmp_path_factory, "capture", make)


BOX_MIN, BOX_MAX = torch.tensor([-1.0, -1.5, -0.5]), torch.tensor([1.0, 0.5, 1.5])


@pytest.fixture
def box() -> Bounds:
    return Bounds(torch.stack([BOX_MIN, BOX_MAX]))


@pytest.fixture
def rays() -> Rays:
    """60 rays from outside toward the box, some of which miss; 10 from inside; 1 that certainly misses."""
    origins = torch.cat([4 * normalize(torch.randn(60, 3), dim=-1), BOX_MIN + torch.rand(10, 3) * (BOX_MAX - BOX_MIN)])
    toward = BOX_MIN + torch.rand(70, 3) * (BOX_MAX - BOX_MIN) * 1.4
    directions = normalize(toward - origins, dim=-1)
    away = torch.tensor([[5.0, 5.0, 5.0]])
    return Rays(torch.cat([origins, away]), torch.cat([directions, normalize(away, dim=-1)]))
