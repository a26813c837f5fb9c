"""A runner from the name of a checkpoint, for every verb alike."""

from collections.abc import Sequence
from pathlib import Path

from mint_hub.assets import checkpoint_named
from mint_hub.geometry.hand_model import HandModel
from mint_hub.inference.devices import available_devices, copies_on
from mint_hub.inference.runner import MintRunner
from mint_hub.model.modeling_mint import MintModel
from mint_hub.model.processing_mint import MintProcessor


def open_model(
    name: str | None = None, dtype: str = "auto", revision: str | None = None
) -> MintModel:
    """Load a checkpoint.

    Args:
        name: folder or hub repository; None or "mint-tiny": the embedded one.
        dtype: "auto", that of the file, or a name of torch's.
        revision: of a hub repository.

    Raises:
        ValueError: a name that looks like a folder, and there is none.
        OSError: no checkpoint can be read there.

    """
    name = checkpoint_named(name or "mint-tiny")
    if name.startswith((".", "/", "~")) and not Path(name).expanduser().is_dir():
        raise ValueError(f"{name}: expected a folder with a checkpoint, found no such folder")
    return MintModel.from_pretrained(name, dtype=dtype, revision=revision)


def runner_of(
    model: MintModel, devices: Sequence[str] = (), hand_model: HandModel | None = None
) -> MintRunner:
    """Make a runner of a network, copied to devices by name; without any, to the best here.

    Raises:
        ValueError: no such device.

    """
    models = copies_on(model.eval(), devices or available_devices()[:1])
    return MintRunner(models, MintProcessor.for_config(model.config), hand_model)
