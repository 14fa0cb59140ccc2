"""The machine and its load."""

import pytest
import torch

from nerf_lightning.utils import machine
from nerf_lightning.utils.machine import Load, crowding, describe_machine


def test_describe_machine_names_the_processor():
    found = describe_machine(torch.device("cpu"))
    assert found["cores"] >= 1 and found["processor"] and found["accelerator"] is None


@pytest.mark.parametrize(
    ("cores", "threads", "others", "share"),
    [(2, 2, 0.0, 0.0), (2, 2, 0.5, 0.25), (8, 2, 5.9, 0.0), (8, 2, 7.0, 0.5), (2, 4, 0.4, 0.1), (4, 0, 0.0, 0.0)],
)
def test_crowding_counts_what_the_run_does_not_leave_free(cores: int, threads: int, others: float, share: float):
    results = {"machine": {"cores": cores}, "threads": threads, "load": {"own": 1.2, "others": others}}
    assert crowding(results) == pytest.approx(share)
    for changes in ({"load": None}, {"machine": "mine"}, {"threads": "2"}, {"load": {}}, {"machine": {}}):
        assert crowding(results | changes) is None


def test_load_counts_between_start_and_stop(monkeypatch: pytest.MonkeyPatch):
    now = {"wall": 0.0, "own": 0.0, "busy": 0.0}

    def advance(wall: float, own: float, others: float) -> None:
        now["wall"] += wall
        now["own"] += own
        now["busy"] += own + others

    monkeypatch.setattr(machine.time, "perf_counter", lambda: now["wall"])
    monkeypatch.setattr(machine.time, "process_time", lambda: now["own"])
    monkeypatch.setattr(machine, "_busy_seconds", lambda: now["busy"])
    load = Load()
    load.stop()
    advance(5, 5, 5)
    load.start()
    advance(0.2, 0.2, 0.2)
    load.stop()
    assert load.cores() is None, "too short to tell"
    load.stop()
    advance(9, 1, 18)
    load.start()
    advance(1.8, 1.8, 0.3)
    load.stop()
    assert load.cores() == {"own": 1.0, "others": 0.25}


def test_busy_seconds_leave_out_guests_and_waiting(monkeypatch: pytest.MonkeyPatch):
    """Linux counts the time of virtual machines twice: in user and in guest."""
    names = ("user", "nice", "system", "idle", "iowait", "guest", "guest_nice")
    times = type("Times", (tuple,), {name: property(lambda self, i=i: self[i]) for i, name in enumerate(names)})
    monkeypatch.setattr(machine.psutil, "cpu_times", lambda: times((10.0, 1.0, 2.0, 50.0, 3.0, 4.0, 0.5)))
    assert machine._busy_seconds() == 13.0
