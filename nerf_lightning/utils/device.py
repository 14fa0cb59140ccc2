"""Device selection and synchronization."""

import torch

from nerf_lightning.errors import InputError

CPU = torch.device("cpu")


def available_devices() -> list[str]:
    """Available device types, best first: cuda, mps, cpu, then a backend registered with torch."""
    names = [name for name, kind in (("cuda", torch.cuda), ("mps", torch.backends.mps)) if kind.is_available()]
    backend = torch._C._get_privateuse1_backend_name()
    module = getattr(torch, backend, None)
    registered = backend != "privateuseone" and module is not None and module.is_available()
    return [*names, "cpu", *([backend] if registered else [])]


def resolve_device(name: str) -> torch.device:
    """The torch device of a name: auto (the best available), cpu, cuda, mps, or a backend registered with torch.

    Raises:
        InputError: for an unknown name, or a device that is not available.
    """
    available = available_devices()
    if name == "auto":
        return torch.device(available[0])
    if name in available:
        return torch.device(name)
    raise InputError("config", "device", repr(name), f"auto, or an available device: {', '.join(available)}")


def synchronize(device: torch.device) -> None:
    """Waits for an accelerator's queue to finish, so that timings are right."""
    if device.type != "cpu":
        torch.get_device_module(device).synchronize()
