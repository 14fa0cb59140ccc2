"""Photos of several sizes through a fisheye, some masked: trained on, judged, filmed, exported and looked at."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import imageio.v3 as imageio
import numpy as np
import pytest
import torch

import nerf_lightning as nl
from nerf_lightning.callbacks import evaluation
from nerf_lightning.cameras import Cameras, Distortion, Lenses, Projection
from nerf_lightning.cli.evaluate import evaluate
from nerf_lightning.cli.export import export_compact
from nerf_lightning.cli.render import render
from nerf_lightning.dataset import Views
from nerf_lightning.renderer import RenderOutput
from nerf_lightning.synthetic.objects import PILE, make_hemisphere_cameras, render_photos
from nerf_lightning.system import NeRF3D
from nerf_lightning.view.geometry import iterate_frusta
from tests.helpers.scene_writers import colmap_cameras, write_colmap, write_photos

K1, STEPS = 0.02, 12
SMALL_SAMPLER = ["sampler.samples=32", "sampler.resolution=16"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """16 photos on gray: every second is twice as wide as high; a box is masked in every third."""
    root = tmp_path_factory.mktemp("capture")
    cameras = make_hemisphere_cameras(16, 24)
    lenses = Lenses(torch.tensor([Distortion(K1)]).repeat(16, 1), torch.full((16,), Projection.FISHEYE))
    square = Cameras(cameras.K, cameras.c2w, cameras.sizes, lenses)
    K = cameras.K.clone()
    K[:, 0, 2] += 12
    wide = Cameras(K, cameras.c2w, torch.tensor([[48, 24]]).repeat(16, 1), lenses)
    names, sizes = [], {}
    for i in range(16):
        camera = (wide if i % 2 else square)[i]
        some = Views.from_images(render_photos(PILE, camera, (0.5, 0.5, 0.5)), camera)
        names += write_photos(root / "images", some, first=i)
        sizes[i + 1] = colmap_cameras(some, "SIMPLE_RADIAL_FISHEYE", (K1,))[1]
        mask = np.full((24, camera.width), 255, np.uint8)
        mask[4:15, 3:13] = 0 if i % 3 == 0 else 255
        (root / "masks").mkdir(exist_ok=True)
        imageio.imwrite(root / "masks" / names[-1], mask)
    write_colmap(root / "sparse/0", cameras.c2w.numpy(), names, sizes)
    return root


def test_run_on_mixed_masked_fisheye_writes_outputs(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture):
    scene = nl.load_scene(folder)
    assert scene.train.valid_mask is not None and scene.train.cameras.lenses is not None
    assert sorted(map(tuple, scene.val.cameras.sizes.tolist())) == [(24, 24), (24, 24)]
    assert {tuple(size) for size in scene.train.cameras.sizes.tolist()} == {(24, 24), (48, 24)}
    options = ["callbacks.snapshots=null", "callbacks.orbit.frames=2", "~logger", *SMALL_SAMPLER]
    run = nl.train(scene, steps=STEPS, seed=1, device="cpu", folder=tmp_path / "run", options=options)
    assert np.isfinite(run.psnr) and run.psnr > 10

    judged = evaluate(run.path, device="cpu")
    assert np.mean([view["psnr"] for view in judged["views"]]) == pytest.approx(run.psnr, abs=0.02)
    assert imageio.imread(tmp_path / "run/evaluation/worst.png").ndim == 3

    film = tmp_path / "film.webp"
    render(run.path, path="train", frames=4, output=film, device="cpu")
    assert imageio.improps(film, plugin="pillow", index=...).n_images == 4, "frames of two sizes make one film"

    export_compact(run.path, max_psnr_drop=20.0, device="cpu")
    assert (tmp_path / "run/compact.npz").exists()
    assert len(list(iterate_frusta(scene.train, 16))) == len(scene.train)


def test_run_nan_renders_is_collapsed(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    render_well = NeRF3D.render

    def render_badly(self: NeRF3D, *given: Any, **options: Any) -> RenderOutput:
        rendered = render_well(self, *given, **options)
        self.corrections.poses.pose_adjustment.data.fill_(torch.nan)
        return replace(rendered, foreground=rendered.rgb * torch.nan, backgrounds=None)

    options = ["callbacks.snapshots=null", "callbacks.orbit=null", "callbacks.validation.fractions=[0.5]", "~logger"]
    options += ["refine=both", *SMALL_SAMPLER]
    monkeypatch.setattr(NeRF3D, "render", render_badly)
    monkeypatch.setattr(evaluation, "measure_aligned_psnr", lambda _, views, fraction: [math.nan] * len(views))
    found = nl.train(folder, steps=4, seed=1, device="cpu", folder=tmp_path / "run", options=options).results
    assert found["status"] == "collapsed"
    assert "corrections.poses.pose_adjustment is no longer finite" in found["diagnosis"]
    assert found["psnr"] is None and found["psnr_aligned"] is None and found["curve"] == []
    assert found["corrections"] is None
