"""The machine and its load."""

from types import SimpleNamespace

import pytest
import torch

from nerf_lightning.utils import machine
from nerf_lightning.utils.machine import Load, crowding, describe_machine, taken


def test_the_machine_is_named():
    told = describe_machine(torch.device("cpu"))
    assert told["cores"] >= 1 and told["processor"] and told["accelerator"] is None


@pytest.mark.parametrize(
    ("cores", "threads", "others", "share"),
    [(2, 2, 0.0, 0.0), (2, 2, 0.5, 0.25), (8, 2, 5.9, 0.0), (8, 2, 7.0, 0.5), (2, 4, 0.4, 0.1), (4, 0, 0.0, 0.0)],
)
def test_others_take_what_the_run_does_not_leave_free(cores: int, threads: int, others: float, share: float):
    assert taken(cores, threads, others) == pytest.approx(share)


def test_crowding_of_a_run():
    results = {"machine": {"cores": 2}, "threads": 2, "load": {"own": 1.2, "others": 0.8}}
    assert crowding(results) == pytest.approx(0.4)
    for changes in ({"load": None}, {"machine": "mine"}, {"threads": "2"}, {"load": {}}, {"machine": {"cores": None}}):
        assert crowding(results | changes) is None


def test_load_counts_only_between_start_and_stop(monkeypatch: pytest.MonkeyPatch):
    """Own and others' seconds, from a clock that is turned by hand."""
    now = {"wall": 0.0, "own": 0.0, "busy": 0.0}

    def passes(wall: float, own: float, others: float) -> None:
        now["wall"] += wall
        now["own"] += own
        now["busy"] += own + others

    monkeypatch.setattr(machine.time, "perf_counter", lambda: now["wall"])
    monkeypatch.setattr(machine.time, "process_time", lambda: now["own"])
    monkeypatch.setattr(machine, "_busy_seconds", lambda: now["busy"])
    load = Load()
    assert load.cores() is None
    load.stop()
    passes(5, 5, 5)
    load.start()
    passes(2, 3, 0.5)
    load.stop()
    load.stop()
    passes(9, 1, 18)
    load.start()
    passes(2, 3, 1.5)
    load.stop()
    assert load.cores() == {"own": 1.5, "others": 0.5}
    short = Load()
    short.start()
    passes(0.2, 0.2, 0.2)
    short.stop()
    assert short.cores() is None, "too short to tell"


def test_guests_and_waiting_are_not_counted_as_work(monkeypatch: pytest.MonkeyPatch):
    """Linux counts the time of virtual machines twice: in user and in guest."""

    class Times(tuple):
        def __new__(cls, **parts: float):
            self = super().__new__(cls, parts.values())
            self.__dict__.update(parts)
            return self

    linux = Times(user=10.0, nice=1.0, system=2.0, idle=50.0, iowait=3.0, guest=4.0, guest_nice=0.5)
    monkeypatch.setattr(machine.psutil, "cpu_times", lambda: linux)
    assert machine._busy_seconds() == 13.0
    monkeypatch.setattr(machine.psutil, "cpu_times", lambda: Times(user=10.0, system=2.0, idle=50.0))
    assert machine._busy_seconds() == 12.0


def test_another_systems_processor(monkeypatch: pytest.MonkeyPatch):
    def missing(self: object, encoding: str) -> str:
        raise FileNotFoundError

    monkeypatch.setattr(machine.Path, "read_text", missing)
    monkeypatch.setattr(machine, "platform", SimpleNamespace(processor=lambda: "", machine=lambda: "arm64"))
    assert machine.processor() == "arm64"
