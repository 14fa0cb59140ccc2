"""Which device a run or a verb takes: told early where it is not there, and with its own limits."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import torch
import yaml
from omegaconf import OmegaConf

from nerf_lightning.callbacks.evaluation import peak_memory_bytes
from nerf_lightning.config.build import build_system, build_trainer, device_of
from nerf_lightning.config.compose import composed
from nerf_lightning.config.limits import Limits, limits_of
from nerf_lightning.dataset import PixelDataModule, RayDataModule
from nerf_lightning.dataset.picture import builtin_picture
from nerf_lightning.dataset.pixels import Picture
from nerf_lightning.errors import InputError
from nerf_lightning.runs.owner import LOCK, MARKER
from nerf_lightning.synthetic.objects import MARBLE, make_scene
from nerf_lightning.system import NeRF2D
from nerf_lightning.utils.device import CPU, devices, synchronize, the_device
from nerf_lightning.utils.machine import accelerator, device_in_words

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def plain_torch(monkeypatch: pytest.MonkeyPatch) -> None:
    """A machine with a CPU alone, and a PyTorch that knows nothing else."""
    for kind in (torch.cuda, torch.backends.mps):
        monkeypatch.setattr(kind, "is_available", lambda: False)
    for kind in (torch.backends.cuda, torch.backends.mps):
        monkeypatch.setattr(kind, "is_built", lambda: False)


@pytest.mark.parametrize("device", ["cuda", "nonsense"])
def test_missing_device_is_refused_before_anything_is_written(device: str, inside, plain_torch: None, tmp_path: Path):
    code, _, err = inside("dataset.path=nowhere.npz", "dataset=photos", f"device={device}")
    assert code == 2 and err.count("\n") == 1 and f"config: device: found '{device}'" in err, err
    assert not list(tmp_path.iterdir())


def test_resumed_run_may_use_another_device(inside, small_run: Path, plain_torch: None, tmp_path: Path):
    run = tmp_path / "run"
    shutil.copytree(small_run, run)
    config = yaml.safe_load((run / "config.yaml").read_text())
    config["trainer"]["accelerator"] = "auto"
    (run / "config.yaml").write_text(yaml.safe_dump(config))
    before = {path: path.stat().st_mtime_ns for path in run.rglob("*")}
    for key in ("device", "trainer.accelerator"):
        code, _, err = inside(f"resume={run}", f"{key}=cuda")
        assert code == 2 and err.count("\n") == 1 and "device: found 'cuda'," in err, err
    after = {path: path.stat().st_mtime_ns for path in run.rglob("*") if path.name not in (LOCK, MARKER)}
    assert before == after, "nothing was touched"
    code, _, err = inside(f"resume={run}", "device=cpu", "limits.chunk=100", "budget.steps=12")
    assert code == 0, err
    saved = yaml.safe_load((run / "config.yaml").read_text())
    assert saved["device"] == saved["trainer"]["accelerator"] == "cpu"
    assert saved["limits"] == {"batch": None, "chunk": 100}
    assert json.loads((run / "results.json").read_text())["steps"] == 12


def test_auto_is_the_best_device(monkeypatch: pytest.MonkeyPatch, plain_torch: None):
    assert devices()[:1] == ["cpu"] and the_device("auto") == the_device("cpu") == CPU
    monkeypatch.setattr(torch.backends.mps, "is_available", lambda: True)
    assert the_device("auto") == the_device("mps") == torch.device("mps")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    assert the_device("auto") == torch.device("cuda") and the_device("cpu") == CPU


@pytest.mark.parametrize("name", ["cuda", "mps", "gpu", "privateuseone"])
def test_the_device_missing_says_what_is_there(name: str, plain_torch: None):
    with pytest.raises(InputError, match=f"found '{name}', expected auto, or what is there: cpu") as refused:
        the_device(name)
    assert ("install PyTorch for CUDA" in str(refused.value)) == (name == "cuda")


REGISTERED = """
import types, torch
from nerf_lightning.utils.device import devices, synchronize, the_device
from nerf_lightning.errors import InputError

def missing():
    try:
        the_device("pretend")
    except InputError:
        return True

torch.utils.rename_privateuse1_backend("pretend")
assert missing(), "a name without a module"
waited = []
module = types.SimpleNamespace(is_available=lambda: False, synchronize=lambda: waited.append(1))
torch._register_device_module("pretend", module)
assert missing()
module.is_available = lambda: True
assert the_device("pretend").type == "pretend" and devices()[-1] == "pretend" != the_device("auto").type
synchronize(torch.device("pretend"))
assert waited
"""


def test_registered_backend_is_found():
    """In a process of its own: it is registered for good."""
    done = subprocess.run([sys.executable, "-c", REGISTERED], cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr


def test_trainer_uses_the_device(tmp_path: Path, plain_torch: None):
    for given in (["device=cpu"], ["trainer.accelerator=cpu"], ["device=cuda", "trainer.accelerator=cpu"], []):
        cfg = composed([*given, "callbacks=picture", "~logger"], tmp_path)
        assert device_of(cfg) == CPU
        assert build_trainer(cfg, tmp_path, CPU).strategy.root_device == CPU
    assert composed(["device=mps"], tmp_path).trainer.accelerator == "mps"


@pytest.mark.parametrize(
    ("device", "batch", "chunk"),
    [("cpu", 1, 32768), ("cuda", 4, 524288), ("mps", 4, 131072), ("xpu", 1, 32768)],
)
def test_limits_follow_device_and_run(device: str, batch: int, chunk: int):
    where = torch.device(device)

    def limits(**given: object) -> Limits:
        return limits_of(OmegaConf.create({"limits": given}), where)

    assert limits() == limits(batch=None, chunk=None) == Limits(batch, chunk)
    assert (limits(batch=3), limits(chunk=7)) == (Limits(3, chunk), Limits(batch, 7))
    for broken in ({"batch": 0}, {"chunk": "many"}, {"rays": 3}):
        with pytest.raises(InputError, match=f"limits.{next(iter(broken))}"):
            limits(**broken)


def test_chunk_follows_the_device(tmp_path: Path):
    from nerf_lightning.config.build import PictureFrame, frame_of

    cfg, data = composed([], tmp_path), RayDataModule(make_scene(MARBLE, size=4, views=3, held_out=1))
    assert build_system(cfg, frame_of(data)).chunk == 32768
    system = build_system(cfg, frame_of(data), torch.device("cuda"))
    assert system.chunk == system.sampler.chunk == 524288
    assert build_system(composed(["sampler=uniform"], tmp_path), frame_of(data)).chunk_rays == 4096
    flat = build_system(composed(["+experiment=smoke_2d", "limits.chunk=5"], tmp_path), PictureFrame(8, 8))
    assert isinstance(flat, NeRF2D) and flat.chunk == 5


def test_batch_follows_limits(inside, tmp_path: Path):
    given = ["+experiment=smoke_2d", "dataset.max_side=16", "dataset.pixels=10", "budget.steps=3", "~logger"]
    plain = ["callbacks.training_gif=null", "callbacks.charts=null", "callbacks.baselines=null"]
    assert inside(*given, *plain, "limits.batch=7")[0] == 0
    (path,) = tmp_path.rglob("last.ckpt")
    told = torch.load(path, weights_only=True)["callbacks"]["Throughput"]
    assert told["rays"] == 3 * 70


def test_resumed_batch_is_scaled_to_the_device():
    picture = PixelDataModule(Picture("sunset", "test", builtin_picture(8)), pixels=10)
    picture.enlarge(4)
    assert len(picture.draw(0).uv) == 40
    scene = make_scene(MARBLE, size=4, views=3, held_out=1)
    small, large, fixed = (RayDataModule(scene, 100, samples) for samples in (1000, 1000, None))
    large.enlarge(8)
    fixed.enlarge(8)
    assert (large.rays, large.first_rays, large.samples, len(large.draw(0).pixels)) == (800, 800, 8000, 800)
    large.note_samples(4000)
    assert large.rays == 1040
    small.load_state_dict(large.state_dict())
    assert small.rays == 130, "resumed where a step takes an eighth"
    other = RayDataModule(scene, 100)
    other.load_state_dict(fixed.state_dict())
    assert other.rays == 100


def test_accelerators_are_named(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda device: "H100")
    monkeypatch.setattr(torch.backends.mps, "get_name", lambda: "Apple M9", raising=False)
    told = {name: accelerator(torch.device(name)) for name in ("cpu", "cuda:1", "mps", "xpu")}
    assert told == {"cpu": None, "cuda:1": "H100", "mps": "Apple M9", "xpu": "xpu"}
    words = [device_in_words(torch.device(name)) for name in ("cpu", "cuda:1", "mps", "xpu")]
    assert words == ["cpu", "cuda (H100)", "mps (Apple M9)", "xpu"]


def test_peak_memory_is_that_of_the_device(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(torch.cuda, "max_memory_allocated", lambda device: 5)
    monkeypatch.setattr(torch.mps, "driver_allocated_memory", lambda: 7)
    assert (peak_memory_bytes(torch.device("cuda:1")), peak_memory_bytes(torch.device("mps"))) == (5, 7)
    assert (peak_memory_bytes(CPU) or 0) > 1000


def test_synchronize_waits_for_the_device(monkeypatch: pytest.MonkeyPatch):
    waited = []
    monkeypatch.setattr(torch.cuda, "synchronize", lambda: waited.append("cuda"))
    monkeypatch.setattr(torch.mps, "synchronize", lambda: waited.append("mps"))
    for name in ("cpu", "cuda", "mps"):
        synchronize(torch.device(name))
    assert waited == ["cuda", "mps"]
