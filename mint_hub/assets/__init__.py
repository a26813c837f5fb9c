"""Data that travels with mint-hub, and the scripts that made it."""

from importlib import resources
from pathlib import Path


def read_asset(name: str) -> bytes:
    """Read a file of this folder; every reader comes through here.

    (In code copied to a hub repository this module is replaced, see `model/remote_code.py`.)
    """
    return (resources.files(__name__) / name).read_bytes()


def sample_clip() -> Path:
    """Return the path of the embedded clip: three synthetic seconds, made by `make_sample`."""
    return Path(__file__).with_name("sample.mp4")
