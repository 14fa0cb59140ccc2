"""The compact file renders what the run renders, in fewer bytes, or is refused."""

import io
import json
from pathlib import Path

import numpy as np
import pytest
import torch

from nerf_lightning.config.build import build_system, frame_of
from nerf_lightning.config.compose import composed
from nerf_lightning.dataset import PixelDataModule, RayDataModule
from nerf_lightning.dataset.picture import builtin_picture
from nerf_lightning.dataset.pixels import Picture
from nerf_lightning.errors import InputError
from nerf_lightning.export import smallest
from nerf_lightning.runs.compact import MAX_HEADER_BYTES, decode, encode, load_compact, without_folders
from nerf_lightning.runs.folder import plain_config
from nerf_lightning.runs.scene_file import scene_content
from nerf_lightning.synthetic.objects import MARBLE, make_scene
from nerf_lightning.system import System

Run = tuple[System, RayDataModule | PixelDataModule, dict]


def make_run(folder: Path, *given: str) -> Run:
    """An untrained system in which there is something to see, its data and its configuration."""
    picture = "+experiment=picture" in given
    cfg = composed(["dataset=photos", f"dataset.path={folder}/scene.npz", *given][2 if picture else 0 :], folder)
    data: RayDataModule | PixelDataModule
    if picture:
        data = PixelDataModule(Picture("sunset", "test", builtin_picture(64)), pixels=10)
    else:
        data = RayDataModule(make_scene(MARBLE, size=12, views=4, held_out=2))
    system = build_system(cfg, frame_of(data)).eval()
    with torch.no_grad():
        for parameter in system.field.parameters():
            parameter.add_(0.05 * torch.randn(parameter.shape))
    return system, data, plain_config(cfg)


def make_compact(run: Run, precision: str = "byte") -> bytes:
    system, data, config = run
    return encode(system, precision, config, scene_content(data))


@pytest.mark.parametrize(
    "given",
    [
        ("recipe=tensorf_small",),
        ("recipe=hashgrid_small", "model.log2_entries=12", "sampler=uniform"),
        ("recipe=voxels_small", "model.coarsest=8", "model.finest=20"),
        ("recipe=mlp_small",),
        ("+experiment=picture",),
    ],
)
def test_compact_file_renders_like_the_run_in_fewer_bytes(given: tuple[str, ...], tmp_path: Path):
    run = make_run(tmp_path, *given)
    system, data, _ = run
    content = make_compact(run)
    small = decode(content, "compact").system
    size = sum(tensor.numel() * tensor.element_size() for tensor in system.state_dict().values())
    assert len(content) < 0.6 * size
    view = data.held_out(0)
    assert (system.evaluate(view).rgb - small.evaluate(view).rgb).abs().mean() < 0.01
    name, whole = max(system.field.export_state().items(), key=lambda item: item[1].numel())
    kept = small.field.export_state()[name]
    assert float((kept - whole).abs().max()) <= float(whole.max() - whole.min()) / 255


def test_smallest_refuses_what_loses_too_much(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    scores = iter([30.0, 29.5, 29.6, 29.7, 29.4])
    monkeypatch.setattr(smallest, "held_out_psnr", lambda *_: next(scores))
    monkeypatch.setattr(smallest, "seen_cells", lambda system, _: smallest.occupied_cells(system) & False)  # not all
    with pytest.raises(InputError, match=r"0\.30 dB lost, expected at most 0\.1 dB"):
        smallest.smallest(*make_run(tmp_path, "recipe=hashgrid_small"), 0.1)


def test_compact_file_to_send_holds_no_folders(tmp_path: Path):
    content = without_folders(make_compact(make_run(tmp_path)))
    with np.load(io.BytesIO(content)) as file:
        header = file["header"].tobytes().decode()
    assert str(tmp_path) not in header and json.loads(header)["config"]["dataset"]["path"] == "scene.npz"


def with_header(content: bytes, **values: object) -> bytes:
    with np.load(io.BytesIO(content)) as file:
        arrays = {key: file[key] for key in file.files}
    header = {**json.loads(arrays["header"].tobytes()), **values}
    out = io.BytesIO()
    np.savez(out, **{**arrays, "header": np.frombuffer(json.dumps(header).encode(), np.uint8)})
    return out.getvalue()


def zeros_for_header() -> bytes:
    """Of a few bytes, which unpacked take much memory."""
    np.savez_compressed(out := io.BytesIO(), header=np.zeros(MAX_HEADER_BYTES + 1, np.uint8))
    return out.getvalue()


def test_damaged_or_untrusted_compact_file_is_refused(tmp_path: Path):
    content = make_compact(make_run(tmp_path, "recipe=hashgrid_small", "model.log2_entries=10"))
    with np.load(io.BytesIO(content)) as file:
        config = json.loads(file["header"].tobytes())["config"]
    for damaged, words in (
        (b"", "expected a compact file"),
        (content[: len(content) // 2], "expected a compact file"),
        (with_header(content, version=99), "version 99"),
        (zeros_for_header(), "header: found 16777217 bytes"),
        (with_header(content, config={**config, "version": "9.9"}), "version 9.9"),
        (with_header(content, config={**config, "model": {"_target_": "os.system"}}), "a class of this package"),
        (with_header(content, arrays={}), "the weights of the model"),
        (with_header(content, scene=[]), "given.npz"),
    ):
        with pytest.raises(InputError, match=words):
            decode(damaged, "given.npz")
    with pytest.raises(InputError, match="nothing there"):
        load_compact(tmp_path / "missing.npz")
