"""The compact file renders what the run renders, in fewer bytes, or is refused."""

import io
import json
from pathlib import Path

import numpy as np
import pytest
import torch

from nerf_lightning.config.build import build_system, get_metadata
from nerf_lightning.config.compose import compose_config
from nerf_lightning.dataset import PixelDataModule, RayDataModule
from nerf_lightning.dataset.picture import make_builtin_picture
from nerf_lightning.dataset.pixel_datamodule import Picture
from nerf_lightning.errors import InputError
from nerf_lightning.export import compress
from nerf_lightning.runs.compact import MAX_HEADER_BYTES, decode_run, encode_system, load_compact, strip_local_paths
from nerf_lightning.runs.folder import config_to_dict
from nerf_lightning.runs.scene_file import scene_to_dict
from nerf_lightning.synthetic.objects import MARBLE, make_object_scene
from nerf_lightning.system import System

Run = tuple[System, RayDataModule | PixelDataModule, dict]


def make_run(folder: Path, *given: str) -> Run:
    """An untrained system in which there is something to see, its data and its configuration."""
    picture = "+experiment=picture" in given
    cfg = compose_config(["dataset=photos", f"dataset.path={folder}/scene.npz", *given][2 if picture else 0 :], folder)
    data: RayDataModule | PixelDataModule
    if picture:
        data = PixelDataModule(Picture("sunset", "test", make_builtin_picture(64)), pixels=10)
    else:
        data = RayDataModule(make_object_scene(MARBLE, size=12, views=4, held_out=2))
    system = build_system(cfg, get_metadata(data)).eval()
    with torch.no_grad():
        for parameter in system.field.parameters():
            parameter.add_(0.05 * torch.randn(parameter.shape))
    return system, data, config_to_dict(cfg)


def make_compact(run: Run, precision: str = "byte") -> bytes:
    system, data, config = run
    return encode_system(system, precision, config, scene_to_dict(data))


@pytest.mark.parametrize(
    "given",
    [
        ("recipe=tensorf_small",),
        ("recipe=hashgrid_small", "model.log2_hashmap_size=12", "sampler=uniform"),
        ("recipe=voxels_small", "model.base_resolution=8", "model.max_resolution=20"),
        ("recipe=mlp_small",),
        ("+experiment=picture",),
    ],
)
def test_compact_file_renders_like_the_run_in_fewer_bytes(given: tuple[str, ...], tmp_path: Path):
    run = make_run(tmp_path, *given)
    system, data, _ = run
    content = make_compact(run)
    small = decode_run(content, "compact").system
    size = sum(tensor.numel() * tensor.element_size() for tensor in system.state_dict().values())
    assert len(content) < 0.6 * size
    view = data.get_held_out_view(0)
    assert (system.evaluate(view).rgb - small.evaluate(view).rgb).abs().mean() < 0.01
    name, whole = max(system.field.export_state().items(), key=lambda item: item[1].numel())
    kept = small.field.export_state()[name]
    assert float((kept - whole).abs().max()) <= float(whole.max() - whole.min()) / 255


def test_compress_system_excessive_psnr_drop_raises(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    scores = iter([30.0, 29.5, 29.6, 29.7, 29.4])
    monkeypatch.setattr(compress, "measure_held_out_psnr", lambda *_, **__: next(scores))
    monkeypatch.setattr(compress, "find_seen_cells", lambda system, _: compress.get_occupied_cells(system) & False)
    with pytest.raises(InputError, match=r"0\.30 dB lost, expected at most 0\.1 dB"):
        compress.compress_system(*make_run(tmp_path, "recipe=hashgrid_small"), 0.1)


def test_strip_local_paths_removes_folders(tmp_path: Path):
    content = strip_local_paths(make_compact(make_run(tmp_path)))
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


def test_load_compact_damaged_or_untrusted_file_raises(tmp_path: Path):
    content = make_compact(make_run(tmp_path, "recipe=hashgrid_small", "model.log2_hashmap_size=10"))
    with np.load(io.BytesIO(content)) as file:
        config = json.loads(file["header"].tobytes())["config"]
    for damaged, words in (
        (b"", "unreadable as a compact file"),
        (content[: len(content) // 2], "unreadable as a compact file"),
        (with_header(content, version=99), "version 99"),
        (zeros_for_header(), "header: found 16777217 bytes"),
        (with_header(content, config={**config, "version": "9.9"}), "version 9.9"),
        (with_header(content, config={**config, "model": {"_target_": "os.system"}}), "a class of this package"),
        (with_header(content, arrays={}), "does not hold the model it names"),
        (with_header(content, scene=[]), "given.npz"),
    ):
        with pytest.raises(InputError, match=words):
            decode_run(damaged, "given.npz")
    with pytest.raises(InputError, match="no such file"):
        load_compact(tmp_path / "missing.npz")
