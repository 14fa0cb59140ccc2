"""Which device a run or a verb takes: told early where it is not there, and with its own limits."""

import json
import shutil
from pathlib import Path

import pytest
import torch
import yaml
from omegaconf import OmegaConf

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
from nerf_lightning.utils.device import CPU, devices, the_device


@pytest.fixture
def plain_torch(monkeypatch: pytest.MonkeyPatch) -> None:
    """A machine with a CPU alone, and a PyTorch that knows nothing else."""
    for kind in (torch.cuda, torch.backends.mps):
        monkeypatch.setattr(kind, "is_available", lambda: False)
    for kind in (torch.backends.cuda, torch.backends.mps):
        monkeypatch.setattr(kind, "is_built", lambda: False)


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
    with pytest.raises(InputError, match="found 'gpu', expected auto, or what is there: cuda, mps, cpu"):
        the_device("gpu")


def test_trainer_uses_the_device(tmp_path: Path, plain_torch: None):
    for given in ([], ["device=cuda", "trainer.accelerator=cpu"]):
        cfg = composed([*given, "callbacks=picture", "~logger"], tmp_path)
        assert device_of(cfg) == CPU
        assert build_trainer(cfg, tmp_path, CPU).strategy.root_device == CPU
    assert composed(["device=mps"], tmp_path).trainer.accelerator == "mps"


@pytest.mark.parametrize(("device", "batch", "chunk"), [("cuda", 4, 524288), ("xpu", 1, 32768)])
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
