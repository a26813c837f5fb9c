"""The task "egocentric-hands": `pipeline("egocentric-hands", model=...)("clip.mp4")`."""

from collections.abc import Iterable, Mapping
from dataclasses import fields
from os import PathLike
from typing import Any

from transformers.pipelines.base import Pipeline, PipelineRegistry
from transformers.utils import logging

from mint_hub.inference.devices import copies_on
from mint_hub.inference.runner import TASK, MintRunner, RunSettings
from mint_hub.inference.video_input import key_from_name
from mint_hub.loaders.schema import Episode
from mint_hub.model.frames_mint import is_decoded
from mint_hub.model.modeling_mint import MintModel
from mint_hub.model.processing_mint import MintProcessor
from mint_hub.model.saving_mint import SavesCode

logger = logging.get_logger(__name__)

_SETTINGS = frozenset(f.name for f in fields(RunSettings))
_PER_VIDEO = frozenset({"camera", "camera_poses", "key"})
_PER_CALL = frozenset({"progress", "warnings"})


class EgocentricHandsPipeline(SavesCode, Pipeline):
    """World-space camera and two-hand motion of egocentric videos, as one `Episode` each.

    Called with a path, URL, bytes, binary file or frames in memory it returns an `Episode`; with a
    list, a list of episodes; with a generator or a dataset, an iterator of episodes. An item may
    also be a mapping {"video": ..., "camera": ..., "camera_poses": ..., "key": ...}.

    Keyword arguments, here or in a call: every field of `RunSettings` (`fps`, `overlap`, `window`,
    `batch_size` = windows at once, `presence_threshold`, `smooth`, ...), `camera`, `camera_poses`,
    `key`, `progress`, `warnings`; see `MintRunner.run`. Here only: `hand_model`, and `devices`, to
    spread the windows of a video over several devices.
    """

    _load_processor = None  # optional: without one the model's own sizes are used
    _load_image_processor = False
    _load_video_processor = False
    _load_feature_extractor = False
    _load_tokenizer = False

    model: MintModel
    processor: MintProcessor

    def __init__(self, *args: Any, devices: list[str] | None = None, **kwargs: Any) -> None:
        hand_model = kwargs.pop("hand_model", None)
        batch_size = kwargs.pop("batch_size", None)
        super().__init__(*args, **kwargs)
        self.model.eval()
        if self.processor is None:  # pyright: ignore[reportUnnecessaryComparison]
            logger.warning("No processor beside the model: frames are resized to its image_size")
            self.processor = MintProcessor.for_config(self.model.config)
        # transformers batches by this attribute; windows are batched by the runner instead.
        self.feature_extractor = self.processor.video_processor
        if batch_size is not None:
            self._forward_params["batch_size"] = batch_size
        self.runner = MintRunner(
            copies_on(self.model, devices) if devices else [self.model], self.processor, hand_model
        )

    def __call__(self, inputs: Any, *args: Any, **kwargs: Any) -> Any:
        """See the class."""
        if isinstance(inputs, list) and not inputs:
            return []
        if is_decoded(inputs):
            inputs = {"video": inputs}
        elif _is_table(inputs):
            inputs = (_from_row(row) for row in inputs)
        batch_size = kwargs.pop("batch_size", None)
        if batch_size is not None:
            kwargs["windows_at_once"] = batch_size
        return super().__call__(inputs, *args, **kwargs)

    def save_pretrained(self, save_directory: str | PathLike[str], **kwargs: Any) -> None:
        """Save model and processor so that `pipeline(TASK, model=save_directory)` loads them.

        With ``remote_code=True`` (as in `push_to_hub`) the code comes along, see `SavesCode`.
        """
        self.model.save_pretrained(save_directory, **kwargs)
        self.processor.save_pretrained(save_directory, **kwargs)

    def _sanitize_parameters(self, **parameters: Any) -> tuple[dict[str, Any], ...]:
        if "windows_at_once" in parameters:
            parameters["batch_size"] = parameters.pop("windows_at_once")
        known = _SETTINGS | _PER_VIDEO | _PER_CALL
        if unknown := sorted(parameters.keys() - known):
            raise TypeError(
                f"{TASK}: unknown argument {unknown[0]!r}; expected one of {sorted(known)}"
            )
        return {}, parameters, {}

    def preprocess(self, input_: Any, **_: Any) -> dict[str, Any]:
        """An item to a mapping with "video"; decoding happens while the network runs."""
        item: dict[str, Any] = {"video": input_}
        if isinstance(input_, Mapping) and not input_.keys() <= {"path", "bytes"}:
            item = dict(input_)  # pyright: ignore[reportUnknownArgumentType]
            expected = _PER_VIDEO | {"video"}
            if "video" not in item or not item.keys() <= expected:
                raise ValueError(
                    f"{TASK}: expected a mapping with 'video' and at most {sorted(_PER_VIDEO)}, "
                    f"got {sorted(item)}"
                )
        return {"item": _Item(item)}

    def _forward(self, input_tensors: dict[str, Any], **parameters: Any) -> Any:
        item: dict[str, Any] = input_tensors["item"].values
        options = {k: v for k, v in parameters.items() if k in _PER_VIDEO | _PER_CALL}
        settings = RunSettings(**{k: v for k, v in parameters.items() if k in _SETTINGS})
        options |= {k: v for k, v in item.items() if k != "video"}
        return _Result(self.runner.run(item["video"], settings, **options))

    def postprocess(self, model_outputs: Any, **_: Any) -> Episode:
        """The episode."""
        return model_outputs.episode


def _from_row(row: Mapping[str, Any]) -> dict[str, Any]:
    """The video of a dataset's row, its key, and a camera if the row has a usable one."""
    names = [name for name in ("video", "mp4") if name in row]
    if not names:
        raise ValueError(
            f"{TASK}: expected a dataset with a column 'video' or 'mp4', got {sorted(row)}"
        )
    item: dict[str, Any] = {"video": row[names[0]]}
    key = row.get("key", row.get("__key__"))
    if isinstance(key, str):
        item["key"] = key_from_name(key)
    camera = row.get("camera")
    if camera is not None and not isinstance(camera, str):
        item["camera"] = camera
    return item


class _Item:
    """A video on its way; opaque, so that transformers moves none of it to a device."""

    def __init__(self, values: dict[str, Any]) -> None:
        self.values = values


class _Result:
    """An episode on its way back."""

    def __init__(self, episode: Episode) -> None:
        self.episode = episode


def register_pipeline(registry: PipelineRegistry, model: str) -> None:
    """Add the task to transformers' registry (idempotent), with the model it takes by default."""
    if TASK in registry.supported_tasks:
        return
    registry.register_pipeline(
        TASK,
        EgocentricHandsPipeline,
        pt_model=MintModel,
        default={"model": (model, "main")},
        type="multimodal",
    )


def _is_table(inputs: Any) -> bool:
    """Whether this is a `datasets` dataset, map-style or streaming (not a torch Dataset)."""
    return type(inputs).__module__.split(".")[0] == "datasets" and isinstance(inputs, Iterable)
