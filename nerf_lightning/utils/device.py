"""Which device to use, and waiting for it."""

import torch

from nerf_lightning.errors import InputError

CPU = torch.device("cpu")


def available_devices() -> list[str]:
    """The kinds of devices available, best first, then any that is registered with torch. The CPU is always there."""
    found = [name for name, kind in (("cuda", torch.cuda), ("mps", torch.backends.mps)) if kind.is_available()]
    own = torch._C._get_privateuse1_backend_name()
    module = getattr(torch, own, None)
    registered = own != "privateuseone" and module is not None and module.is_available()
    return [*found, "cpu", *([own] if registered else [])]


def resolve_device(name: str) -> torch.device:
    """The device with a name.

    Args:
        name: "auto" for the best one available, or cpu, cuda, mps, or the name of a backend registered with torch.

    Raises:
        InputError: for another name, or a device that is not available.
    """
    found = available_devices()
    if name == "auto":
        return torch.device(found[0])
    if name in found:
        return torch.device(name)
    raise InputError("config", "device", repr(name), f"auto, or what is there: {', '.join(found)}")


def synchronize(device: torch.device) -> None:
    """Waits until a device has finished its queue, so that the clock is right; a CPU has none."""
    if device.type != "cpu":
        torch.get_device_module(device).synchronize()
