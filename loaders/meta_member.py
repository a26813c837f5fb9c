"""The ``json`` member of a sample: an episode without its arrays, as canonical JSON.

META_FIELDS declares every entry once. Canonical means UTF-8, sorted names, no spaces, so that equal
episodes are equal bytes. Entries of ``Episode.meta`` that META_FIELDS names stand at the top, so
that an index may hold them as columns (None where the episode does not say); all others stay under
``meta``. Lists with a value a frame (PER_FRAME_META) are there in the short form of
``source_times``, or in full as older files have them; ``decode_meta`` returns the list.
"""

import json
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal, cast

import numpy as np
from numpy.typing import NDArray

from mint_hub.geometry.hand_state import NUM_SHAPE_PARAMS
from mint_hub.loaders import source_times
from mint_hub.loaders.fields import (
    PER_FRAME_META,
    EpisodeError,
    TextSegment,
    checked_key,
    checked_size,
    placed,
)
from mint_hub.loaders.member_table import META, Format
from mint_hub.loaders.schema import SCHEMA_VERSION, Episode, checked_version

Kind = Literal["string", "integer", "number", "array", "object", "any"]


@dataclass(frozen=True)
class MetaField:
    """Declaration of one entry of the ``json`` member; ``optional`` ones may be None."""

    name: str
    kind: Kind
    unit: str
    description: str
    optional: bool = False
    from_meta: bool = False


def _of_meta(name: str, kind: Kind, unit: str, description: str) -> MetaField:
    return MetaField(name, kind, unit, description, optional=True, from_meta=True)


META_FIELDS: Final = (
    MetaField("key", "string", "", "name of the episode and of its sample"),
    MetaField("schema_version", "integer", "", "newer ones than the reader's are refused"),
    MetaField("format", "string", "", "compact or lossless"),
    MetaField("num_frames", "integer", "frames", "T, rows of every npy member"),
    MetaField("fps", "number", "1/s", "frames a second"),
    MetaField("start_s", "number", "s", "presentation time of the first frame in the video"),
    MetaField("image_size_hw", "array", "px", "height and width of the video"),
    MetaField("shape", "array", "shape", "(2, 10) float32 shape, left then right (compact)"),
    MetaField("text", "array", "", "segments {id, text, side, start, end} of frames"),
    _of_meta("source", "string", "", "data set or file that the video is from"),
    _of_meta("uid", "string", "", "name of the video within its source"),
    _of_meta("participant", "string", "", "who wears the camera, where known"),
    _of_meta("domain", "string", "", "activity: daily, tabletop or kitchen"),
    _of_meta("native_fps", "number", "1/s", "frames a second of the video itself"),
    _of_meta("shape_space", "string", "", "mano or mint: what the shape numbers mean"),
    _of_meta("scale_status", "string", "", "whether lengths are metric"),
    _of_meta("conventions", "any", "", "axes and units of the labels, in words"),
    _of_meta("hand_model", "any", "", "hand model and version behind the labels"),
    _of_meta("pipeline", "any", "", "version of the labelling pipeline"),
    _of_meta(
        "quality",
        "any",
        "",
        "what quality checks said; its entry hands says why no hand can be read, if so: absent "
        "then does not mean that no hand was there",
    ),
    MetaField(
        "meta",
        "object",
        "",
        "the other entries of Episode.meta; source_timestamps_s in the short form of source_times",
    ),
)
"""Entries of the ``json`` member, declared once; all are always there."""

_BY_NAME: Final = {f.name: f for f in META_FIELDS}
_FROM_META: Final = tuple(f.name for f in META_FIELDS if f.from_meta)


def encode_meta(episode: Episode, format: Format, shape: NDArray[np.float32]) -> bytes:
    """Return the ``json`` member of an episode whose hands have this shape, (2, 10).

    Raises:
        EpisodeError: an entry of ``episode.meta`` has another type than META_FIELDS declares.

    """
    meta = dict(episode.meta)
    meta.pop("fps", None)
    for name in PER_FRAME_META:
        if meta.get(name) is not None:
            meta[name] = source_times.pack(meta[name])
    promoted = {name: meta.pop(name, None) for name in _FROM_META}
    values = {
        "key": episode.key,
        "schema_version": SCHEMA_VERSION,
        "format": format,
        "num_frames": episode.num_frames,
        "fps": episode.fps,
        "start_s": float(episode.timestamps_s[0]),
        "image_size_hw": list(episode.image_size_hw),
        "shape": [[float(str(number)) for number in hand] for hand in shape],
        "text": [segment.to_dict() for segment in episode.text],
        **promoted,
        "meta": meta,
    }
    for field in META_FIELDS:
        _check_kind(field, values[field.name])
    try:
        return canonical_json(values)
    except UnicodeEncodeError as error:
        raise EpisodeError(f"{META}: expected text that UTF-8 can say, got {error}") from error


def decode_meta(data: Any, where: str = "") -> dict[str, Any]:
    """Return the entries of a ``json`` member, each checked.

    Everything that ``Episode.meta`` holds (``fps`` and the entries named in META_FIELDS included)
    is under "meta" as well.

    Raises:
        EpisodeError: not JSON, a newer schema, or an entry is missing, unknown or wrong; names it,
            what was expected, what came, ``where`` and the episode.

    """
    key = ""
    try:
        values = _parsed(data)
        key = checked_key(values.get("key"))
        _check_entries(values)
        for name in PER_FRAME_META:
            if (times := values["meta"].get(name)) is not None:
                values["meta"][name] = source_times.unpack(times, values["num_frames"])
    except EpisodeError as error:
        raise placed(EpisodeError(f"{META} {error}"), where, key) from None
    stated = {name: values[name] for name in _FROM_META if values[name] is not None}
    values["meta"] = {**values["meta"], **stated, "fps": values["fps"]}
    return values


def canonical_json(value: object) -> bytes:
    """Return UTF-8 JSON with sorted names and no spaces."""
    text = json.dumps(
        value, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False
    )
    return text.encode()


def _parsed(data: Any) -> dict[str, Any]:
    try:
        values = json.loads(bytes(data))
    except (ValueError, RecursionError) as error:
        raise EpisodeError(f"member: expected JSON, got: {error}") from error
    if not isinstance(values, dict):
        raise EpisodeError(f"member: expected an object, got {type(values).__name__}")
    return cast("dict[str, Any]", values)


def _check_entries(values: Mapping[str, Any]) -> None:
    version = values.get("schema_version")
    _check_kind(_BY_NAME["schema_version"], version)
    checked_version(version)
    if missing := [name for name in _BY_NAME if name not in values]:
        raise EpisodeError(f"{missing[0]}: expected this entry, got none")
    if unknown := sorted(values.keys() - _BY_NAME.keys()):
        raise EpisodeError(f"{unknown[0]}: expected an entry of the schema, got an unknown name")
    for field in META_FIELDS:
        _check_kind(field, values[field.name])
    if values["format"] not in ("compact", "lossless"):
        raise EpisodeError(f"format: expected compact or lossless, got {values['format']!r}")
    for name in ("num_frames", "fps"):
        if values[name] <= 0:
            raise EpisodeError(f"{name}: expected a positive number, got {values[name]!r}")
    checked_size(values["image_size_hw"])
    _check_shape(values["shape"])
    for segment in values["text"]:
        TextSegment.from_dict(segment)


def _check_kind(field: MetaField, value: object) -> None:
    if value is None and field.optional:
        return
    if not _IS_KIND[field.kind](value):
        raise EpisodeError(f"{field.name}: expected {field.kind}, got {value!r}")


def _is_finite(value: object) -> bool:
    if not isinstance(value, int | float) or isinstance(value, bool):
        return False
    return abs(value) <= sys.float_info.max


_IS_KIND: Final[dict[Kind, Callable[[object], bool]]] = {
    "string": lambda value: isinstance(value, str),
    "integer": lambda value: isinstance(value, int) and not isinstance(value, bool),
    "number": _is_finite,
    "array": lambda value: isinstance(value, Sequence) and not isinstance(value, str),
    "object": lambda value: isinstance(value, Mapping),
    "any": lambda value: True,
}


def _check_shape(value: object) -> None:
    try:
        shape = np.asarray(value, np.float32)
    except (ValueError, TypeError):
        shape = np.empty(0)
    if shape.shape != (2, NUM_SHAPE_PARAMS) or not np.isfinite(shape).all():
        raise EpisodeError(f"shape: expected (2, {NUM_SHAPE_PARAMS}) finite numbers, got {value!r}")
