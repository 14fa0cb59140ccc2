"""The machine and its load."""

import pytest
import torch

from nerf_lightning.utils.machine import background_load, describe_machine


def test_describe_machine_cpu_names_processor():
    found = describe_machine(torch.device("cpu"))
    assert found["cores"] >= 1 and found["processor"] and found["accelerator"] is None


@pytest.mark.parametrize(
    ("cores", "threads", "others", "share"),
    [(2, 2, 0.0, 0.0), (2, 2, 0.5, 0.25), (8, 2, 5.9, 0.0), (8, 2, 7.0, 0.5), (2, 4, 0.4, 0.1), (4, 0, 0.0, 0.0)],
)
def test_background_load_is_fraction_of_threads(cores: int, threads: int, others: float, share: float):
    results = {"machine": {"cores": cores}, "threads": threads, "load": {"own": 1.2, "others": others}}
    assert background_load(results) == pytest.approx(share)
    for changes in ({"load": None}, {"machine": "mine"}, {"threads": "two"}, {"load": {}}):
        assert background_load(results | changes) is None
