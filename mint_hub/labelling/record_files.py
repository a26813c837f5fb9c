"""Records of the cascade as files: arrays and plain JSON in one ``.npz``, nothing unpickled.

A file holds one value made of records, tuples, lists, dicts, arrays, paths, strings and numbers,
and the fingerprint of what made it. It appears whole or not at all.
"""

import dataclasses
import io
import json
import zipfile
from pathlib import Path
from typing import Any, Final

import numpy as np

from mint_hub.labelling import records
from mint_hub.labelling.stage import Outcome
from mint_hub.loaders.atomic import replacing
from mint_hub.loaders.fields import TextSegment

_RECORDS: Final[dict[str, type]] = {
    kind.__name__: kind
    for kind in (
        records.CameraPath,
        records.Clip,
        records.Detections,
        records.Hands,
        records.Intrinsics,
        records.Lost,
        records.Scale,
        records.StageReport,
        records.Video,
        Outcome,
        TextSegment,
    )
}
_KIND = "$"


class RecordFileError(ValueError):
    """A file that is damaged or was not written here."""


def save(path: Path, value: Any, fingerprint: str = "") -> None:
    """Write ``value`` to ``path``, atomically.

    Raises:
        TypeError: the value holds something that is none of a record's parts.

    """
    arrays: dict[str, np.ndarray] = {}
    tree = {"fingerprint": fingerprint, "value": _encoded(value, arrays)}
    text = np.frombuffer(json.dumps(tree).encode(), np.uint8)
    buffer = io.BytesIO()
    np.savez(buffer, tree=text, **arrays)  # pyright: ignore[reportArgumentType]
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as temporary:
        temporary.write_bytes(buffer.getvalue())


def load(path: Path) -> tuple[Any, str]:
    """Return the value and the fingerprint written with it.

    Raises:
        FileNotFoundError: there is no such file.
        RecordFileError: names the file and what is wrong with it.

    """
    try:
        with np.load(path, allow_pickle=False) as stored:
            tree = json.loads(stored["tree"].tobytes())
            return _decoded(tree["value"], stored), str(tree["fingerprint"])
    except FileNotFoundError:
        raise
    except (OSError, ValueError, KeyError, TypeError, zipfile.BadZipFile, EOFError) as error:
        raise RecordFileError(
            f"{path}: expected a record of the cascade, got {type(error).__name__}: {error}"
        ) from None


def load_current(path: Path, fingerprint: str) -> Any | None:
    """Return the value if the file is there, whole and made by what ``fingerprint`` says."""
    try:
        value, stored = load(path)
    except (FileNotFoundError, RecordFileError):
        return None
    return value if stored == fingerprint else None


def _encoded(value: Any, arrays: dict[str, np.ndarray]) -> Any:
    if isinstance(value, np.ndarray):
        name = f"a{len(arrays)}"
        arrays[name] = value
        return {_KIND: "array", "name": name}
    if dataclasses.is_dataclass(value) and type(value).__name__ in _RECORDS:
        fields = {
            f.name: _encoded(getattr(value, f.name), arrays) for f in dataclasses.fields(value)
        }
        return {_KIND: type(value).__name__, "fields": fields}
    if isinstance(value, tuple):
        items: tuple[Any, ...] = value
        return {_KIND: "tuple", "items": [_encoded(item, arrays) for item in items]}
    if isinstance(value, Path):
        return {_KIND: "path", "path": str(value)}
    if isinstance(value, list):
        listed: list[Any] = value
        return [_encoded(item, arrays) for item in listed]
    if isinstance(value, dict):
        pairs: dict[str, Any] = value
        return {_KIND: "dict", "items": {k: _encoded(v, arrays) for k, v in pairs.items()}}
    if isinstance(value, np.generic):
        return value.item()
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise TypeError(f"expected parts of a record, got {type(value).__name__}")


def _decoded(value: Any, stored: Any) -> Any:
    if isinstance(value, list):
        listed: list[Any] = value
        return [_decoded(item, stored) for item in listed]
    if not isinstance(value, dict):
        return value
    node: dict[str, Any] = value
    match node[_KIND]:
        case "array":
            return stored[node["name"]]
        case "tuple":
            return tuple(_decoded(item, stored) for item in node["items"])
        case "path":
            return Path(node["path"])
        case "dict":
            return {k: _decoded(v, stored) for k, v in node["items"].items()}
        case kind:
            fields = {k: _decoded(v, stored) for k, v in node["fields"].items()}
            return _RECORDS[kind](**fields)
