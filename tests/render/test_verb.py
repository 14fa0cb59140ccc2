"""python -m nerf_lightning.render, on a run of seconds."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import pytest
import torch

from nerf_lightning.config import cli
from nerf_lightning.config.build import build_data
from nerf_lightning.config.compose import composed
from nerf_lightning.export.__main__ import task as export
from nerf_lightning.render.__main__ import task
from nerf_lightning.renderer import over
from nerf_lightning.runs.folder import load_run
from nerf_lightning.system import NeRF3D
from nerf_lightning.training.train import train

Render = Callable[..., tuple[int, str, str]]


@pytest.fixture
def render(small_run: Path, tmp_path: Path, verb) -> Render:
    """Renders a copy of the small run; returns exit code, output and errors."""
    shutil.copytree(small_run, tmp_path / "run")

    def run(*given: str) -> tuple[int, str, str]:
        run = () if any(one.startswith("run=") for one in given) else ("run=run",)
        return verb(
            lambda: cli.run("render", task, texts=("run", "path", "output", "background", "channels")), *run, *given
        )

    return run


def test_frames_show_what_the_system_renders(render: Render, tmp_path: Path):
    code, out, err = render("frames=2", "output=frames", "background=0.2,0.4,0.6", "device=cpu")
    assert code == 0, err
    assert out.startswith("frames: 2 frames of 16 x 16 pixels in ") and out.endswith(" s on cpu\n")
    run = load_run(tmp_path / "run")
    assert isinstance(run.system, NeRF3D) and run.orbit is not None
    run.system.renderer.colour = torch.tensor([0.2, 0.4, 0.6])
    expected = run.system.render(run.orbit.view_rays(round(len(run.orbit) / 4 - 0.5))).rgb
    shown = imageio.imread(tmp_path / "frames" / "00000.png")
    assert np.abs(shown.reshape(-1, 3) / 255 - expected.numpy()).max() <= 0.5 / 255 + 1e-6


def test_channels_stand_side_by_side_at_any_scale(render: Render, tmp_path: Path):
    code, _, err = render("frames=3", "channels=rgb,depth,opacity", "scale=1.5", "path=spiral", "output=film")
    assert code == 0, err
    frames = [imageio.imread(path) for path in (tmp_path / "film").glob("*.png")]
    assert [frame.shape for frame in frames] == [(24, 72, 3)] * 3
    assert all((frame[:, 48:, 0] == frame[:, 48:, 1]).all() for frame in frames), "opacity is grey"


def test_photos_stand_beside_their_renders(render: Render, tmp_path: Path):
    code, _, err = render("path=test", "channels=rgb,depth", "output=test")
    assert code == 0, err
    frames = sorted((tmp_path / "test").glob("*.png"))
    assert len(frames) == 2
    frame = imageio.imread(frames[0])
    assert frame.shape[1] == 4 * 160 and frame.shape[0] > 160, "truth, render, error, depth, magnified, and a caption"
    data = build_data(load_run(tmp_path / "run").cfg)
    truth = over(data.held_out(0).pixels, torch.zeros(256, 3)).view(16, 16, 3).numpy()
    assert np.abs(frame[5:160:10, 5:160:10] / 255 - truth).max() < 1 / 255


def test_compact_files_too_and_the_same_command_does_nothing_twice(render: Render, tmp_path: Path):
    export(composed(["run=run", "loss=9"], tmp_path, "export"))
    assert render("run=run/compact.npz", "frames=2", "background=transparent", "output=frames")[0] == 0
    assert imageio.imread(tmp_path / "frames" / "00001.png").shape == (16, 16, 4)
    code, out, _ = render("run=run/compact.npz", "frames=2", "background=transparent", "output=frames")
    assert code == 0 and "2 of them there already" in out
    code, _, err = render("run=run/compact.npz", "frames=2", "background=white", "output=frames")
    assert code == 2 and "something else in it" in err


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (["run=nowhere"], "nowhere/config.yaml: found nothing there"),
        (["run=nothing.npz"], "nothing.npz: found nothing there"),
        (["background=pink"], "background: found 'pink', expected scene, black, white, transparent, or R,G,B"),
        (["background=0.1,0.2"], "background: found '0.1,0.2'"),
        (["background=1,2,3"], "background: found '1,2,3'"),
        (["channels=rgb,normals"], "channels: found 'rgb,normals', expected one or more of rgb, depth, opacity"),
        (["channels=rgb,rgb"], "channels: found 'rgb,rgb'"),
        (["frames=0"], "frames: found 0, expected a whole number at least 1"),
        (["fps=0"], "fps: found 0"),
        (["scale=0"], "scale: found 0"),
        (["scale=2", "path=test"], "scale: found 2, expected scale=1 and a colour beside photos"),
        (["output=film.mov"], "output: found film.mov"),
        (["path=nowhere.json"], "nowhere.json: found nothing there"),
        (["path=test", "dataset.path=nowhere.npz"], "nowhere.npz"),
    ],
)
def test_bad_input_is_told_in_one_line_and_nothing_is_written(
    given: list[str], message: str, render: Render, tmp_path: Path
):
    before = sorted(tmp_path.rglob("*"))
    code, _, err = render(*given)
    assert code == 2 and err.count("\n") == 1 and message in err, err
    assert sorted(tmp_path.rglob("*")) == before


def test_half_written_runs_are_told(render: Render, tmp_path: Path):
    scene = tmp_path / "run" / "scene.json"
    content = json.loads(scene.read_text())
    scene.write_text(scene.read_text()[:100])
    code, _, err = render("frames=2")
    assert code == 2 and "scene.json" in err and "the scene of a run, whole" in err
    del content["orbit"]
    scene.write_text(json.dumps(content))
    assert render("frames=2")[0] == 2
    checkpoint = tmp_path / "run" / "checkpoints" / "last.ckpt"
    shutil.copy(tmp_path / "run" / "config.yaml", checkpoint)
    assert render("frames=2")[0] == 2


def test_pictures_have_no_paths(render: Render, tmp_path: Path):
    given = ["+experiment=smoke_2d", "dataset.max_side=16", "budget.steps=2", "~logger"]
    given += [f"callbacks.{one}=null" for one in ("training_gif", "charts", "baselines")]
    train(composed(given, tmp_path / "flat"))
    code, _, err = render("run=flat")
    assert code == 2 and "found a picture's run, expected a scene's run" in err
