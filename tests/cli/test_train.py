"""The command line: help, errors, resuming after a kill, and the installed wheel."""

import os
import signal
import subprocess
import sys
import time
import zipfile
from pathlib import Path

import pytest
import torch
import yaml

from nerf_lightning.config import conf_dir
from nerf_lightning.config.compose import compose_config
from nerf_lightning.dataset import Scene, save_npz
from nerf_lightning.dataset.scene import Views
from nerf_lightning.errors import InputError
from nerf_lightning.runs.run_lock import lock_folder
from nerf_lightning.synthetic.bricks import bricks
from tests.helpers.command_line import BARE, start_cli

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["model.widht=3"], ["model.widht", "did you mean model.width?"]),
        (["my photos"], ["found my photos", "dataset=photos 'dataset.path=my photos'"]),
        (["--experimental-rerun=notes.txt"], ["--experimental-rerun"]),
        (["model=nope"], ["model/nope", "hashgrid hashgrid2d"]),
        (["model.density=magic"], ["model.density", "'magic'", "relu, softplus, exp"]),
        (["model=picture_mlp"], ["model", "PictureMLP", "three coordinates"]),
        (["budget.steps=0"], ["budget.steps", "found 0", "at least 1"]),
        (["optimizer.lr=-1"], ["optimizer", "-1", "torch.optim.Adam"]),
        (["schedule=null"], ["schedule: found null", "one of constant, cosine, exponential"]),
        (["sampler=null"], ["sampler: found nothing", "the group sampler"]),
        (["renderer.background=pink"], ["renderer.background", "'pink'", "black, white"]),
        (["dataset=photos", "dataset.path=missing.npz"], ["missing.npz", "no such file", "check the path"]),
        (["dataset=photos", "dataset.path=broken.npz"], ["broken.npz", "unreadable as plain numeric arrays"]),
        (["resume=notes.txt"], ["notes.txt: no such folder; give resume=FOLDER"]),
        (["+experiment=broken.yaml"], ["broken.yaml", "YAML"]),
        (["hydra.run.dir=notes.txt/below"], ["notes.txt/below: Not a directory"]),
    ],
)
def test_train_bad_input_exits_with_code_2(arguments: list[str], words: list[str], run_cli, tmp_path: Path):
    (tmp_path / "notes.txt").write_text("nothing to see")
    (tmp_path / "broken.npz").write_text("not a zip")
    (tmp_path / "broken.yaml").write_text("a: [1")
    before = {*tmp_path.iterdir()}
    small = [] if any("experiment" in a or a.startswith("dataset=") for a in arguments) else ["dataset.size=16"]
    code, _, err = run_cli(*small, *arguments)
    assert code == 2, err
    assert err.count("\n") == 1, err
    for word in [*words, "NERF_LIGHTNING_TRACEBACK=1"]:
        assert word in err
    assert {path for path in tmp_path.rglob("*") if path.is_file()} == before


def test_train_checks_options_before_reading_photos(run_cli, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("nerf_lightning.training.train.load_data", lambda *_: pytest.fail("photos were read"))
    model = ("model.num_levels=0", "sampler.samples=x")
    for wrong in (*model, "budget.steps=0", "callbacks.orbit.fps=0", "+refine.focall=1"):
        code, _, err = run_cli("refine=both", wrong)
        assert code == 2 and wrong.partition("=")[0].lstrip("+") in err


def test_train_photos_without_alpha_reject_other_background(run_cli, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    scene = bricks(size=16, train_views=4, val_views=1)
    flat = [Views.from_images(v.images[..., :3].contiguous(), v.cameras) for v in (scene.train, scene.val)]
    save_npz(Scene("flat", "made", *flat, scene.orbit, scene.bounds), tmp_path / "flat.npz")
    code, _, err = run_cli("dataset=photos", "dataset.path=flat.npz", "renderer.background=white")
    assert code == 2 and "renderer.background: found white, expected scene" in err
    monkeypatch.setenv("NERF_LIGHTNING_TRACEBACK", "1")
    assert "Traceback" in run_cli("budget.steps=0", "dataset.size=16")[2]


def test_lego_missing_file_falls_back_to_bricks(run_cli):
    small = ["dataset.resize=16", "callbacks.orbit.frames=0", "budget.steps=2", "dataset.rays=64"]
    code, out, err = run_cli("+experiment=lego", "dataset.download=false", *small)
    assert code == 0, err
    (warning,) = [line for line in (out + err).splitlines() if "WARNING" in line]
    assert "data/lego_200x200.npz does not exist" in warning
    assert "bricks" in warning
    assert any(line.startswith("bricks: ") for line in out.splitlines())


def test_resume_after_sigkill_gives_same_weights(run_cli, tmp_path: Path):
    """SIGKILL during training; the run still ends as the unbroken one does, to the last bit."""
    # Growing all the time: whatever the moment of the kill, sizes differ between the checkpoint and a fresh field.
    options = ["model=voxels", "model.base_resolution=8", "model.max_resolution=24", "model.growth_end=1.0"]
    options += ["model.stages=9", "optimizer.lr=0.15", "sampler.samples=64", "sampler.resolution=32"]
    options += ["dataset.size=16", "dataset.train_views=20", "dataset.val_views=2", "dataset.rays=512"]
    options += ["dataset.samples=8192", "callbacks.orbit.frames=0", "budget.steps=80", "threads=1"]
    options += ["callbacks.checkpoints.every_seconds=0.05"]
    assert run_cli(*options, "name=whole")[0] == 0
    process = start_cli(*options, "name=broken", cwd=tmp_path)
    deadline = time.monotonic() + 60
    state = None
    while state is None or state["global_step"] < 20:
        assert process.poll() is None, "the run ended before it could be killed"
        assert time.monotonic() < deadline
        time.sleep(0.05)
        saved = list(tmp_path.glob("outputs/broken/*/checkpoints/last.ckpt"))
        state = torch.load(saved[0], weights_only=True) if saved else None
    process.send_signal(signal.SIGKILL)
    process.communicate()
    run = (tmp_path / "outputs" / "broken" / "latest").resolve()
    assert not (run / "results.json").exists()
    code, _, err = run_cli(f"resume={run}")
    assert code == 0, err
    whole, broken = (tmp_path / "outputs" / name / "latest/checkpoints/last.ckpt" for name in ("whole", "broken"))
    first, second = (torch.load(path, weights_only=True) for path in (whole, broken))
    assert first["global_step"] == second["global_step"] == 80
    for key, value in first["state_dict"].items():
        assert torch.equal(value, second["state_dict"][key]), key


def test_resume_accepts_overrides_and_rejects_unknown_keys(run_cli, tmp_path: Path):
    assert run_cli("+experiment=smoke_2d", "dataset.max_side=16", *BARE, "budget.steps=5")[0] == 0
    run = (tmp_path / "outputs" / "smoke_2d" / "latest").resolve()
    code, _, err = run_cli(f"resume={run}", "budget.steps=9")
    assert code == 0, err
    assert yaml.safe_load((run / "results.json").read_text())["steps"] == 9
    code, _, err = run_cli(f"resume={run}", "sampler.samples=9")
    assert code == 2
    assert "sampler.samples" in err
    before = {name: (run / name).read_bytes() for name in ("config.yaml", "scene.json", "results.json")}
    code, _, err = run_cli(f"resume={run}", "model.width=24")
    assert code == 2 and "last.ckpt: " in err and err.count("\n") == 1
    assert {name: (run / name).read_bytes() for name in before} == before, "the run stays as it was"


def test_train_existing_run_requires_overwrite(run_cli, tmp_path: Path):
    small = ["+experiment=smoke_2d", "dataset.max_side=16", *BARE, "callbacks.checkpoints=null", "logger=null"]
    folder = tmp_path / "mine"
    assert run_cli(*small, "budget.steps=5", "callbacks.snapshots.steps=[2]", "hydra.run.dir=mine")[0] == 0
    (folder / "video.mp4").write_text("made from the run")
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*")}
    again = [*small, "budget.steps=3", "callbacks.snapshots.steps=[1]", "hydra.run.dir=mine"]
    code, _, err = run_cli(*again)
    assert code == 2 and err.count("\n") == 1 and "mine: holds a run already" in err and "overwrite=true" in err
    code, _, err = run_cli(*again, "overwrite=true", "callbacks.snapshots.view=7")
    assert code == 2, "another reason"
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*")} == before, "removed once the new run is sound"
    code, _, err = run_cli(*again, "overwrite=true")
    assert code == 0, err
    assert sorted(path.name for path in (folder / "snapshots").iterdir()) == ["step_0000001.png", "step_0000003.png"]
    assert sorted(path.name for path in folder.iterdir() if not path.name.startswith(".")) == [
        *("config.yaml", "final.png", "results.json", "scene.json", "snapshots", "truth.png")
    ]
    assert "overwrite" not in (folder / "config.yaml").read_text()
    with lock_folder(folder):
        code, _, err = run_cli(f"resume={folder}")
    assert code == 2 and "a run is in progress" in err and err.count("\n") == 1


def test_train_null_groups_are_left_out(run_cli, tmp_path: Path):
    """Also what an experiment sets in them."""
    small = ["dataset.size=16", "dataset.train_views=4", "dataset.val_views=1", "dataset.rays=64", "budget.steps=2"]
    nothing = ["callbacks=null", "logger=null", "recipe=null"]
    code, _, err = run_cli(*small, *nothing, "sampler.resolution=16", "hydra.run.dir=bare")
    assert code == 0, err
    assert {path.name for path in (tmp_path / "bare").glob("[!.]*")} == {"config.yaml", "results.json", "scene.json"}
    cfg = compose_config(["+experiment=capture", "dataset.path=x", "callbacks=null", "refine=null"], tmp_path)
    assert cfg.callbacks is None and cfg.refine is None


def test_train_user_keys_can_be_overridden(tmp_path: Path):
    (tmp_path / "own.yaml").write_text("# @package _global_\nslow: 0.1\noptimizer: {lr: '${slow}'}\n")
    given = [f"+experiment={os.path.relpath(tmp_path / 'own', conf_dir() / 'experiment')}"]
    assert compose_config(given, tmp_path).optimizer.lr == 0.1
    (tmp_path / "own.yaml").write_text("# @package _global_\nslow: 0.1\n")
    with pytest.raises(InputError, match="config: slow: found an unknown option"):
        compose_config(given, tmp_path)


def test_wheel_contains_configuration(tmp_path: Path):
    """Installed somewhere else, run from yet another folder, the package finds everything it needs."""
    build = [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "--no-build-isolation", "-w", str(tmp_path)]
    subprocess.run([*build, str(ROOT)], check=True, capture_output=True, timeout=120)
    (wheel,) = tmp_path.glob("*.whl")
    site = tmp_path / "site"
    zipfile.ZipFile(wheel).extractall(site)  # what installing it does, in a tenth of the time
    for folder, place in ((ROOT / "nerf_lightning", "."), (conf_dir(), "conf")):
        for path in folder.rglob("*"):
            installed = site / "nerf_lightning" / place / path.relative_to(folder)
            assert not path.is_file() or "__pycache__" in path.parts or installed.is_file(), path
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    process = start_cli("+experiment=smoke_2d", "--info=config", cwd=elsewhere, path=str(site))
    out, err = process.communicate(timeout=120)
    assert process.returncode == 0, err
    assert str(site / "nerf_lightning" / "conf") in out and str(ROOT) not in out
