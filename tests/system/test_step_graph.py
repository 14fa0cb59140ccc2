"""Training steps as CUDA graphs, on a device and a graph that exist only in the dispatcher."""

import json
import logging
from contextlib import nullcontext
from pathlib import Path

import pytest
import torch

from nerf_lightning.config.compose import compose_config
from nerf_lightning.runs.open import open_scene_run
from nerf_lightning.system import NeRF3D
from nerf_lightning.system.step_graph import StepGraph
from nerf_lightning.training.train import train
from nerf_lightning.utils.device import CPU
from tests.helpers.recorded_graph import RecordedGraph
from tests.test_any_device import ON_DEVICE, small_options

STEPS = 36


@pytest.fixture
def graphs(device: torch.device, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(NeRF3D, "is_graphable", property(lambda system: True))
    monkeypatch.setattr(torch.cuda, "CUDAGraph", RecordedGraph)
    monkeypatch.setattr(torch.cuda, "Stream", lambda device: None)
    monkeypatch.setattr(torch.cuda, "stream", lambda stream: nullcontext())
    monkeypatch.setattr(torch.cuda, "synchronize", lambda: None)
    monkeypatch.setattr(RecordedGraph, "replays", 0)


def run(name: str, folder: Path) -> tuple[dict[str, torch.Tensor], float]:
    """Trains and returns the weights and the held-out PSNR."""
    options = [option for option in small_options(name) if "orbit" not in option and "refine" not in option]
    quick = [f"budget.steps={STEPS}", "callbacks.orbit=null", "sampler.update_every=16", "refine=null"]
    train(compose_config([*options, *ON_DEVICE, *quick], folder))
    psnr = json.loads((folder / "results.json").read_text())["psnr"]
    return dict(open_scene_run(folder, CPU).system.named_parameters()), psnr


def test_replayed_steps_of_growing_field_equal_others(graphs: None, tmp_path: Path, monkeypatch):
    replayed, replayed_psnr = run("tensorf", tmp_path / "graph")
    assert RecordedGraph.replays >= STEPS - 2 * STEPS // 16 - 6, "but for the first steps, updates, and growth"
    monkeypatch.setattr(NeRF3D, "_replay_step", lambda *step: None)
    plain, plain_psnr = run("tensorf", tmp_path / "plain")
    assert replayed_psnr == pytest.approx(plain_psnr, abs=1e-3)
    for key, weight in plain.items():
        torch.testing.assert_close(replayed[key], weight, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("failure", ["capture", "loss"])
def test_failing_graph_is_reported_and_not_used(failure: str, graphs: None, tmp_path: Path, monkeypatch, caplog):
    if failure == "capture":
        monkeypatch.setattr(RecordedGraph, "capture_begin", lambda graph, **options: torch.zeros(2) @ torch.zeros(3))
    else:
        monkeypatch.setattr(RecordedGraph, "replay", lambda graph: graph.calls[0])
        monkeypatch.setattr(StepGraph, "_capture", zero_loss(StepGraph._capture))
    with caplog.at_level(logging.WARNING):
        _, psnr = run("hashgrid", tmp_path)
    reasons = [record.message for record in caplog.records if "CUDA graphs" in record.message]
    assert len(reasons) == 1 and ("size" if failure == "capture" else "the loss was 0 instead of") in reasons[0]
    assert psnr > 5


def zero_loss(capture):
    def capture_zero(graph: StepGraph, *arguments: object) -> None:
        capture(graph, *arguments)
        graph.stats.mse.zero_()

    return capture_zero
