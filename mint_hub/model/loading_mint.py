"""Loading weights strictly: what is missing, unexpected, misshapen or broken is listed."""

import json
import logging as python_logging
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from huggingface_hub import is_offline_mode
from huggingface_hub.errors import StrictDataclassError
from safetensors import SafetensorError
from transformers.utils import cached_file, logging
from transformers.utils.hub import resolve_revision

from .configuration_mint import MintConfig
from .conversion_mint import config_from_layout, read_layout

logger = logging.get_logger(__name__)


def load_checked(
    cls: Any, load: Callable[..., Any], source: str | Path | None, *args: Any, **kwargs: Any
) -> Any:
    """Call transformers' own `from_pretrained`, then refuse what does not fit.

    Args:
        cls: the model class, for messages.
        load: the bound `PreTrainedModel.from_pretrained`.
        source: folder, repository, or None when `state_dict` is given (then nothing is checked: the
            caller chose the tensors).
        args: passed on.
        kwargs: passed on; `strict` (default True) is ours.

    Raises:
        ValueError: see `MintPreTrainedModel.from_pretrained`.
    """
    strict = kwargs.pop("strict", True)
    want_info = kwargs.pop("output_loading_info", False)
    if source is None:
        return load(source, *args, output_loading_info=want_info, **kwargs)
    revision = _resolve(source, kwargs)
    if revision is not None:
        kwargs["revision"] = revision
    if kwargs.get("config") is None and not _has_config(source, kwargs):
        kwargs["config"] = config_from_layout(_layout(source, kwargs), source)
    forgive = kwargs.pop("ignore_mismatched_sizes", not strict)
    # Sizes are forgiven while loading so that all faults are listed together, then refused here.
    report = python_logging.getLogger("transformers.modeling_utils")
    if strict:
        report.addFilter(_is_error)  # our own refusal says it; the level stays, others read it
    try:
        model, info = load(
            source, *args, output_loading_info=True, ignore_mismatched_sizes=True, **kwargs
        )
    except StrictDataclassError as error:
        raise ValueError(f"{source}: config.json: {error.__cause__ or error}") from error
    except SafetensorError as error:
        raise ValueError(f"{source}: model.safetensors is damaged or cut short: {error}") from error
    finally:
        report.removeFilter(_is_error)
    model.config._commit_hash = getattr(revision, "resolved", None)  # for the record of results
    faults = _describe_faults(info, count_mismatched=not forgive)
    if faults and strict:
        raise ValueError(f"{source}: these weights do not fit {cls.__name__}: {faults}")
    if faults:
        logger.warning("%s: loaded what fits %s; %s", source, cls.__name__, faults)
    broken = [
        name
        for name, tensor in model.state_dict().items()
        if not tensor.is_meta
        and tensor.is_floating_point()
        and not torch.isfinite(tensor.sum())
        and not torch.isfinite(tensor).all()
    ]
    if broken:
        raise ValueError(
            f"{source}: NaN or infinity in {len(broken)} tensors: {first_names(broken)}. "
            "The file is damaged or its training diverged"
        )
    return (model, info) if want_info else model


def _is_error(record: python_logging.LogRecord) -> bool:
    return record.levelno >= python_logging.ERROR


def _resolve(source: str | Path, kwargs: Mapping[str, Any]) -> str | None:
    """The commit a repository's revision stands for now, which everything below is read from."""
    keys = ("token", "local_files_only", "cache_dir")
    options = {k: kwargs[k] for k in keys if kwargs.get(k) is not None}
    return resolve_revision(source, kwargs.get("revision"), **options)


def _has_config(source: str | Path, kwargs: Mapping[str, Any]) -> bool:
    """Whether there is a configuration of ours; another project's says nothing about our sizes."""
    options = _hub_options(kwargs) | {"_raise_exceptions_for_missing_entries": False}
    found = cached_file(str(source), "config.json", **options)
    if found is None:
        return False
    try:
        values = json.loads(Path(found).read_text())
    except ValueError as error:
        raise ValueError(f"{source}: config.json is not JSON: {error}") from error
    return isinstance(values, dict) and values.get("model_type") == MintConfig.model_type


def _layout(source: str | Path, kwargs: Mapping[str, Any]) -> dict[str, tuple[int, ...]]:
    """Names and shapes of the weights: of a repository from their headers, or from the cache."""
    if Path(source).is_dir() or not (kwargs.get("local_files_only") or is_offline_mode()):
        hub = {k: kwargs[k] for k in ("revision", "token") if kwargs.get(k) is not None}
        return read_layout(source, **hub)
    options = _hub_options(kwargs) | {"_raise_exceptions_for_missing_entries": False}
    cached = cached_file(str(source), "model.safetensors", **options)
    if cached is None:
        raise OSError(
            f"{source}: expected in the cache, because the hub may not be asked (HF_HUB_OFFLINE or "
            "local_files_only); found neither config.json nor model.safetensors there"
        )
    return read_layout(Path(cached).parent)


def _hub_options(kwargs: Mapping[str, Any]) -> dict[str, Any]:
    keys = ("revision", "token", "cache_dir", "local_files_only", "subfolder", "force_download")
    return {k: kwargs[k] for k in keys if kwargs.get(k) is not None}


def _describe_faults(info: Mapping[str, Any], count_mismatched: bool) -> str:
    parts = []
    for kind in ("missing", "unexpected"):
        if names := sorted(info[f"{kind}_keys"]):
            parts.append(f"{len(names)} {kind}: {first_names(names)}")
    mismatched = sorted(info["mismatched_keys"]) if count_mismatched else []
    if mismatched:
        shapes = [
            f"{name} (expected {tuple(own)}, got {tuple(got)})" for name, got, own in mismatched
        ]
        parts.append(f"{len(mismatched)} of another shape: {first_names(shapes)}")
    return "; ".join(parts)


def first_names(names: Sequence[str], most: int = 8) -> str:
    """The first names of a list, and how many more."""
    rest = len(names) - most
    return ", ".join(names[:most]) + (f", and {rest} more" if rest > 0 else "")


def cast_weights(model: Any, dtype: torch.dtype) -> None:
    """Cast a model in place, except the modules that stay in float32 (the camera head)."""
    kept = model._keep_in_fp32_modules_strict or ()
    for name, child in model.named_children():
        child.to(torch.float32 if name in kept else dtype)
