"""A device that exists only in the dispatcher: what runs on it would run on a GPU, though the machine has none.

Its tensors keep their numbers in a CPU tensor, but refuse to meet CPU tensors and know no `.numpy()`. Autograd, modules, fused
optimizers and Lightning's Trainer work on it (`accelerator="pretend"`); what is asked of
it passes the dispatcher, so `benchmarks.op_counter` counts it. Random numbers come from the CPU's generators, as a
generator cannot live here.
"""

from typing import Any

import pytest
import torch
from lightning.pytorch.accelerators import Accelerator, AcceleratorRegistry
from torch.utils import _pytree as pytree
from torch.utils import backend_registration

from nerf_lightning.kernels import segment_sums

NAME = "pretend"
COPY_OPERATIONS = ("aten::_to_copy", "aten::copy_", "aten::_copy_from")


class FakeTensor(torch.Tensor):
    """A tensor on the device."""

    cpu_tensor: torch.Tensor
    has_float64 = True
    """Whether there is double precision on the device; Apple's has none."""

    @staticmethod
    def __new__(cls, cpu_tensor: torch.Tensor) -> "FakeTensor":
        if cpu_tensor.dtype == torch.float64 and not cls.has_float64:
            raise TypeError("this device has no double precision")
        kind = {"strides": cpu_tensor.stride(), "storage_offset": 0, "dtype": cpu_tensor.dtype}
        made = torch.Tensor._make_wrapper_subclass(cls, cpu_tensor.size(), device=f"{NAME}:0", **kind)
        made.cpu_tensor = cpu_tensor
        return made

    @classmethod
    def __torch_dispatch__(cls, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return dispatch(function, args, kwargs or {})

    @property
    def data(self) -> torch.Tensor:
        return torch._C.TensorBase.data.__get__(self)

    @data.setter
    def data(self, value: "FakeTensor") -> None:
        torch._C.TensorBase.data.__set__(self, value)
        self.cpu_tensor = value.cpu_tensor

    def numpy(self, *, force: bool = False) -> Any:
        raise TypeError("a tensor of another device has no numpy(): move it to the CPU first")

    def tolist(self) -> Any:
        return self.cpu().tolist()

    def __deepcopy__(self, memo: dict[int, Any]) -> "FakeTensor":
        made = FakeTensor(self.cpu_tensor.detach().clone()).requires_grad_(self.requires_grad)
        made.__dict__.update({key: value for key, value in self.__dict__.items() if key != "cpu_tensor"})
        memo[id(self)] = made
        return made

    def __reduce_ex__(self, protocol: Any) -> Any:
        """Files hold it as one of the CPU, where all that read files here want it."""
        return self.cpu_tensor.detach().requires_grad_(self.requires_grad).__reduce_ex__(protocol)


def dispatch(function: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    """An operation, if all its tensors are on the device; single numbers may be on the CPU, as for a GPU."""
    name = function._schema.name
    tensors = [leaf for leaf in pytree.tree_leaves((args, kwargs)) if isinstance(leaf, torch.Tensor)]
    mine = {id(tensor.cpu_tensor): tensor for tensor in tensors if isinstance(tensor, FakeTensor)}
    if mine and name not in COPY_OPERATIONS and any(not isinstance(x, FakeTensor) and x.dim() for x in tensors):
        raise RuntimeError(f"{name}: some tensors are on the device, some on the CPU")
    there = bool(mine)
    if kwargs.get("device") is not None:
        there, kwargs = torch.device(kwargs["device"]).type == NAME, {**kwargs, "device": "cpu"}
    kwargs.pop("pin_memory", None)
    raw_args, raw_kwargs = pytree.tree_map(lambda x: x.cpu_tensor if isinstance(x, FakeTensor) else x, (args, kwargs))
    out = function(*raw_args, **raw_kwargs)
    if name == "aten::copy_":
        return args[0]

    def wrapped(x: Any) -> Any:
        if not isinstance(x, torch.Tensor):
            return x
        # Operations in place give their own tensor back.
        return mine[id(x)] if id(x) in mine else FakeTensor(x) if there else x

    return pytree.tree_map(wrapped, out)


def empty_tensor(size: Any, *rest: Any, dtype: Any = None, **options: Any) -> FakeTensor:
    return FakeTensor(torch.empty(size, dtype=dtype))


def empty_strided(size: Any, stride: Any, dtype: Any = None, **options: Any) -> FakeTensor:
    return FakeTensor(torch.empty_strided(size, stride, dtype=dtype))


def copy_between_devices(source: torch.Tensor, target: torch.Tensor, non_blocking: bool = False) -> torch.Tensor:
    there, here = (x.cpu_tensor if isinstance(x, FakeTensor) else x for x in (target, source))
    there.copy_(here)
    return target


class PretendModule(backend_registration._DummyBackendModule):
    """`torch.pretend`."""

    present = False
    """Whether the device is: only for tests that ask for it, as others expect to find a CPU alone."""
    synchronizations = 0
    """Times that somebody waited for it."""

    def is_available(self) -> bool:
        return PretendModule.present

    def synchronize(self) -> None:
        PretendModule.synchronizations += 1


class FakeAccelerator(Accelerator):
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


def missing_support() -> str:
    """Why there can be no such device; "" where there can."""
    if not hasattr(backend_registration, "_setup_privateuseone_for_python_backend"):
        return "torch.utils.backend_registration cannot register a backend in Python (torch 2.13 can)"
    return ""


def register_device() -> None:
    """Makes the device known to torch and Lightning, where it can be. Before anything is differentiated: autograd counts the
    devices once."""
    if not missing_support():
        backend_registration._setup_privateuseone_for_python_backend(NAME, backend_module=PretendModule())
        for name, made in (
            ("empty.memory_format", empty_tensor),
            ("empty_strided", empty_strided),
            ("_copy_from", copy_between_devices),
        ):
            torch.library.impl(f"aten::{name}", "PrivateUse1")(made)
        AcceleratorRegistry.register(NAME, FakeAccelerator)


register_device()


@pytest.fixture
def device(monkeypatch: pytest.MonkeyPatch) -> torch.device:
    """The device. Generators made for it are the CPU's."""
    why = missing_support()
    if why:
        pytest.skip(why)
    generator = torch.Generator
    monkeypatch.setattr(PretendModule, "present", True)
    monkeypatch.setattr(torch, "Generator", lambda device="cpu": generator("cpu" if NAME in str(device) else device))
    return torch.device(NAME, 0)


@pytest.fixture
def device_without_float64(device: torch.device, monkeypatch: pytest.MonkeyPatch) -> torch.device:
    """The device as Apple's are: it knows no double precision."""
    monkeypatch.setattr(FakeTensor, "has_float64", False)
    monkeypatch.setattr(segment_sums, "DEVICES_WITHOUT_FLOAT64", (NAME,))
    return device
