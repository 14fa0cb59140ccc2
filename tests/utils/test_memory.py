"""Memory: what is free, what does not fit, and what libraries say when it has run out."""

import psutil
import pytest
import torch

from nerf_lightning.config.compose import composed
from nerf_lightning.dataset import RayDataModule
from nerf_lightning.errors import InputError
from nerf_lightning.synthetic.objects import MARBLE, make_scene
from nerf_lightning.training.train import prepare_system
from nerf_lightning.utils.device import CPU
from nerf_lightning.utils.memory import check_memory, free_memory, out_of_memory


def test_free_memory_is_plausible_and_checked():
    free = free_memory()
    assert 0 < free < 2**50
    check_memory("config", "model", "numbers", 0.5 * free)
    with pytest.raises(InputError, match="model: found numbers that take at least"):
        check_memory("config", "model", "numbers", 2**50)


def test_field_larger_than_memory_is_refused_before_training(tmp_path, monkeypatch: pytest.MonkeyPatch):
    cfg = composed(["model.log2_entries=16"], tmp_path)
    data = RayDataModule(make_scene(MARBLE, size=4, views=3, held_out=1))
    needed = prepare_system(cfg, data, CPU, False).field.training_bytes
    monkeypatch.setattr(psutil, "virtual_memory", lambda: type("Memory", (), {"available": needed // 2}))
    with pytest.raises(InputError, match="config: model: found numbers"):
        prepare_system(cfg, data, CPU, False)


def test_out_of_memory_is_recognised():
    errors = {
        "5200 bytes": RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate 5200 bytes."),
        "20.00 GiB": torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 GiB. GPU 0 has a total"),
        "a tensor": MemoryError(),
    }
    assert all(f"no memory for {size}," in str(out_of_memory(error)) for size, error in errors.items())
    assert out_of_memory(RuntimeError("shapes differ")) is None
