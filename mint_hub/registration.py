"""Make transformers know MINT and datasets know mint-ego, in whatever order they are imported.

`import mint_hub` alone imports neither of them, nor torch: each hook below runs when the module
it names is imported, or at once if it already was (wrapt's post-import hooks). A hook may run in
the middle of some other import of transformers, so what it registers is a stand-in that imports
the real class at its first use; only the configuration, which needs next to nothing, is imported.
"""

from collections.abc import Callable
from importlib import import_module
from types import ModuleType
from typing import Any

import wrapt

AUTO = "transformers.models.auto"


def register() -> None:
    """Install the hooks."""
    for module, hook in HOOKS.items():
        wrapt.when_imported(module)(hook)


def _register_config(module: ModuleType) -> None:
    config = _config_class()
    module.AutoConfig.register(config.model_type, config, exist_ok=True)


def _register_class(
    mapping: str, source: str, name: str, backend: str | None = None
) -> Callable[[ModuleType], None]:
    """Make a hook that enters the class ``name`` for MINT configurations in an auto mapping.

    Mappings of image and video processors hold a class for each ``backend``.
    """

    def hook(module: ModuleType) -> None:
        stand_in: Any = wrapt.LazyObjectProxy(lambda: getattr(import_module(source), name))
        entry = stand_in if backend is None else {backend: stand_in}
        getattr(module, mapping).register(_config_class(), entry, exist_ok=True)

    return hook


def _register_pipeline(module: ModuleType) -> None:
    from mint_hub.assets import default_model
    from mint_hub.inference.pipeline_mint import register_pipeline

    register_pipeline(module.PIPELINE_REGISTRY, str(default_model()))


def _register_corpus(module: ModuleType) -> None:
    from mint_hub.loaders.hub import answer_name

    answer_name(module)


def _config_class() -> Any:
    from mint_hub.model.configuration_mint import MintConfig

    return MintConfig


_PROCESSING = "mint_hub.model.processing_mint"
HOOKS: dict[str, Callable[[ModuleType], None]] = {
    f"{AUTO}.configuration_auto": _register_config,
    f"{AUTO}.modeling_auto": _register_class(
        "MODEL_MAPPING", "mint_hub.model.modeling_mint", "MintModel"
    ),
    f"{AUTO}.video_processing_auto": _register_class(
        "VIDEO_PROCESSOR_MAPPING",
        _PROCESSING,
        "MintVideoProcessor",
        backend="torchvision",  # the backend that is asked for by default; ours needs none
    ),
    f"{AUTO}.processing_auto": _register_class("PROCESSOR_MAPPING", _PROCESSING, "MintProcessor"),
    "transformers.pipelines": _register_pipeline,
    "datasets.load": _register_corpus,
    "datasets.inspect": _register_corpus,
}
