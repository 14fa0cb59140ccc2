"""A device that exists only in the dispatcher: what runs on it would run on a GPU, though the machine has none.

Its tensors keep their numbers in a CPU tensor, but refuse to meet CPU tensors and know no `.numpy()`. Autograd, modules, fused
optimisers and Lightning's Trainer work on it (`accelerator="pretend"`); what is asked of
it passes the dispatcher, so `benchmarks.count` counts it. Random numbers come from the CPU's generators, as a generator cannot
live here.
"""

from typing import Any

import pytest
import torch
from lightning.pytorch.accelerators import Accelerator, AcceleratorRegistry
from torch.utils import _pytree as pytree
from torch.utils import backend_registration

from nerf_lightning.kernels import sums

NAME = "pretend"
MOVES = ("aten::_to_copy", "aten::copy_", "aten::_copy_from")


class Pretend(torch.Tensor):
    """A tensor on the device."""

    raw: torch.Tensor
    doubles = True
    """Whether there is double precision on the device; Apple's has none."""

    @staticmethod
    def __new__(cls, raw: torch.Tensor) -> "Pretend":
        if raw.dtype == torch.float64 and not cls.doubles:
            raise TypeError("this device has no double precision")
        made = torch.Tensor._make_wrapper_subclass(
            cls, raw.size(), strides=raw.stride(), storage_offset=0, dtype=raw.dtype, device=f"{NAME}:0"
        )
        made.raw = raw
        return made

    @classmethod
    def __torch_dispatch__(cls, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return run(function, args, kwargs or {})

    @property
    def data(self) -> torch.Tensor:
        return torch._C.TensorBase.data.__get__(self)

    @data.setter
    def data(self, value: "Pretend") -> None:
        torch._C.TensorBase.data.__set__(self, value)
        self.raw = value.raw

    def numpy(self, *, force: bool = False) -> Any:
        raise TypeError("a tensor of another device has no numpy(): move it to the CPU first")

    def tolist(self) -> Any:
        return self.cpu().tolist()

    def __deepcopy__(self, memo: dict[int, Any]) -> "Pretend":
        made = Pretend(self.raw.detach().clone()).requires_grad_(self.requires_grad)
        made.__dict__.update({key: value for key, value in self.__dict__.items() if key != "raw"})
        memo[id(self)] = made
        return made

    def __reduce_ex__(self, protocol: Any) -> Any:
        """Files hold it as one of the CPU, where all that read files here want it."""
        return self.raw.detach().requires_grad_(self.requires_grad).__reduce_ex__(protocol)


def run(function: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    """An operation, if all its tensors are on the device; single numbers may be on the CPU, as for a GPU."""
    name = function._schema.name
    tensors = [leaf for leaf in pytree.tree_leaves((args, kwargs)) if isinstance(leaf, torch.Tensor)]
    mine = {id(tensor.raw): tensor for tensor in tensors if isinstance(tensor, Pretend)}
    if mine and name not in MOVES and any(not isinstance(x, Pretend) and x.dim() for x in tensors):
        raise RuntimeError(f"{name}: some tensors are on the device, some on the CPU")
    there = bool(mine)
    if kwargs.get("device") is not None:
        there, kwargs = torch.device(kwargs["device"]).type == NAME, {**kwargs, "device": "cpu"}
    kwargs.pop("pin_memory", None)
    raw_args, raw_kwargs = pytree.tree_map(lambda x: x.raw if isinstance(x, Pretend) else x, (args, kwargs))
    out = function(*raw_args, **raw_kwargs)
    if name == "aten::copy_":
        return args[0]

    def wrapped(x: Any) -> Any:
        if not isinstance(x, torch.Tensor):
            return x
        # Operations in place give their own tensor back.
        return mine[id(x)] if id(x) in mine else Pretend(x) if there else x

    return pytree.tree_map(wrapped, out)


def empty(size: Any, *rest: Any, dtype: Any = None, **options: Any) -> Pretend:
    return Pretend(torch.empty(size, dtype=dtype))


def empty_strided(size: Any, stride: Any, dtype: Any = None, **options: Any) -> Pretend:
    return Pretend(torch.empty_strided(size, stride, dtype=dtype))


def copied(source: torch.Tensor, target: torch.Tensor, non_blocking: bool = False) -> torch.Tensor:
    there, here = (x.raw if isinstance(x, Pretend) else x for x in (target, source))
    there.copy_(here)
    return target


class Module(backend_registration._DummyBackendModule):
    """`torch.pretend`."""

    there = False
    """Whether the device is: only for tests that ask for it, as others expect to find a CPU alone."""
    waited = 0
    """Times that somebody waited for it."""

    def is_available(self) -> bool:
        return Module.there

    def synchronize(self) -> None:
        Module.waited += 1


class PretendAccelerator(Accelerator):
    """Lightning's side of it."""

    def setup_device(self, device: torch.device) -> None:
        assert device.type == NAME

    def teardown(self) -> None:
        pass

    @staticmethod
    def parse_devices(devices: Any) -> int:
        return int(devices)

    @staticmethod
    def get_parallel_devices(devices: int) -> list[torch.device]:
        return [torch.device(NAME, index) for index in range(devices)]

    @staticmethod
    def auto_device_count() -> int:
        return 1

    @staticmethod
    def is_available() -> bool:
        return True

    @staticmethod
    def name() -> str:
        return NAME


def missing() -> str:
    """Why there can be no such device; "" where there can."""
    if not hasattr(backend_registration, "_setup_privateuseone_for_python_backend"):
        return "torch.utils.backend_registration cannot register a backend in Python (torch 2.13 can)"
    return ""


def register() -> None:
    """Makes the device known to torch and Lightning, where it can be. Before anything is differentiated: autograd counts the
    devices once."""
    if not missing():
        backend_registration._setup_privateuseone_for_python_backend(NAME, backend_module=Module())
        for name, made in (("empty.memory_format", empty), ("empty_strided", empty_strided), ("_copy_from", copied)):
            torch.library.impl(f"aten::{name}", "PrivateUse1")(made)
        AcceleratorRegistry.register(NAME, PretendAccelerator)


register()


@pytest.fixture
def device(monkeypatch: pytest.MonkeyPatch) -> torch.device:
    """The device. Generators made for it are the CPU's."""
    why = missing()
    if why:
        pytest.skip(why)
    generator = torch.Generator
    monkeypatch.setattr(Module, "there", True)
    monkeypatch.setattr(torch, "Generator", lambda device="cpu": generator("cpu" if NAME in str(device) else device))
    return torch.device(NAME, 0)


@pytest.fixture
def without_doubles(device: torch.device, monkeypatch: pytest.MonkeyPatch) -> torch.device:
    """The device as Apple's are: it knows no double precision."""
    monkeypatch.setattr(Pretend, "doubles", False)
    monkeypatch.setattr(sums, "WITHOUT_DOUBLE", (NAME,))
    return device
