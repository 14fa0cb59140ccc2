"""The systems are LightningModules like others: they train without this package's callbacks too."""

from dataclasses import replace
from pathlib import Path

import lightning as L
import pytest
import torch

from nerf_lightning.config.build import build_data, build_system, get_metadata
from nerf_lightning.config.compose import compose_config
from nerf_lightning.runs.folder import load_run
from nerf_lightning.system import NeRF3D
from nerf_lightning.training.process import prepare_process
from nerf_lightning.training.train import train
from nerf_lightning.utils.device import CPU
from nerf_lightning.utils.libraries import silence_lightning

STEPS = 24
OPTIONS = ("+experiment=smoke_3d", "dataset.size=16", "dataset.train_views=6", f"budget.steps={STEPS}", "device=cpu")
OFF = (*(f"callbacks.{name}=null" for name in ("validation", "snapshots", "orbit", "recovery")), "~logger")


def make_bare_trainer(steps: int) -> L.Trainer:
    silence_lightning()
    return L.Trainer(
        max_steps=steps, max_epochs=-1, accelerator="cpu", limit_val_batches=0, logger=False,
        enable_checkpointing=False, enable_progress_bar=False, enable_model_summary=False,
    )  # fmt: skip


def test_bare_trainer_same_steps_gives_same_weights(tmp_path: Path):
    cfg = compose_config([*OPTIONS, *OFF], tmp_path)
    train(cfg)
    expected = load_run(tmp_path).system.state_dict()

    prepare_process(cfg)
    data = build_data(cfg)
    system = build_system(cfg, get_metadata(data), CPU)
    trainer = make_bare_trainer(STEPS)
    trainer.fit(system, data)
    assert trainer.global_step == STEPS and system.state.progress == (STEPS - 1) / STEPS
    found = system.state_dict()
    assert found.keys() == expected.keys()
    assert all(torch.equal(found[key], expected[key]) for key in found)


@pytest.mark.parametrize("unbounded", [False, True])
def test_bare_trainer_view_loss_of_unbounded_scene_measures_texture(unbounded: bool, tmp_path: Path):
    cfg = compose_config([*OPTIONS, "model.view_residual=true", "renderer.view_loss_weight=0.001"], tmp_path)
    data = build_data(cfg)
    data.scene = replace(data.scene, bounds=replace(data.scene.bounds, unbounded=unbounded))
    make_bare_trainer(1).fit(build_system(cfg, get_metadata(data), CPU), data)
    assert (data.draw(0).texturelessness is not None) == unbounded


def test_param_groups_proposals_and_corrections_have_own_learning_rates(tmp_path: Path):
    proposals = "sampler=proposal", "~sampler.resolution", "sampler.lr_final_factor=0.01"
    cfg = compose_config([*OPTIONS, *proposals, "refine=poses", "optimizer.lr=0.02", "schedule=constant"], tmp_path)
    data = build_data(cfg)
    system, trainer = build_system(cfg, get_metadata(data), CPU), make_bare_trainer(2)
    trainer.fit(system, data)
    assert isinstance(system, NeRF3D) and system.corrections is not None
    rates = {parameter: group["lr"] for group in trainer.optimizers[0].param_groups for parameter in group["params"]}
    assert rates.keys() == set(system.parameters())
    assert {rates[parameter] for parameter in system.field.parameters()} == {0.02}
    assert rates[system.sampler.grid.tables] == 0.02 * 0.01**0.5  # in the second of two steps
    assert rates[system.corrections.poses.pose_adjustment] == (
        system.corrections.learning_rates["poses"] * system.corrections.lr_factors(0.5)["poses"]
    )
