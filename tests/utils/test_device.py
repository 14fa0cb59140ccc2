"""Device selection of runs and commands: early errors, and limits per device."""

import json
import shutil
from pathlib import Path

import pytest
import torch
import yaml
from omegaconf import OmegaConf

from nerf_lightning.config.build import build_system, build_trainer, resolve_run_device
from nerf_lightning.config.compose import compose_config
from nerf_lightning.config.limits import Limits, get_limits
from nerf_lightning.dataset import PixelDataModule, RayDataModule
from nerf_lightning.dataset.picture import make_builtin_picture
from nerf_lightning.dataset.pixel_datamodule import Picture
from nerf_lightning.errors import InputError
from nerf_lightning.runs.run_lock import LOCK_FILE, RUN_MARKER
from nerf_lightning.synthetic.objects import MARBLE, make_object_scene
from nerf_lightning.system import NeRF2D
from nerf_lightning.utils.device import CPU, available_devices, resolve_device


@pytest.fixture
def cpu_only_torch(monkeypatch: pytest.MonkeyPatch) -> None:
    """A machine with a CPU alone, and a PyTorch that knows nothing else."""
    for kind in (torch.cuda, torch.backends.mps):
        monkeypatch.setattr(kind, "is_available", lambda: False)
    for kind in (torch.backends.cuda, torch.backends.mps):
        monkeypatch.setattr(kind, "is_built", lambda: False)


def test_train_resumed_on_another_device_continues(run_cli, small_run: Path, cpu_only_torch: None, tmp_path: Path):
    run = tmp_path / "run"
    shutil.copytree(small_run, run)
    config = yaml.safe_load((run / "config.yaml").read_text())
    config["trainer"]["accelerator"] = "auto"
    (run / "config.yaml").write_text(yaml.safe_dump(config))
    before = {path: path.stat().st_mtime_ns for path in run.rglob("*")}
    for key in ("device", "trainer.accelerator"):
        code, _, err = run_cli(f"resume={run}", f"{key}=cuda")
        assert code == 2 and err.count("\n") == 1 and "device: found 'cuda'," in err, err
    after = {path: path.stat().st_mtime_ns for path in run.rglob("*") if path.name not in (LOCK_FILE, RUN_MARKER)}
    assert before == after, "nothing was touched"
    code, _, err = run_cli(f"resume={run}", "device=cpu", "limits.chunk_samples=100", "budget.steps=12")
    assert code == 0, err
    saved = yaml.safe_load((run / "config.yaml").read_text())
    assert saved["device"] == saved["trainer"]["accelerator"] == "cpu"
    assert saved["limits"] == {"batch_scale": None, "chunk_samples": 100}
    assert json.loads((run / "results.json").read_text())["steps"] == 12


def test_resolve_device_auto_is_best_available(monkeypatch: pytest.MonkeyPatch, cpu_only_torch: None):
    assert available_devices()[:1] == ["cpu"] and resolve_device("auto") == resolve_device("cpu") == CPU
    monkeypatch.setattr(torch.backends.mps, "is_available", lambda: True)
    assert resolve_device("auto") == resolve_device("mps") == torch.device("mps")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    assert resolve_device("auto") == torch.device("cuda") and resolve_device("cpu") == CPU
    with pytest.raises(InputError, match="found 'gpu', expected auto, or an available device: cuda, mps, cpu"):
        resolve_device("gpu")


def test_build_trainer_device_option_sets_accelerator(tmp_path: Path, cpu_only_torch: None):
    for given in ([], ["device=cuda", "trainer.accelerator=cpu"]):
        cfg = compose_config([*given, "callbacks=picture", "~logger"], tmp_path)
        assert resolve_run_device(cfg) == CPU
        assert build_trainer(cfg, tmp_path, CPU).strategy.root_device == CPU
    assert compose_config(["device=mps"], tmp_path).trainer.accelerator == "mps"


@pytest.mark.parametrize(("device", "batch", "chunk"), [("cuda", 4, 524288), ("xpu", 1, 32768)])
def test_limits_of_device_defaults_are_overridden_by_run(device: str, batch: int, chunk: int):
    where = torch.device(device)

    def limits(**given: object) -> Limits:
        return get_limits(OmegaConf.create({"limits": given}), where)

    assert limits() == limits(batch_scale=None, chunk_samples=None) == Limits(batch, chunk)
    assert (limits(batch_scale=3), limits(chunk_samples=7)) == (Limits(3, chunk), Limits(batch, 7))
    for broken in ({"batch_scale": 0}, {"chunk_samples": "many"}, {"rays": 3}):
        with pytest.raises(InputError, match=f"limits.{next(iter(broken))}"):
            limits(**broken)


def test_build_system_chunk_follows_device_limits(tmp_path: Path):
    from nerf_lightning.config.build import ImageMetadata, get_metadata

    cfg, data = compose_config([], tmp_path), RayDataModule(make_object_scene(MARBLE, size=4, views=3, held_out=1))
    assert build_system(cfg, get_metadata(data)).chunk == 32768
    system = build_system(cfg, get_metadata(data), torch.device("cuda"))
    assert system.chunk == system.sampler.chunk == 524288
    assert build_system(compose_config(["sampler=uniform"], tmp_path), get_metadata(data)).chunk_rays == 4096
    cfg = compose_config(["+experiment=smoke_2d", "limits.chunk_samples=5"], tmp_path)
    flat = build_system(cfg, ImageMetadata(8, 8))
    assert isinstance(flat, NeRF2D) and flat.chunk == 5


def test_enlarge_scales_rays_and_samples_of_a_step():
    picture = PixelDataModule(Picture("sunset", "test", make_builtin_picture(8)), pixels=10)
    picture.scale_batch(4)
    assert len(picture.draw(0).uv) == 40
    scene = make_object_scene(MARBLE, size=4, views=3, held_out=1)
    large = RayDataModule(scene, 100, 1000)
    large.scale_batch(8)
    assert (large.rays, large.initial_rays, large.samples, len(large.draw(0).pixels)) == (800, 800, 8000, 800)
    large.adapt_num_rays(4000)
    assert large.rays == 1040
