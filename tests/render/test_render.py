"""nerf_lightning render, on a run of seconds."""

import shutil
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import pytest
import torch

from nerf_lightning.cli.export import export_compact
from nerf_lightning.cli.render import render
from nerf_lightning.config.build import build_data
from nerf_lightning.errors import InputError
from nerf_lightning.renderer import composite_over
from nerf_lightning.runs.folder import load_run
from nerf_lightning.system import NeRF3D


@pytest.fixture
def run(small_run: Path, tmp_path: Path) -> Path:
    return shutil.copytree(small_run, tmp_path / "run")


def test_render_frames_show_what_the_system_renders(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    output = render(run, frames=2, output=tmp_path / "frames", background="0.2,0.4,0.6", device="cpu")
    assert "2 frames of 16 x 16 pixels" in capsys.readouterr().out
    found = load_run(run)
    assert isinstance(found.system, NeRF3D) and found.orbit is not None
    rays = found.orbit.generate_view_rays(round(len(found.orbit) / 4 - 0.5))
    expected = found.system.render(rays, background=(0.2, 0.4, 0.6)).rgb
    shown = imageio.imread(output / "00000.png")
    assert np.abs(shown.reshape(-1, 3) / 255 - expected.numpy()).max() <= 0.5 / 255 + 1e-6


def test_render_channels_are_side_by_side_at_any_scale(run: Path, tmp_path: Path):
    render(run, frames=3, channels="rgb,depth,opacity", scale=1.5, path="spiral", output=tmp_path / "video")
    frames = [imageio.imread(path) for path in (tmp_path / "video").glob("*.png")]
    assert [frame.shape for frame in frames] == [(24, 72, 3)] * 3
    assert all((frame[:, 48:, 0] == frame[:, 48:, 1]).all() for frame in frames), "opacity is gray"


def test_render_test_path_shows_photos_and_renders(run: Path, tmp_path: Path):
    render(run, path="test", channels="rgb,depth", output=tmp_path / "test")
    frames = sorted((tmp_path / "test").glob("*.png"))
    assert len(frames) == 2
    frame = imageio.imread(frames[0])
    assert frame.shape[1] == 4 * 160 and frame.shape[0] > 160, "truth, render, error, depth, magnified, and a caption"
    data = build_data(load_run(run).cfg)
    truth = composite_over(data.get_held_out_view(0).pixels, torch.zeros(256, 3)).view(16, 16, 3).numpy()
    assert np.abs(frame[5:160:10, 5:160:10] / 255 - truth).max() < 1 / 255


def test_render_compact_file_again_reuses_frames(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture):
    compact, frames = export_compact(run, max_psnr_drop=9), tmp_path / "frames"
    for there in ("cpu", "2 of them reused"):
        render(compact, frames=2, background="transparent", output=frames)
        assert there in capsys.readouterr().out
    assert imageio.imread(frames / "00001.png").shape == (16, 16, 4)
    with pytest.raises(InputError, match="holds other files"):
        render(compact, frames=2, background="white", output=frames)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"background": "1,2,3"}, "background: found '1,2,3'"),
        ({"channels": "rgb,normals"}, "channels: found 'rgb,normals'"),
        ({"frames": 0}, "frames: found 0"),
        ({"scale": 2.0, "path": "test"}, "scale: found 2"),
        ({"background": "transparent", "path": "train"}, "background: found transparent"),
        ({"output": Path("film.mov")}, "output: found film.mov"),
        ({"path": "dolly"}, "path: found 'dolly'"),
    ],
)
def test_render_bad_options_raise(given: dict, message: str, small_run: Path):
    with pytest.raises(InputError, match=message):
        render(small_run, **given)
    assert not list(small_run.glob("render_*"))
