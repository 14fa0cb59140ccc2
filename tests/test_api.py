"""Python API: the same as the command line, from `import nerf_lightning as nl`."""

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from hydra.core.hydra_config import HydraConfig

import nerf_lightning as nl
from nerf_lightning.dataset import save_npz
from nerf_lightning.errors import InputError
from nerf_lightning.synthetic.objects import PILE, make_object_scene

STEPS = 12
FEW = ("callbacks.snapshots=null", "callbacks.orbit=null", "sampler.resolution=16", "~logger")


@pytest.fixture(scope="module")
def path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("scene") / "pile, of three.npz"
    save_npz(make_object_scene(PILE, size=16, views=8, held_out=2), place)
    return place


def weights(run: nl.Run) -> list[torch.Tensor]:
    return list(run.system.state_dict().values())


def test_train_from_python_matches_command_line(path: Path, run_cli, tmp_path: Path):
    scene = nl.load_scene(path)
    alike = {"recipe": "hashgrid_small", "steps": STEPS, "seed": 3, "device": "cpu", "options": FEW}
    run = nl.train(scene, folder=tmp_path / "mine", **alike)
    given = ["dataset=photos", f"dataset.path='{path}'", "recipe=hashgrid_small", f"budget.steps={STEPS}", "seed=3"]
    code, _, err = run_cli(*given, "device=cpu", f"hydra.run.dir={tmp_path}/theirs", *FEW)
    assert code == 0, err
    theirs = nl.load_run(tmp_path / "theirs", device="cpu")
    assert all(map(torch.equal, weights(run), weights(theirs))) and run.psnr == theirs.psnr > 5
    again = nl.train(path, folder=tmp_path / "again", **alike)
    assert all(map(torch.equal, weights(run), weights(again)))

    camera = scene.val.cameras[0]
    view = run.render(camera)
    assert view.rgb.shape == (16, 16, 3) and view.opacity.shape == view.depth.shape == (16, 16)
    assert torch.equal(view.rgb, run.render(scene.val.cameras[-2]).rgb)  # there are two
    compact = nl.load_run(run.export.compact(output=tmp_path / "mine.npz", max_psnr_drop=3.0), device="cpu")
    assert math.isnan(compact.psnr) and float((compact.render(camera).rgb - view.rgb).abs().max()) < 0.2


@pytest.fixture
def denormals() -> Iterator[None]:
    torch.set_flush_denormal(False)
    yield
    torch.set_flush_denormal(True)


def test_train_from_python_restores_process_state(path: Path, tmp_path: Path, denormals: None):
    threads, numbers, more = torch.get_num_threads(), torch.get_rng_state(), np.random.get_state()[1].copy()
    hydra = HydraConfig.instance().cfg
    nl.train(path, steps=1, device="cpu", folder=tmp_path / "run", options=[*FEW, "threads=1", "kernels=reference"])
    assert torch.get_num_threads() == threads and torch.equal(torch.get_rng_state(), numbers)
    assert (np.random.get_state()[1] == more).all() and HydraConfig.instance().cfg is hydra
    assert float(torch.tensor(1e-40) * 1) > 0, "denormal numbers are numbers again"


def test_train_from_python_bad_input_raises(path: Path, tmp_path: Path):
    with pytest.raises(InputError, match="dataset.rays"):
        nl.train(path, steps=1, device="cpu", folder=tmp_path / "run", options=["dataset.rays=0"])
    (tmp_path / "old").mkdir()
    (tmp_path / "old" / "config.yaml").touch()
    with pytest.raises(FileExistsError, match="another folder="):
        nl.train(path, steps=1, folder=tmp_path / "old")
