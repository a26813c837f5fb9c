"""mint-hub: egocentric video in, world-space camera and two-hand motion out.

Importing this registers the names "mint" and "egocentric-hands" in transformers and "mint-ego" in
datasets, whichever is imported first, and imports none of them, nor torch. Public names below are
loaded when they are first used.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from mint_hub._version import __version__
from mint_hub.registration import register

if TYPE_CHECKING:
    from mint_hub.geometry.hand_model import HandModel
    from mint_hub.inference.runner import MintRunner, RunSettings
    from mint_hub.loaders.hub import load_dataset
    from mint_hub.loaders.schema import Episode
    from mint_hub.model.configuration_mint import MintConfig
    from mint_hub.model.modeling_mint import MintModel, MintOutput
    from mint_hub.model.processing_mint import MintProcessor, MintVideoProcessor

_LAZY = {
    "Episode": "loaders.schema",
    "HandModel": "geometry.hand_model",
    "MintConfig": "model.configuration_mint",
    "MintModel": "model.modeling_mint",
    "MintOutput": "model.modeling_mint",
    "MintProcessor": "model.processing_mint",
    "MintRunner": "inference.runner",
    "MintVideoProcessor": "model.processing_mint",
    "RunSettings": "inference.runner",
    "load_dataset": "loaders.hub",
}

__all__ = [
    "Episode",
    "HandModel",
    "MintConfig",
    "MintModel",
    "MintOutput",
    "MintProcessor",
    "MintRunner",
    "MintVideoProcessor",
    "RunSettings",
    "__version__",
    "load_dataset",
]


def __getattr__(name: str) -> Any:
    if name not in _LAZY:
        raise AttributeError(f"module 'mint_hub' has no attribute {name!r}")
    value = getattr(import_module(f"mint_hub.{_LAZY[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_LAZY})


register()
