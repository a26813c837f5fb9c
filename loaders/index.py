"""The index of a split: where each episode lies, and what its json says, beside the shards.

Row i of ``index.npy`` (24 bytes) and row i of ``episodes.parquet`` are sample i, in the order of
the shards. The parquet file has every entry of the json members but the arrays (META_FIELDS), the
share of frames in which each hand is present, and the place and crc32 of the sample, so that it
says which episodes a damaged shard has lost. Both are made from the written shards alone.
"""

import json
import os
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from mint_hub.conventions import SIDES
from mint_hub.loaders import members as sample_members
from mint_hub.loaders.fields import PER_FRAME_META
from mint_hub.loaders.manifest import EPISODES, INDEX, Manifest, read_manifest
from mint_hub.loaders.meta_member import META_FIELDS, MetaField, decode_meta
from mint_hub.loaders.stats import CorpusStats
from mint_hub.loaders.tar_layout import Buffer, CorpusError, Sample, map_file, samples_in

if TYPE_CHECKING:
    import pyarrow as pa

ROW: Final = np.dtype(
    [
        ("shard", "<u4"),
        ("num_frames", "<u4"),
        ("offset", "<u8"),
        ("size", "<u4"),
        ("arrays", "<u4"),
    ]
)
"""A row of the index: number of the shard; T; where the sample begins in it, bytes; its bytes with
headers and padding; and how far into the sample the header of the first npy member is, bytes."""

_PLACE: Final = {"shard": "int32", "offset": "int64", "size": "int64", "crc32": "int64"}


@dataclass(frozen=True)
class Index:
    """Where every episode of a split lies: rows stay on disk, memory-mapped, until looked at.

    Attributes:
        folder: the split.
        manifest: its ``shards.json``.
        rows: (N,) of dtype ROW.

    """

    folder: Path
    manifest: Manifest
    rows: NDArray[np.void]

    @classmethod
    def load(cls, split_folder: str | os.PathLike[str]) -> "Index":
        """Open the index of a complete split.

        Raises:
            CorpusError: the split is not complete, or ``index.npy`` is not of its ``shards.json``.

        """
        folder = Path(split_folder)
        manifest = read_manifest(folder)
        rows = read_rows(folder / INDEX)
        if len(rows) != manifest.num_episodes:
            raise CorpusError(
                f"{folder / INDEX}: expected {manifest.num_episodes} rows, got {len(rows)}"
            )
        return cls(folder, manifest, rows)

    def __len__(self) -> int:
        return len(self.rows)

    @cached_property
    def paths(self) -> tuple[Path, ...]:
        """Paths of the shards, by number."""
        return tuple(self.folder / shard.name for shard in self.manifest.shards)

    @cached_property
    def first_rows(self) -> NDArray[np.int64]:
        """First row of each shard, then N: (shards + 1,)."""
        return np.cumsum([0, *(shard.samples for shard in self.manifest.shards)])

    def episodes(self, columns: Sequence[str] | None = None) -> "pa.Table":
        """Return ``episodes.parquet``, all columns or some; row i is sample i."""
        return read_episodes(self.folder, columns)


# ------------------------------------------------------------ one shard, read


@dataclass(frozen=True)
class ShardSummary:
    """What the bytes of one shard say: index rows, parquet rows and statistics."""

    rows: NDArray[np.void]
    episodes: "pa.Table"
    stats: CorpusStats

    @property
    def num_frames(self) -> int:
        """Frames of all its episodes."""
        return int(self.rows["num_frames"].sum())


def summarise(path: Path, shard: int, names: Sequence[str], halvings: int = 0) -> ShardSummary:
    """Read a whole shard and check that every sample has exactly the members ``names``.

    ``halvings`` says how few chunks of actions the statistics look at: see ``ActionStats``.

    Raises:
        CorpusError: the shard is cut or damaged, or a sample has other members.
        EpisodeError: a json or npy member breaks the schema.

    """
    buffer, where = map_file(path), path.name
    stats = CorpusStats(halvings)
    rows: list[tuple[int, ...]] = []
    records: list[dict[str, Any]] = []
    for sample in samples_in(buffer, where):
        if (got := tuple(m.name for m in sample.members)) != tuple(names):
            raise CorpusError(
                f"{where}, episode {sample.key}: expected members {list(names)}, got {list(got)}"
            )
        meta, arrays = _read(buffer, sample, where)
        stats.add(meta, arrays)
        rows.append(_row(sample, shard, int(meta["num_frames"])))
        crc = zlib.crc32(buffer[sample.offset : sample.offset + sample.size])
        place = {"shard": shard, "offset": sample.offset, "size": sample.size, "crc32": crc}
        records.append({**_columns(meta), **_presence(arrays), **place})
    table = episodes_table(records)
    return ShardSummary(np.array(rows, ROW), table, stats)


def build_index(path: str | os.PathLike[str], shard: int = 0) -> NDArray[np.void]:
    """Return the index rows of one shard file, (N,) of dtype ROW.

    Raises:
        CorpusError: the shard is cut or damaged.

    """
    buffer, where = map_file(path), Path(path).name
    rows: list[tuple[int, ...]] = []
    for sample in samples_in(buffer, where):
        meta = sample.members[0]
        values = decode_meta(buffer[meta.offset : meta.offset + meta.size], where)
        rows.append(_row(sample, shard, values["num_frames"]))
    return np.array(rows, ROW)


def _read(
    buffer: Buffer, sample: Sample, where: str
) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
    place = f"{where}, episode {sample.key}"
    parts = {m.name: buffer[m.offset : m.offset + m.size] for m in sample.members}
    meta = decode_meta(parts.pop(sample_members.META), place)
    arrays = sample_members.arrays_of(parts, place)
    if meta["key"] != sample.key:
        raise CorpusError(f"{place}: expected that key in its json, got {meta['key']!r}")
    for name, array in arrays.items():
        if len(array) != meta["num_frames"]:
            raise CorpusError(
                f"{place}, {name}: expected {meta['num_frames']} frames, got {len(array)}"
            )
    return meta, arrays


def _row(sample: Sample, shard: int, num_frames: int) -> tuple[int, ...]:
    if sample.size >= 2**32:
        raise CorpusError(f"episode {sample.key}: expected below 4 GiB, got {sample.size} bytes")
    arrays = sample.members[1].offset - 512 - sample.offset if len(sample.members) > 1 else 0
    return shard, num_frames, sample.offset, sample.size, arrays


def _presence(arrays: Mapping[str, NDArray[Any]]) -> dict[str, float]:
    slices = sample_members.member(sample_members.TRAJ).slices
    traj = arrays[sample_members.TRAJ]
    return {
        f"presence_{side}": float((traj[:, slices[f"{side}_presence"]] != 0).mean())
        for side in SIDES
    }


# ----------------------------------------------------------- episodes.parquet


def episodes_schema() -> "pa.Schema":
    """Return the columns of ``episodes.parquet``, derived from META_FIELDS."""
    import pyarrow as pa

    segment = pa.struct(
        [(n, pa.string()) for n in ("id", "text", "side")] + [(n, pa.int32()) for n in _FRAMES]
    )
    special = {"text": pa.list_(segment), "image_size_hw": pa.list_(pa.int32(), 2)}
    kinds = {"integer": pa.int64(), "number": pa.float64()}
    columns = [(f.name, special.get(f.name, kinds.get(f.kind, pa.string()))) for f in _FIELDS]
    columns += [(f"presence_{side}", pa.float32()) for side in SIDES]
    columns += [(name, pa.type_for_alias(kind)) for name, kind in _PLACE.items()]
    return pa.schema(columns)


def episodes_table(records: Sequence[Mapping[str, Any]]) -> "pa.Table":
    """Return records of all columns as a table."""
    import pyarrow as pa

    schema = episodes_schema()
    columns = [pa.array([r[f.name] for r in records], f.type) for f in schema]
    return pa.Table.from_arrays(columns, schema=schema)


def read_episodes(
    split_folder: str | os.PathLike[str], columns: Sequence[str] | None = None
) -> "pa.Table":
    """Return ``episodes.parquet`` of a split, all columns or some.

    Raises:
        CorpusError: no such file, no parquet file, or a column is missing or of another type.

    """
    import pyarrow as pa
    from pyarrow import parquet

    path = Path(split_folder) / EPISODES
    try:
        have = parquet.read_schema(path)
        for field in episodes_schema():
            if field.name not in have.names:
                raise CorpusError(f"{path}: expected column {field.name}, got {have.names}")
            if have.field(field.name).type != field.type:
                got = have.field(field.name).type
                raise CorpusError(f"{path}, {field.name}: expected {field.type}, got {got}")
        return parquet.read_table(path, columns=None if columns is None else list(columns))
    except FileNotFoundError:
        raise CorpusError(f"{path}: expected this file, got none") from None
    except (pa.ArrowException, OSError) as error:
        raise CorpusError(f"{path}: expected a whole parquet file, got: {error}") from error


def _columns(meta: Mapping[str, Any]) -> dict[str, Any]:
    """Values of the META_FIELDS columns; what may be any JSON is JSON text."""
    promoted = {"fps", *PER_FRAME_META, *(f.name for f in META_FIELDS if f.from_meta)}
    rest = {k: v for k, v in meta["meta"].items() if k not in promoted}
    values = {**meta, "meta": rest}
    return {f.name: _json(values[f.name]) if _is_json(f) else values[f.name] for f in _FIELDS}


def _is_json(field: MetaField) -> bool:
    return field.kind in ("any", "object")


def _json(value: object) -> str | None:
    return None if value is None else json.dumps(value, sort_keys=True, ensure_ascii=False)


_FRAMES: Final = ("start", "end")
_FIELDS: Final = tuple(f for f in META_FIELDS if f.name != "shape")


# ------------------------------------------------------------------ index.npy


def write_rows(path: Path, rows: NDArray[np.void]) -> None:
    """Write index rows as a plain npy file."""
    with path.open("wb") as file:
        np.lib.format.write_array(file, rows, (1, 0), allow_pickle=False)


def read_rows(path: Path) -> NDArray[np.void]:
    """Memory-map the rows of an ``index.npy``.

    Raises:
        CorpusError: no such file, or no whole npy file of dtype ROW.

    """
    try:
        rows = np.load(path, mmap_mode="r", allow_pickle=False)
    except FileNotFoundError:
        raise CorpusError(f"{path}: expected this file, got none") from None
    except (ValueError, EOFError, OSError) as error:
        raise CorpusError(f"{path}: expected a whole npy file, got: {error}") from error
    if rows.dtype != ROW or rows.ndim != 1:
        raise CorpusError(f"{path}: expected (N,) rows of {ROW}, got {rows.shape} of {rows.dtype}")
    return rows
