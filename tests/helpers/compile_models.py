"""What torch.compile makes of fields and trainings, beside what they are without it: a process of its own, where no types are
checked, as the checks would be compiled too. Prints what it found as JSON.

python compile_models.py BACKEND FOLDER FIELD...     (trains in the folder)
"""

import copy
import json
import pickle
import sys
import warnings
from itertools import pairwise
from pathlib import Path

import torch
from torch._dynamo.utils import counters
from torch.nn.functional import normalize

from nerf_lightning.cameras import Bounds, Rays
from nerf_lightning.config import build
from nerf_lightning.config.compose import compose_config
from nerf_lightning.kernels import set_kernels
from nerf_lightning.model import Field, HashGridField, MLPField, TensoRFField, VoxelField
from nerf_lightning.renderer import VolumeRenderer
from nerf_lightning.sampler import Samples
from nerf_lightning.system.torch_compile import maybe_compile
from nerf_lightning.training import train as training
from tests.helpers.growth import grow
from tests.helpers.train_models import MODELS

BOX = Bounds(torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]]))
FIELDS = {
    "mlp": lambda: MLPField(BOX, depth=2, width=8, skip=1, position_frequencies=2, density="exp"),
    "hashgrid": lambda: HashGridField(BOX, 3, log2_hashmap_size=8, base_resolution=3, max_resolution=12, width=8),
    "tensorf": lambda: TensoRFField(BOX, 4, 4, base_resolution=6, max_resolution=10, stages=2, width=8),
    "voxels": lambda: VoxelField(BOX, base_resolution=6, max_resolution=10, stages=2),
}
GROWTH_CASES = ((5, 13, 0.0), (40, 300, 0.0), (7, 90, 1.0), (6, 40, 1.0))
"""Rays and samples, and the progress to which a field grows before."""


def evaluate_field(field: Field, renderer: VolumeRenderer | None, rays: Rays, samples: Samples, backend: str | None):
    """What a step asks of a field, with the renderer where there is one, and the gradients."""
    field.zero_grad()
    with torch.no_grad():
        density = maybe_compile(field.density, backend)(rays.origins)
    if renderer is None:
        values = maybe_compile(field.forward, backend)(samples.positions(rays), samples.directions(rays))[:2]
    else:
        rendered = maybe_compile(renderer.forward, backend)(rays, samples, field, torch.ones(len(rays), 3))
        values = rendered.rgb, rendered.opacity
    sum(value.square().sum() for value in values).backward()
    gradients = [parameter.grad.clone() for parameter in field.parameters() if parameter.grad is not None]
    return [density, *(value.detach() for value in values), *gradients]


def check_field(name: str, backend: str) -> dict[str, float]:
    """The largest difference, of the largest value in its tensor, and how many graphs were made at first, and anew."""
    field, renderer = FIELDS[name](), VolumeRenderer() if name == "mlp" else None  # the same for all
    keys, worst, before, graphs = list(field.state_dict()), 0.0, counters["stats"]["unique_graphs"], []
    for rays, count, progress in GROWTH_CASES:
        grow(field, progress)
        ray = torch.randint(0, rays, (count,)).sort().values
        bundle = Rays(torch.rand(rays, 3) - 0.5, normalize(torch.randn(rays, 3), dim=1))
        offsets = torch.searchsorted(ray, torch.arange(rays + 1))
        samples = Samples(torch.rand(count), torch.rand(count) / 10, ray, offsets)
        expected = evaluate_field(field, renderer, bundle, samples, None)
        found = evaluate_field(field, renderer, bundle, samples, backend)
        assert len(found) == len(expected)
        for one, other in zip(found, expected, strict=True):
            assert one.shape == other.shape
            worst = max(worst, float((one - other).abs().max() / other.abs().max().clamp_min(1e-6)))
        graphs.append(counters["stats"]["unique_graphs"])
        field = pickle.loads(pickle.dumps(copy.deepcopy(field)))
    assert list(field.state_dict()) == keys and isinstance(field, Field)
    fresh = [later - earlier for earlier, later in pairwise([before, *graphs])]
    return {"worst": worst, "compiled": fresh[0], "again": fresh[1] + fresh[3]}


def train(folder: Path, backend: str) -> list[float]:
    """The held-out PSNR of a small run, compiled and not."""
    build.COMPILE_BACKEND = training.COMPILE_BACKEND = backend
    options = [*MODELS["siren"], "model=siren", "model.depth=1", "budget.steps=30", "callbacks.snapshots=null"]
    options += ["device=cpu", "kernels=reference", "~logger"]
    return [training.train(compose_config([*options, f"compile={on}"], folder / on)) for on in ("true", "false")]


if __name__ == "__main__":
    warnings.filterwarnings("error", category=UserWarning)
    torch.manual_seed(0)
    set_kernels("reference")
    backend, folder, *names = sys.argv[1:]
    fields = {name: check_field(name, backend) for name in names}
    print(json.dumps({"fields": fields, "trained": train(Path(folder), backend)}))
