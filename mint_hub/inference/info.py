"""What `mint-hub info` tells: versions, devices, hand models, and a checkpoint if one is named."""

import importlib.metadata
import math
import platform
from pathlib import Path
from typing import Any

import torch

from mint_hub._version import __version__
from mint_hub.assets import checkpoint_named, default_model
from mint_hub.geometry.hand_model import HandModel
from mint_hub.model.configuration_mint import MintConfig
from mint_hub.model.conversion_mint import RELEASE_MARKER, config_from_layout, read_layout

CORE = (
    *("torch", "transformers", "datasets", "huggingface-hub", "safetensors", "webdataset"),
    *("numpy", "scipy", "av", "opencv-python-headless", "wrapt"),
)
OPTIONAL = ("matplotlib", "rerun-sdk", "accelerate", "pycolmap", "pillow", "torchvision", "smplx")


def collect(model: str | None = None, mano_dir: Path | None = None) -> dict[str, Any]:
    """Facts as plain JSON values.

    Args:
        model: folder or hub repository of a checkpoint to describe, or "mint-tiny".
        mano_dir: folder with MANO's files.

    Raises:
        ValueError: the checkpoint cannot be described; FileNotFoundError: no MANO files there.

    """
    facts: dict[str, Any] = {
        "mint-hub": __version__,
        "python": platform.python_version(),
        "platform": platform.platform(),
        "packages": {name: _version(name) for name in CORE},
        "optional": {name: _version(name) for name in OPTIONAL},
        "devices": _devices(),
        "hand models": _hand_models(mano_dir),
        "default checkpoint": f"mint-tiny, embedded, synthetic clips only: {default_model()}",
    }
    if model is not None:
        facts["model"] = _describe_model(checkpoint_named(model))
    return facts


def describe(facts: dict[str, Any]) -> str:
    """The same for people, a fact a line."""
    lines: list[str] = []
    for name, value in facts.items():
        if isinstance(value, dict):
            lines.append(f"{name}:")
            items: dict[str, Any] = value  # pyright: ignore[reportUnknownVariableType]
            lines += [f"  {k:24} {'not installed' if v is None else v}" for k, v in items.items()]
        else:
            lines.append(f"{name:26} {value}")
    return "\n".join(lines)


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def _devices() -> dict[str, str]:
    devices = {"cpu": f"{torch.get_num_threads()} threads"}
    for i in range(torch.cuda.device_count()):
        properties = torch.cuda.get_device_properties(i)
        devices[f"cuda:{i}"] = f"{properties.name}, {properties.total_memory / 2**30:.0f} GiB"
    if torch.backends.mps.is_available():
        devices["mps"] = "Apple GPU"
    return devices


def _hand_models(mano_dir: Path | None) -> dict[str, str]:
    template = HandModel.template()
    found = {template.name: "embedded, licence-free"}
    used = HandModel.default(mano_dir)
    if used.name != template.name:
        found[used.name] = "your MANO files"
    else:
        found["mano"] = "no files found (optional; set MINT_HUB_MANO_DIR or pass --mano)"
    return found


def _describe_model(model: str) -> dict[str, Any]:
    layout = read_layout(model)
    theirs = RELEASE_MARKER in layout
    try:
        config = MintConfig.from_pretrained(model)
    except OSError:
        config = config_from_layout(layout, model)
    return {
        "source": model,
        "tensor names": "the public release's" if theirs else "ours",
        "tensors": len(layout),
        "parameters": f"{sum(math.prod(shape) for shape in layout.values()):,}",
        "image_size": f"{config.image_size[0]} x {config.image_size[1]}",
        "window": config.window,
        "shape_space": config.shape_space,
    }
