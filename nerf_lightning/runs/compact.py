"""The compact file: a pruned, quantized trained system, as one .npz of plain arrays.

header                     JSON as bytes: format, version, config, scene, and the encoding of each array
field.NAME, sampler.NAME   parameters as float16, or as uint8 between the minimum and maximum of their column; masks as bits
NAME:range                 minimum and maximum of each uint8 column
"""

import io
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from nerf_lightning.config.build import build_system
from nerf_lightning.dataset.formats.checks import require_keys
from nerf_lightning.errors import InputError, attribute_errors_to
from nerf_lightning.runs.checkpoint import check_finite
from nerf_lightning.runs.folder import LoadedRun, parse_config
from nerf_lightning.runs.scene_file import parse_metadata
from nerf_lightning.system import System
from nerf_lightning.utils.device import CPU
from nerf_lightning.utils.parsing import VALUE_ERRORS, parse_json, read_file, read_npz, require_file

FORMAT, VERSION = "nerf_lightning compact", 1
MIN_QUANTIZED_SIZE = 2048
"""Minimum number of entries of an array stored as uint8; smaller ones, such as networks, stay float16."""
COARSE_STEP = 0.25
"""Quantization step of the "coarse" precision, in standard deviations of a column: few distinct codes, which compress well."""
MAX_HEADER_BYTES = 16 << 20
"""Limit for the decompressed JSON, which takes up to 32 times the memory; a thousand cameras are 4 MB."""
Arrays = dict[str, Any]  # of numpy arrays


def encode_system(system: System, precision: str, config: dict[str, Any], scene: dict[str, Any]) -> bytes:
    """Encodes a system as the content of a compact file.

    Args:
        system: trained; `prune_to_cells` removes what no camera sees.
        precision: "half", "byte" or "coarse".
        config, scene: of its run, see `runs.folder`.
    """
    arrays: Arrays = {}
    codes: dict[str, Any] = {}
    learned = dict(system.field.named_parameters())
    for part, module in system.exportable_modules.items():
        for name, tensor in module.export_state().items():
            code = "bits" if tensor.dtype == torch.bool else "half" if name in learned else "exact"
            if code == "half" and precision != "half" and tensor.numel() >= MIN_QUANTIZED_SIZE:
                code = "byte"
            key = f"{part}.{name}"
            codes[key] = {"code": code, "shape": list(tensor.shape)}
            arrays |= _quantize(key, tensor.detach().cpu().numpy(), code, precision == "coarse")
    header = {"format": FORMAT, "version": VERSION, "config": config, "scene": scene, "arrays": codes}
    return _pack(header, arrays)


def _quantize(name: str, array: np.ndarray, code: str, is_coarse: bool) -> Arrays:
    if code == "bits":
        return {name: np.packbits(array.reshape(-1))}
    if code == "half":
        limit = np.finfo(np.float16).max
        return {name: array.clip(-limit, limit).astype(np.float16)}
    if code == "exact":
        return {name: array}
    # Pruned entries are zero and would widen the range.
    rows = array.reshape(len(array), -1) if array.ndim < 3 else array.reshape(-1, array.shape[-1])
    used = rows[rows.any(1)] if rows.any() else rows
    low, high = used.min(0), used.max(0)
    if is_coarse:
        step = COARSE_STEP * used.std(0)
        low = np.maximum(low, used.mean(0) - 127 * step)
        high = low + 255 * step
    step = np.where(high > low, (high - low) / 255, 1)
    codes = np.rint((rows.clip(low, high) - low) / step).astype(np.uint8)
    codes[~rows.any(1)] = 0  # equal values compress well
    return {name: codes, f"{name}:range": np.stack([low, high]).astype(np.float32)}


@np.errstate(over="ignore")
def _dequantize(name: str, arrays: Arrays, code: str, shape: list[int]) -> Tensor:
    array = arrays[name]
    if code == "bits":
        if math.prod(shape) > 8 * array.size:
            raise ValueError(f"{name} has {8 * array.size} bits for the shape {shape}")
        array = np.unpackbits(array, count=math.prod(shape)).astype(bool)
    elif code == "half":
        array = array.astype(np.float32)
    elif code == "byte":
        low, high = arrays[f"{name}:range"]
        array = (low + array.astype(np.float32) * ((high - low) / 255)).astype(np.float32)
    elif code != "exact":
        raise ValueError(f"{name} is coded as {code!r}")
    return torch.from_numpy(array.reshape(shape).copy())


def decode_run(content: bytes, path: Path | str, device: torch.device = CPU) -> LoadedRun:
    """Decodes a compact file into a system ready to render.

    Args:
        content: of a compact file.
        path: its origin, for messages.

    Raises:
        InputError: the content is no compact file, damaged, of another version, or names an untrusted class.
    """
    header, arrays = _unpack(content, path)
    try:
        frame, orbit, to_source = parse_metadata(header["scene"], f"{path}: header.scene")
        cfg = parse_config(header["config"], path)
        with attribute_errors_to(path):
            system = build_system(cfg, frame, device)
        codes = header["arrays"].items()
        tensors = {key: _dequantize(key, arrays, entry["code"], entry["shape"]) for key, entry in codes}
        for part, module in system.exportable_modules.items():
            prefix = f"{part}."
            module.import_state({key[len(prefix) :]: value for key, value in tensors.items() if key.startswith(prefix)})
    except InputError:
        raise
    except VALUE_ERRORS as error:
        raise InputError(path, "", f"does not hold the model it names ({type(error).__name__}: {error})") from error
    check_finite(system, path)
    return LoadedRun(cfg, system.eval().to(device), orbit, to_source, header["scene"])


def _unpack(content: bytes, path: Path | str) -> tuple[dict[str, Any], Arrays]:
    """The header and the arrays of a compact file."""
    expected = "a compact file of this package"
    arrays = read_npz(content, None, path, expected)
    require_keys(path, arrays, ["header"])
    text = arrays.pop("header").tobytes()
    if len(text) > MAX_HEADER_BYTES:
        raise InputError(path, "header", f"{len(text)} bytes", f"{expected}: at most {MAX_HEADER_BYTES}")
    header = parse_json(text, f"{path}: header", expected)
    format_, version = (header.get(key) for key in ("format", "version")) if isinstance(header, dict) else (None, None)
    if (format_, version) != (FORMAT, VERSION):
        found = f"{format_}, version {version}"
        raise InputError(path, "header", found, f"{FORMAT}, version {VERSION}", "export the run again")
    return header, arrays


def strip_local_paths(content: bytes) -> bytes:
    """Replaces absolute paths in a compact file's header by their last component."""

    def strip(node: Any) -> Any:
        if isinstance(node, dict):
            return {key: strip(value) for key, value in node.items()}
        if isinstance(node, list):
            return [strip(value) for value in node]
        return Path(node).name if isinstance(node, str) and Path(node).is_absolute() else node

    header, arrays = _unpack(content, "compact")
    return _pack(strip(header), arrays)


def _pack(header: dict[str, Any], arrays: Arrays) -> bytes:
    file = io.BytesIO()
    np.savez_compressed(file, **arrays, header=np.frombuffer(json.dumps(header, allow_nan=False).encode(), np.uint8))
    return file.getvalue()


def load_compact(path: Path, device: torch.device = CPU) -> LoadedRun:
    """Reads a compact file, ready to render on a device; raises as `decode_run`, and for a missing file."""
    require_file(path, "a compact file", "nerf_lightning export compact makes one")
    return decode_run(read_file(path), path, device)
