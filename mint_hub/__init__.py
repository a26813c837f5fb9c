"""mint-hub: egocentric video in, world-space camera and two-hand motion out."""

from mint_hub._version import __version__

__all__ = ["__version__"]
