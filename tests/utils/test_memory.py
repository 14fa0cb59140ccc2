"""Memory: what is free, what does not fit, and what libraries say when it has run out."""

import psutil
import pytest
import torch

from nerf_lightning.config.compose import compose_config
from nerf_lightning.dataset import RayDataModule
from nerf_lightning.errors import InputError
from nerf_lightning.synthetic.objects import MARBLE, make_object_scene
from nerf_lightning.training.train import prepare_system
from nerf_lightning.utils.device import CPU
from nerf_lightning.utils.memory import check_memory, free_memory, out_of_memory_error


def test_check_memory_more_than_free_raises():
    free = free_memory()
    assert 0 < free < 2**50
    check_memory("config", "model", "numbers", 0.5 * free)
    with pytest.raises(InputError, match="model: numbers need at least"):
        check_memory("config", "model", "numbers", 2**50)


def test_prepare_system_field_larger_than_memory_raises(tmp_path, monkeypatch: pytest.MonkeyPatch):
    cfg = compose_config(["model.log2_hashmap_size=16"], tmp_path)
    data = RayDataModule(make_object_scene(MARBLE, size=4, views=3, held_out=1))
    needed = prepare_system(cfg, data, CPU, False).field.training_bytes
    monkeypatch.setattr(psutil, "virtual_memory", lambda: type("Memory", (), {"available": needed // 2}))
    with pytest.raises(InputError, match="config: model: numbers"):
        prepare_system(cfg, data, CPU, False)


def test_out_of_memory_error_names_the_size():
    errors = {
        "5200 bytes": RuntimeError("DefaultCPUAllocator: can't allocate memory: you tried to allocate 5200 bytes."),
        "20.00 GiB": torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 GiB. GPU 0 has a total"),
        "a tensor": MemoryError(),
    }
    assert all(f"no memory for {size};" in str(out_of_memory_error(error)) for size, error in errors.items())
    assert out_of_memory_error(RuntimeError("shapes differ")) is None
