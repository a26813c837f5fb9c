"""One episode in one ``.npz``: plain arrays, and JSON where there are no arrays. No pickle.

Members are stored uncompressed with a fixed date, in a fixed order, so equal episodes are equal
bytes. ``numpy.load(path)`` opens the file anywhere; ``json.loads(str(npz["meta"]))`` reads meta.
"""

import io
import json
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mint_hub.loaders.atomic import replacing
from mint_hub.loaders.fields import EpisodeError

JSON_MEMBERS: Final = ("text", "meta")
SUFFIX: Final = ".npz"


def write_episode(values: Mapping[str, Any], path: Path) -> Path:
    """Write what ``Episode.to_dict`` returns; the file appears whole or not at all."""
    return write_arrays(
        {
            name: np.asarray(json.dumps(value, sort_keys=True) if name in JSON_MEMBERS else value)
            for name, value in values.items()
        },
        path,
    )


def write_arrays(arrays: Mapping[str, NDArray[Any]], path: Path) -> Path:
    """Write arrays by name as one ``.npz``; it appears whole or not at all.

    Raises:
        EpisodeError: the path does not end in .npz.

    """
    if path.suffix != SUFFIX:
        raise EpisodeError(f"{path}: expected a name that ends in {SUFFIX}")
    with replacing(path) as temporary, zipfile.ZipFile(temporary, "w") as archive:
        for name, array in arrays.items():
            _write_member(archive, name, array)
    return path


def read_arrays(path: Path) -> dict[str, NDArray[Any]]:
    """Return the arrays of an ``.npz`` by name, every byte of them checked.

    Raises:
        FileNotFoundError: there is no such file.
        EpisodeError: not a whole npz file, or a member that is no plain array.

    """
    try:
        with zipfile.ZipFile(path) as archive:
            names = ((member, member.removesuffix(".npy")) for member in archive.namelist())
            return {name: _read_member(archive, member, name) for member, name in names}
    except zipfile.BadZipFile as error:
        raise EpisodeError(f"expected a whole npz file, got: {error}") from error


def read_episode(path: Path) -> dict[str, Any]:
    """Return what ``Episode.from_dict`` takes.

    Raises:
        FileNotFoundError: there is no such file.
        EpisodeError: not a whole npz file, or a member that is no plain array or no JSON.

    """
    values: dict[str, Any] = dict(read_arrays(path))
    for name in JSON_MEMBERS:
        try:
            values[name] = json.loads(str(values[name]))
        except KeyError:
            raise EpisodeError(f"{name}: expected this member, got none") from None
        except json.JSONDecodeError as error:
            raise EpisodeError(f"{name}: expected JSON, got: {error}") from error
    for name in ("key", "schema_version"):
        if name not in values:
            raise EpisodeError(f"{name}: expected this member, got none")
        values[name] = values[name].item() if values[name].ndim == 0 else values[name]
    return values


def _write_member(archive: zipfile.ZipFile, name: str, array: NDArray[Any]) -> None:
    buffer = io.BytesIO()
    np.lib.format.write_array(buffer, np.asarray(array, order="C"), (1, 0), allow_pickle=False)
    archive.writestr(zipfile.ZipInfo(f"{name}.npy", (1980, 1, 1, 0, 0, 0)), buffer.getvalue())


def _read_member(archive: zipfile.ZipFile, member: str, name: str) -> NDArray[Any]:
    data = archive.read(member)  # all of it, so that the checksum is tested
    try:
        return np.lib.format.read_array(io.BytesIO(data), allow_pickle=False)
    except (ValueError, EOFError) as error:
        raise EpisodeError(f"{name}: expected a plain npy array, got: {error}") from error
