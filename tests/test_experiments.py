"""Every shipped experiment and every group option runs."""

import json
from pathlib import Path

import pytest
import torch
from omegaconf import DictConfig
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from nerf_lightning.config import conf_dir
from nerf_lightning.config.build import build_data, build_system, get_metadata
from nerf_lightning.config.compose import compose_config
from nerf_lightning.dataset import save_npz
from nerf_lightning.runs.folder import load_run
from nerf_lightning.synthetic.bricks import bricks
from nerf_lightning.system import NeRF2D, NeRF3D, System
from nerf_lightning.system.system import sum_losses
from nerf_lightning.training.train import train
from nerf_lightning.utils.seeding import Stream, step_generator
from tests.helpers.command_line import BARE

EXPERIMENTS = sorted(path.stem for path in (conf_dir() / "experiment").glob("*.yaml"))
GROUPS = ("recipe", "model", "sampler", "optimizer", "schedule")


@pytest.fixture(scope="session")
def small_scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The built-in scene at 24 px, as a file."""
    path = tmp_path_factory.mktemp("scene") / "small.npz"
    save_npz(bricks(size=24, train_views=8, val_views=2), path)
    return path


def test_lego_mlp_matches_original_nerf(tmp_path: Path):
    """8 layers of 256 with the encoding again at the fifth, L = 10 and 4, Adam at 5e-4, 4096 rays of 64 samples."""
    cfg = compose_config(["+experiment=lego_mlp"], tmp_path)
    model = {key: value for key, value in cfg.model.items() if key != "_target_"}
    assert model == {
        "depth": 8, "width": 256, "skip": 4, "position_frequencies": 10, "direction_frequencies": 4, "density": "relu",
    }  # fmt: skip
    assert (cfg.optimizer._target_, cfg.optimizer.lr) == ("torch.optim.Adam", 5e-4)
    assert (cfg.dataset.rays, cfg.dataset.samples, cfg.sampler.samples) == (4096, None, 64)
    cfg = compose_config(["+experiment=picture_mlp"], tmp_path)
    assert (cfg.dataset.pixels, cfg.optimizer.lr, cfg.model.num_frequencies, cfg.model.width) == (10_000, 1e-2, 10, 256)


def take_a_step(cfg: DictConfig) -> System:
    """Builds what a configuration describes, and trains it for one step."""
    data = build_data(cfg)
    system = build_system(cfg, get_metadata(data))
    batch, optimizer = data.draw(0), system.configure_optimizers()
    if isinstance(system, NeRF3D):
        loss = sum_losses(system.compute_losses(batch, step_generator(0, Stream.STEP, 0))[0])
    else:
        assert isinstance(system, NeRF2D)
        loss = system.loss(batch)
    loss.backward()
    optimizer.step()
    assert loss.isfinite() and 0 < system.schedule(0.5, 100) <= 1
    return system


@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_experiment_each_one_runs_as_a_whole(experiment: str, small_scene: Path, tmp_path: Path):
    """Each is run as a whole; the charts of a picture, which take longest, only once."""
    if experiment.startswith(("picture", "study_", "tune_")) or experiment == "smoke_2d":
        small = ["dataset.max_side=24", *(BARE if experiment != "picture" else [])]
    elif experiment == "smoke_3d":
        small = ["dataset.size=24"]
    else:
        small = [f"dataset.path={small_scene}", "dataset.resize=null", "dataset.rays=256", "callbacks.orbit.frames=2"]
    train(compose_config([f"+experiment={experiment}", "trainer.fast_dev_run=true", *small], tmp_path))
    results = json.loads((tmp_path / "results.json").read_text())
    assert results["steps"] == 1
    assert results["psnr"] > 0


@pytest.mark.parametrize(
    ("group", "option"),
    [(group, path.stem) for group in GROUPS for path in sorted((conf_dir() / group).glob("*.yaml"))],
)
def test_group_each_option_takes_a_step(group: str, option: str, small_scene: Path, tmp_path: Path):
    flat = option in ("picture_mlp", "hashgrid2d", "fourier", "siren")
    few = ["dataset=photos", f"dataset.path={small_scene}"] if not flat else ["dataset=picture", "dataset.max_side=16"]
    few += [] if flat or (group == "recipe" and not option.endswith("gpu")) else ["dataset.rays=64"]
    cfg = compose_config([*few, f"{group}={option}"], tmp_path)
    assert group != "recipe" or (cfg.recipe == option and option.startswith(cfg.method))
    assert isinstance(take_a_step(cfg), NeRF2D) == flat


def test_run_leaves_results_pictures_checkpoints_and_curves(tmp_path: Path):
    """Contract: results.json, pictures, checkpoints, curves and hyperparameters, in its folder, which can be moved."""
    cfg = compose_config(["+experiment=smoke_3d", "budget.steps=60", "seed=3"], tmp_path)
    quality = train(cfg)
    results = json.loads((tmp_path / "results.json").read_text())
    assert set(results) == {
        "scene", "background", "method", "seed", "device", "threads", "machine", "load", "versions", "parameters",
        "artifact_bytes", "train_seconds", "steps", "rays_per_second", "psnr", "psnr_aligned", "ssim", "psnr_worst_view",
        "rows_measured", "test", "render_seconds_per_view", "peak_memory_bytes", "curve", "warnings", "plateau", "misfits",
        "corrections", "recoveries", "status", "diagnosis",
    }  # fmt: skip
    assert set(results["scene"]) == {"name", "source", "sha256", "views", "resolution", "bounded", "kind"}
    assert results["scene"]["name"] == "bricks"
    assert results["background"] == [0, 0, 0]
    assert (results["method"], results["seed"], results["steps"], results["status"]) == ("hashgrid", 3, 60, "finished")
    assert results["psnr"] == pytest.approx(quality)
    assert results["psnr"] > 17
    assert results["curve"][-1][1:] == [60, results["psnr"]]
    seconds = [point[0] for point in results["curve"]]
    assert seconds == sorted(seconds)
    snapshots = sorted(path.name for path in (tmp_path / "snapshots").iterdir())
    assert snapshots == [f"step_{step:07d}.png" for step in (10, 20, 50, 60)]
    assert (tmp_path / "orbit.gif").stat().st_size > 0
    assert {path.name for path in (tmp_path / "checkpoints").iterdir()} == {"best.ckpt", "last.ckpt"}
    (file,) = tmp_path.glob("events.out.tfevents.*")
    events = EventAccumulator(str(file)).Reload()
    scalars = set(events.Tags()["scalars"])
    assert {"val/ssim", "loss/photometric", "train/psnr", "speed/rays_per_second", "speed/train_seconds"} < scalars
    assert {name.partition("/")[0] for name in scalars} == {"loss", "lr", "speed", "train", "val"}
    assert events.Scalars("val/psnr")[-1].step == 60 and events.Tags()["images"] == ["images/view"]
    assert not list(tmp_path.glob("**/.*")), "no temporary file stays behind"

    run = load_run(tmp_path.rename(tmp_path.parent / "moved"))
    saved = torch.load(tmp_path.parent / "moved" / "checkpoints" / "last.ckpt", weights_only=True)
    assert torch.equal(run.system.field.grid.tables, saved["state_dict"]["field.grid.tables"])
    assert run.orbit is not None and run.system.render(run.orbit.generate_view_rays(0)).rgb.std() > 0.01
