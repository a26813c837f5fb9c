"""The files of a LeRobot v3 root, local or remote: which there are, and rows out of them.

Parquet is read by row groups and by columns, so that a remote root needs no copy and memory is
bounded by one row group.
"""

import hashlib
import json
import os
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mint_hub.loaders.lerobot_columns import Column, LeRobotError

INFO: Final = "meta/info.json"
TASKS: Final = "meta/tasks.parquet"
EPISODES: Final = "meta/episodes"
DATA: Final = "data"
DATA_PATH: Final = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO_PATH: Final = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"

_BATCH_ROWS: Final = 4096
_TASK_TEXT: Final = ("task", "__index_level_0__")


@dataclass(frozen=True)
class Root:
    """A LeRobot v3 root: where it lies and what its info.json says."""

    address: str
    filesystem: Any
    folder: str
    info: dict[str, Any]

    @property
    def fps(self) -> float:
        """Frames a second of labels and video."""
        return float(self.info["fps"])

    def name(self, relative: str) -> str:
        """Return a file's address, for messages."""
        return f"{self.address.rstrip('/')}/{relative}"

    @cached_property
    def identity(self) -> str:
        """Eight hexadecimal digits that tell this root from others, wherever it lies.

        They follow from info.json, from the sizes of the files of meta/episodes, and from the
        footers of the first of these and of the first data file, which sum their columns up: not
        from what a user may leave out or add, later data files and videos.

        Raises:
            LeRobotError: one of these files is no parquet file.

        """
        digest = hashlib.sha256(json.dumps(self.info, sort_keys=True).encode())
        for folder in (EPISODES, DATA):
            found: dict[str, Any] = self.filesystem.find(f"{self.folder}/{folder}", detail=True)
            sizes = {
                name[name.index(f"/{folder}/") + 1 :]: int(entry["size"])
                for name, entry in found.items()
                if name.endswith(".parquet")
            }
            if folder == EPISODES:
                digest.update(json.dumps(sizes, sort_keys=True).encode())
            if sizes:
                digest.update(self._footer(*min(sizes.items())))
        return digest.hexdigest()[:8]

    def _footer(self, relative: str, size: int) -> bytes:
        """Return the end of a parquet file, from where its metadata begins."""
        place = f"{self.folder}/{relative}"
        end: bytes = self.filesystem.cat_file(place, start=max(size - 8, 0), end=size)
        length = int.from_bytes(end[:4], "little")
        if end[4:] != b"PAR1" or length + 8 > size:
            raise LeRobotError(f"{self.name(relative)}: expected a parquet file, got a damaged one")
        footer: bytes = self.filesystem.cat_file(place, start=size - 8 - length, end=size)
        return footer

    @contextmanager
    def parquet(self, relative: str) -> Generator[Any]:
        """Open a parquet file of the root, as ``pyarrow.parquet.ParquetFile``.

        Raises:
            LeRobotError: it is missing or no parquet file.

        """
        import pyarrow as pa
        import pyarrow.parquet as pq

        place = f"{self.folder}/{relative}"
        local = "file" in np.atleast_1d(self.filesystem.protocol)
        try:
            source = pa.memory_map(place) if local else self.filesystem.open(place, "rb")
        except FileNotFoundError:
            raise LeRobotError(f"{self.name(relative)}: expected this file, got none") from None
        with source:
            try:
                file = pq.ParquetFile(source, pre_buffer=True)
            except (pa.ArrowInvalid, OSError) as error:
                raise LeRobotError(
                    f"{self.name(relative)}: expected a parquet file, got a damaged one: {error}"
                ) from None
            yield file

    def episode_files(self) -> list[str]:
        """Return the parquet files that describe episodes, in order."""
        try:
            found = self.filesystem.find(f"{self.folder}/{EPISODES}")
        except FileNotFoundError:
            found = []
        names = sorted(str(f) for f in found if str(f).endswith(".parquet"))
        if not names:
            raise LeRobotError(f"{self.name(EPISODES)}: expected parquet files, got none")
        return [name[name.index(f"/{EPISODES}/") + 1 :] for name in names]

    def data_file(self, chunk_index: int, file_index: int) -> str:
        """Return where frames of this chunk and file number lie, within the root."""
        template = self.info.get("data_path", DATA_PATH)
        try:
            path = str(template).format(chunk_index=chunk_index, file_index=file_index)
        except (KeyError, IndexError, ValueError, AttributeError):
            path = ""
        if not path or path.startswith("/") or ".." in path.split("/"):
            raise LeRobotError(
                f"{self.name(INFO)}: data_path: expected a path with chunk_index and file_index, "
                f"got {template!r}"
            )
        return path


def open_root(root: str | os.PathLike[str], storage_options: dict[str, Any] | None = None) -> Root:
    """Open a LeRobot v3 root: a folder, or an address that fsspec opens (``hf://datasets/...``).

    Raises:
        LeRobotError: there is no info.json, or it is of another version or lacks ``fps``.

    """
    import fsspec

    address = os.fspath(root)
    filesystem, folder = fsspec.core.url_to_fs(address, **(storage_options or {}))
    where = f"{address.rstrip('/')}/{INFO}"
    try:
        text = filesystem.cat_file(f"{str(folder).rstrip('/')}/{INFO}")
    except FileNotFoundError:
        raise LeRobotError(
            f"{where}: expected this file, got none: is {address} a LeRobot v3 root?"
        ) from None
    try:
        info = json.loads(text)
    except ValueError as error:
        raise LeRobotError(f"{where}: expected JSON, got an error: {error}") from None
    version = info.get("codebase_version") if isinstance(info, dict) else None
    if not str(version).startswith("v3."):
        raise LeRobotError(f"{where}: codebase_version: expected v3.x, got {version!r}")
    fps = info.get("fps")
    if isinstance(fps, bool) or not isinstance(fps, int | float) or not fps > 0:
        raise LeRobotError(f"{where}: fps: expected a positive number, got {fps!r}")
    return Root(address, filesystem, str(folder).rstrip("/"), info)


def roots_below(filesystem: Any, path: str, address: str, depth: int) -> list[str]:
    """Return the addresses of the LeRobot roots at a path or up to ``depth`` folders below it.

    ``address`` is what the path is called; sorted. Depth 0 looks for one file and lists nothing.
    """
    path, address = path.rstrip("/"), address.rstrip("/")
    if depth == 0:
        return [address] if filesystem.exists(f"{path}/{INFO}") else []
    found = {
        str(name)[len(path) : -len(INFO)].strip("/")
        for folders in range(depth + 1)
        for name in filesystem.glob(f"{path}/{'*/' * folders}{INFO}")
    }
    return [f"{address}/{name}" if name else address for name in sorted(found)]


def read_tasks(root: Root) -> dict[int, str]:
    """Return the texts of meta/tasks.parquet by number; nothing where the file is absent."""
    if not root.filesystem.exists(f"{root.folder}/{TASKS}"):
        return {}
    with root.parquet(TASKS) as file:
        table = file.read()
    text = next((name for name in _TASK_TEXT if name in table.column_names), None)
    if text is None or "task_index" not in table.column_names:
        raise LeRobotError(
            f"{root.name(TASKS)}: expected the columns task_index and one of {list(_TASK_TEXT)}, "
            f"got {table.column_names}"
        )
    return dict(zip(table["task_index"].to_pylist(), table[text].to_pylist(), strict=True))


class RowBatch:
    """Rows of a parquet file that were read together; row 0 of them is row ``first`` there."""

    def __init__(self, first: int, batch: Any) -> None:
        self.first, self.batch = first, batch
        self.stop = first + batch.num_rows
        self.memo: dict[str, Any] = {}

    def columns(self, columns: Sequence[Column]) -> dict[str, NDArray[Any]]:
        """Return all rows of some columns, as ``values`` does."""
        return {c.name: values(self.batch, c) for c in columns}


class Span:
    """The rows of one episode, in one batch or in several that follow each other."""

    def __init__(self, batches: Sequence[RowBatch], start: int, stop: int) -> None:
        pairs = [(b, max(start - b.first, 0), min(stop, b.stop) - b.first) for b in batches]
        self.parts = [(b, slice(first, last)) for b, first, last in pairs if first < last]

    def columns(self, columns: Sequence[Column]) -> dict[str, NDArray[Any]]:
        """Return the episode's rows of some columns, as ``values`` does."""
        import pyarrow as pa

        pieces = [b.batch.slice(rows.start, rows.stop - rows.start) for b, rows in self.parts]
        table = pa.Table.from_batches(pieces)
        return {c.name: values(table, c) for c in columns}

    def cut(self, memo: str, compute: Callable[[RowBatch], Mapping[str, Any]]) -> dict[str, Any]:
        """Return the episode's rows of arrays that are computed once a batch, read-only."""
        for batch, _ in self.parts:
            if memo not in batch.memo:
                batch.memo[memo] = compute(batch)
        pieces = [(batch.memo[memo], rows) for batch, rows in self.parts]
        if len(pieces) == 1:
            return {name: array[pieces[0][1]] for name, array in pieces[0][0].items()}
        joined = {n: np.concatenate([p[n][rows] for p, rows in pieces]) for n in pieces[0][0]}
        for array in joined.values():
            array.setflags(write=False)
        return joined


def spans(
    file: Any, columns: Sequence[str], wanted: Sequence[tuple[int, int]]
) -> Iterator[tuple[int, Span]]:
    """Yield (number, rows start .. stop - 1) for each wanted (start, stop), in one pass.

    The spans ascend and do not overlap; row groups that none touches are not read.
    """
    ends = row_group_ends(file)
    first_of = np.array([start for start, _ in wanted])
    last_of = np.array([stop for _, stop in wanted])
    batches: list[RowBatch] = []
    number = 0
    for group in range(len(ends) - 1):
        if not ((first_of < ends[group + 1]) & (last_of > ends[group])).any():
            continue
        row = int(ends[group])
        for batch in file.iter_batches(_BATCH_ROWS, row_groups=[group], columns=list(columns)):
            batches.append(RowBatch(row, batch))
            row += batch.num_rows
            while number < len(wanted) and wanted[number][1] <= row:
                yield number, Span(batches, *wanted[number])
                number += 1
            floor = wanted[number][0] if number < len(wanted) else row
            batches = [b for b in batches if b.stop > floor]


def row_group_ends(file: Any) -> NDArray[np.int64]:
    """Return 0 and the row after each row group of a parquet file, (groups + 1,)."""
    sizes = [file.metadata.row_group(i).num_rows for i in range(file.num_row_groups)]
    return np.cumsum([0, *sizes])


def values(table: Any, column: Column) -> NDArray[Any]:
    """Return a column of numbers as (T,) for width 1, else (T, width), in the declared dtype.

    Fixed-size and plain lists are read alike; floats of any width become the declared one.

    Raises:
        LeRobotError: names the column and what it holds instead.

    """
    import pyarrow as pa

    array = table[column.name]
    if isinstance(array, pa.ChunkedArray):
        array = array.combine_chunks()
    kind = array.type
    is_list = pa.types.is_list(kind) or pa.types.is_large_list(kind)
    rows, width = len(array), column.width
    if pa.types.is_fixed_size_list(kind) or is_list:
        nulls = array.null_count
        lengths = set(array.value_lengths().unique().to_pylist()) if is_list else {kind.list_size}
        array = array.flatten()
        if nulls or lengths - {width}:
            got = f"{nulls} missing" if nulls else f"lists of {sorted(lengths)}"
            raise LeRobotError(f"{column.name}: expected {width} numbers a frame, got {got}")
    elif width != 1:
        raise LeRobotError(f"{column.name}: expected {width} numbers a frame, got {kind}")
    if array.null_count:
        raise LeRobotError(f"{column.name}: expected a value in every frame, got missing ones")
    numbers = array.to_numpy(zero_copy_only=False)
    if numbers.dtype.kind != np.dtype(column.dtype).kind:
        raise LeRobotError(f"{column.name}: expected {column.dtype}, got {array.type}")
    numbers = numbers.astype(column.dtype, copy=False)
    return numbers if width == 1 else numbers.reshape(rows, width)
