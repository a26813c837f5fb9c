"""The files of a LeRobot v3 root, local or remote: which there are, and rows out of them.

Parquet is read by row groups and by columns, so that a remote root needs no copy and memory is
bounded by one row group.
"""

import json
import os
from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mint_hub.loaders.lerobot_columns import Column, LeRobotError

INFO: Final = "meta/info.json"
TASKS: Final = "meta/tasks.parquet"
EPISODES: Final = "meta/episodes"
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

    @contextmanager
    def parquet(self, relative: str) -> Generator[Any]:
        """Open a parquet file of the root, as ``pyarrow.parquet.ParquetFile``.

        Raises:
            LeRobotError: it is missing or no parquet file.

        """
        import pyarrow as pa
        import pyarrow.parquet as pq

        try:
            source = self.filesystem.open(f"{self.folder}/{relative}", "rb")
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


def spans(
    file: Any, columns: Sequence[str], wanted: Sequence[tuple[int, int]]
) -> Iterator[tuple[int, Any]]:
    """Yield (number, table of rows start .. stop - 1) for each wanted (start, stop), in one pass.

    The spans ascend and do not overlap; row groups that none touches are not read.
    """
    import pyarrow as pa

    sizes = [file.metadata.row_group(i).num_rows for i in range(file.num_row_groups)]
    ends = np.cumsum([0, *sizes])
    starts_wanted = np.array([s for s, _ in wanted])
    stops_wanted = np.array([e for _, e in wanted])
    touched = [
        i
        for i in range(len(sizes))
        if ((starts_wanted < ends[i + 1]) & (stops_wanted > ends[i])).any()
    ]
    pieces: list[tuple[int, Any]] = []
    number = 0
    for group in touched:
        row = int(ends[group])
        for batch in file.iter_batches(_BATCH_ROWS, row_groups=[group], columns=list(columns)):
            pieces.append((row, batch))
            row += batch.num_rows
            while number < len(wanted) and wanted[number][1] <= row:
                start, stop = wanted[number]
                yield number, pa.Table.from_batches(list(_cut(pieces, start, stop)))
                number += 1
            floor = wanted[number][0] if number < len(wanted) else row
            pieces = [(at, piece) for at, piece in pieces if at + piece.num_rows > floor]


def _cut(pieces: list[tuple[int, Any]], start: int, stop: int) -> Iterator[Any]:
    for at, piece in pieces:
        first, last = max(start - at, 0), min(stop - at, piece.num_rows)
        if first < last:
            yield piece.slice(first, last - first)


def values(table: Any, column: Column) -> NDArray[Any]:
    """Return a column of numbers as (T,) for width 1, else (T, width), in the declared dtype.

    Fixed-size and plain lists are read alike; floats of any width become the declared one.

    Raises:
        LeRobotError: names the column and what it holds instead.

    """
    import pyarrow as pa

    array = table[column.name].combine_chunks()
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
