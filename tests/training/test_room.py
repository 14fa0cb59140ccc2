"""What certainly does not fit into memory is refused before it is made."""

from collections.abc import Callable, Iterator
from functools import partial

import psutil
import pytest
import torch
from blob import BOX, around_it

from nerf_lightning.dataset import Picture, PixelDataModule, RayDataModule, Scene, Views
from nerf_lightning.errors import InputError
from nerf_lightning.model import Field, HashGridField, MLPField, PictureMLP, TensoRFField, VoxelField
from nerf_lightning.renderer import VolumeRenderer
from nerf_lightning.sampler import ImportanceSampler, OccupancySampler, ProposalSampler, Sampler, UniformSampler
from nerf_lightning.system import NeRF2D, NeRF3D
from nerf_lightning.training.room import check_room
from nerf_lightning.training.train import prepare_process
from nerf_lightning.utils.device import CPU
from nerf_lightning.utils.memory import Frugal, free_memory, out_of_memory

FREE = 64 * 2**20
small = partial(HashGridField, BOX, log2_entries=10)


@pytest.fixture(autouse=True)
def little_memory(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The same on every machine: 64 MiB."""

    class Memory:
        available = FREE

    monkeypatch.setattr(psutil, "virtual_memory", Memory)
    assert free_memory() == FREE
    yield


@pytest.mark.parametrize("kind", [HashGridField, TensoRFField, VoxelField, MLPField, OccupancySampler, ProposalSampler])
def test_what_fits_is_made_as_ever(kind: type):
    torch.manual_seed(0)
    plain = kind(BOX).state_dict()
    torch.manual_seed(0)
    with Frugal("config", "model"):
        made = kind(BOX).state_dict()
    assert all(torch.equal(plain[name], made[name]) for name in plain)


def test_threads_need_room_for_their_stacks():
    before = torch.get_num_threads()
    with pytest.raises(InputError, match="config: threads: found stacks of 1000 threads"):
        prepare_process(0, 1000, "auto")
    assert torch.get_num_threads() == before


@pytest.mark.parametrize(
    "make",
    [
        partial(HashGridField, BOX, features=10**17),
        partial(HashGridField, BOX, width=10**9),
        partial(TensoRFField, BOX, colour_components=10**18, coarsest=2**20, finest=2**20),
        partial(VoxelField, BOX, coarsest=2**20, finest=2**20),
        partial(MLPField, BOX, width=10**6),
        partial(OccupancySampler, BOX, resolution=2**20),
    ],
)
def test_tensors_that_do_not_fit_are_not_made(make: Callable[[], object]):
    said = "config: model: found numbers, .* GiB, expected at most the 0.1 GiB"
    with pytest.raises(InputError, match=said), Frugal("config", "model"):
        make()


def refusal(field: Field, sampler: Sampler, rays: int = 64, samples: int | None = None, chunk: int = 64) -> str:
    """What is said of a training; "" if it may begin."""
    cameras = around_it(2, 400)
    views = Views.of(torch.zeros(2, 400, 400, 3, dtype=torch.uint8), cameras)
    data = RayDataModule(Scene("nothing", "made", views, views, cameras, BOX), rays, samples)
    system = NeRF3D(field, sampler, VolumeRenderer(), torch.optim.Adam, float, chunk=chunk)
    try:
        check_room(system, data, CPU)
    except InputError as error:
        return str(error)
    return ""


def test_the_defaults_fit_everywhere():
    for sampler in (UniformSampler, ImportanceSampler, ProposalSampler, OccupancySampler):
        assert refusal(small(), sampler(BOX), 1024, 16384, 32768) == ""


@pytest.mark.parametrize(
    ("key", "make"),
    [
        ("model", lambda: refusal(TensoRFField(BOX, finest=2000), UniformSampler(BOX))),
        ("model", lambda: refusal(VoxelField(BOX, finest=2000), UniformSampler(BOX))),
        ("sampler.resolution", lambda: refusal(small(), OccupancySampler(BOX, resolution=128))),
        ("dataset.rays", lambda: refusal(small(), UniformSampler(BOX), rays=10**7)),
        ("dataset.rays", lambda: refusal(small(), UniformSampler(BOX, 10**9))),
        ("dataset.rays", lambda: refusal(small(), ImportanceSampler(BOX, fine=10**9))),
        ("dataset.rays", lambda: refusal(small(), ProposalSampler(BOX, first=10**9, log2_entries=10))),
        ("dataset.rays", lambda: refusal(small(), OccupancySampler(BOX, 10**9))),
        ("dataset.samples", lambda: refusal(small(), UniformSampler(BOX), 1024, 10**12)),
        ("limits.chunk", lambda: refusal(small(), UniformSampler(BOX), chunk=10**12)),
    ],
)
def test_a_training_that_does_not_fit_is_refused(key: str, make: Callable[[], str]):
    assert make().startswith(f"config: {key}: found ")


def test_pixels_that_do_not_fit_are_refused():
    image = torch.zeros(4, 4, 3, dtype=torch.uint8)
    system = NeRF2D(PictureMLP((4, 4)), torch.optim.Adam, float)
    check_room(system, PixelDataModule(Picture("nothing", "made", image)), CPU)
    with pytest.raises(InputError, match=r"config: dataset.pixels: found 10,000,000 pixels a step"):
        check_room(system, PixelDataModule(Picture("nothing", "made", image), 10**7), CPU)


def test_memory_that_ran_out_is_known_by_what_libraries_say():
    of_torch = "[enforce fail] DefaultCPUAllocator: can't allocate memory: you tried to allocate 5200 bytes."
    of_numpy = "Unable to allocate 7.45 GiB for an array with shape (1000000000,) and data type float64"
    found = {"5200 bytes": RuntimeError(of_torch), "7.45 GiB": MemoryError(of_numpy), "what was asked": MemoryError()}
    for asked, error in found.items():
        assert str(out_of_memory(error)).startswith(f"memory: found no room for {asked}, expected ")
    assert out_of_memory(RuntimeError("shapes differ")) is None
