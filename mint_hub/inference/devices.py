"""Devices by name, checked before anything is moved there."""

import copy
from collections.abc import Sequence
from typing import TypeVar

import torch

ModuleT = TypeVar("ModuleT", bound=torch.nn.Module)


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


def copies_on(model: ModuleT, names: Sequence[str]) -> list[ModuleT]:
    """Move a network to a device, and copies of it to the others, in the order of their names.

    Raises:
        ValueError: no such device.

    """
    devices = [available_device(name) for name in names]
    copies = [*(copy.deepcopy(model) for _ in devices[1:]), model]
    for copied, device in zip(copies, devices, strict=True):
        torch.nn.Module.to(copied, device)
    return copies
