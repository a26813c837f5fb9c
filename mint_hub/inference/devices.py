"""Devices by name, checked before anything is moved there."""

import torch


def available_device(name: str) -> torch.device:
    """Read a device name and check that this machine has it.

    Raises:
        ValueError: no such device; the message lists those that are there.

    """
    there = available_devices()
    try:
        device = torch.device(name)
    except RuntimeError:
        device = None
    place = "" if device is None else device.type
    if place == "cuda":
        place = f"cuda:{device.index or 0}"  # pyright: ignore[reportOptionalMemberAccess]
    if device is None or place not in there:
        raise ValueError(f"device: expected one of {there}, got {name!r}")
    return device


def available_devices() -> list[str]:
    """Name the devices of this machine, the CPU last."""
    found = [f"cuda:{i}" for i in range(torch.cuda.device_count())]
    if torch.backends.mps.is_available():
        found.append("mps")
    return [*found, "cpu"]
