"""Data that travels with mint-hub; the scripts that made it are in `mint_hub.synth`."""

from importlib import resources
from pathlib import Path


def read_asset(name: str) -> bytes:
    """Read a file of this folder; every reader comes through here.

    (In code copied to a hub repository this module is replaced, see `model/remote_code.py`.)
    """
    return (resources.files(__name__) / name).read_bytes()


def asset_path(name: str) -> Path:
    """Return where a file of this folder lies."""
    return Path(__file__).with_name(name)


def sample_clip() -> Path:
    """Return the path of the embedded clip: four synthetic seconds with exact truth beside it."""
    return asset_path("sample.mp4")


def default_model() -> Path:
    """Return the folder of the embedded network, mint-tiny: trained on synthetic clips only."""
    return asset_path("mint_tiny")


def checkpoint_named(name: str) -> str:
    """Return where a checkpoint lies: "mint-tiny" is the embedded one, any other is as named."""
    return str(default_model()) if name == "mint-tiny" and not Path(name).exists() else name
