"""From LeRobot v3 roots, local or remote, to Episodes, one at a time.

``from_lerobot`` reads one root: it goes through the data files in order, keeps one batch of rows
and one episode in memory, and holds 60 bytes an episode of index, so that 1,021 hours need neither
a second copy nor more memory than a single file.
"""

import json
import logging
import os
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, Final, Literal, cast

import numpy as np
from numpy.typing import NDArray

from mint_hub.loaders import lerobot_codec, lerobot_files
from mint_hub.loaders.lerobot_columns import (
    EXTRA,
    Column,
    Dialect,
    LeRobotError,
    columns_of,
    dialect_of,
)
from mint_hub.loaders.lerobot_files import Root, RowBatch, Span, open_root
from mint_hub.loaders.lerobot_index import check_spans, episode_index
from mint_hub.loaders.lerobot_meta import SCALE_STATUS, RootMeta
from mint_hub.loaders.lerobot_origin import ORIGIN_COLUMNS
from mint_hub.loaders.participants import group_of
from mint_hub.loaders.schema import Episode, EpisodeError

OURS: Final = "mint_episode"
"""Column of our own exports: JSON of what an Episode says beyond LeRobot's columns."""

_TOLD: Final = ("key", "image_size_hw", "text", "meta", "schema_version")
_BULK: Final = ("stats/", "meta/episodes/")
_LOG: Final = logging.getLogger(__name__)


def from_lerobot(
    root: str | os.PathLike[str],
    source: str | None = None,
    episodes: Iterable[int] | None = None,
    *,
    scale_status: str = SCALE_STATUS,
    image_size_hw: tuple[int, int] | None = None,
    on_error: Literal["raise", "skip"] = "raise",
    storage_options: dict[str, Any] | None = None,
) -> Iterator[Episode]:
    """Read the episodes of a LeRobot v3 root, in the order in which they lie in its files.

    Both dialects (``lerobot_columns``) give the same Episode: hands in the camera frame, fields of
    view (vertical, horizontal), presence from ``hand_kept`` or ``{side}_kept``. Nothing is scaled
    or smoothed; an absent hand is ``hand_state.absent``. Times are those of the episode's video
    file: ``from_timestamp + k / fps``, from 0 where the root has no video. Keys are
    ``<source>-<video uid>-<episode index>``, with ``Root.identity`` for a uid where the root does
    not state it, so that two roots of one source have no key in common.
    ``meta["uid"]`` is the column ``video_uid``, ``uid`` or ``video_id`` of meta/episodes, else the
    root's own video file, else missing: see ``lerobot_origin``, also for what ``attach`` needs.

    Args:
        root: a folder, or an address that fsspec opens (``hf://datasets/org/name/ego4d``).
        source: name of the source; default: what info.json says, else the folder's name.
        episodes: episode indices to read; default all.
        scale_status: what the labels' lengths are, for ``meta["scale_status"]``.
        image_size_hw: (height, width) that the field of view belongs to; default: the size of
            ``observation.images.ego`` in info.json.
        on_error: "skip" leaves out, with a logged warning, an episode whose values are wrong; a
            missing file or column always raises.
        storage_options: what fsspec passes to the file system.

    Raises:
        LeRobotError: a ValueError that names file, column, episode, what was expected and came.

    """
    if on_error not in ("raise", "skip"):
        raise ValueError(f"on_error: expected 'raise' or 'skip', got {on_error!r}")
    opened = open_root(root, storage_options)
    reader = RootReader(opened, source, scale_status, image_size_hw)
    index = episode_index(opened)
    chosen = np.ones(len(index), bool)
    if episodes is not None:
        wanted = np.unique(np.fromiter(episodes, np.int64))
        if absent := np.setdiff1d(wanted, index["episode_index"]).tolist():
            got = f"{len(index)} episodes without {absent[:5]}"
            raise LeRobotError(
                f"{opened.name(lerobot_files.EPISODES)}: expected {absent[:5]}, got {got}"
            )
        chosen = np.isin(index["episode_index"], wanted)
    return reader.read(index, chosen, skip=on_error == "skip")


def lerobot_episodes(
    root: str | os.PathLike[str], storage_options: dict[str, Any] | None = None
) -> list[int]:
    """Return the episode indices of a root in reading order.

    Contiguous slices of it, as ``from_lerobot(root, episodes=part)``, divide the work among
    processes without reading a file twice but at the seams.
    """
    return episode_index(open_root(root, storage_options))["episode_index"].tolist()


def lerobot_roots(
    folder: str | os.PathLike[str],
    storage_options: dict[str, Any] | None = None,
    *,
    depth: int = 2,
) -> list[str]:
    """Return the LeRobot roots at ``folder`` or up to ``depth`` folders below it, sorted."""
    import fsspec

    address = os.fspath(folder).rstrip("/")
    filesystem, path = fsspec.core.url_to_fs(address, **(storage_options or {}))
    return lerobot_files.roots_below(filesystem, str(path), address, depth)


class RootReader:
    """What all episodes of a root share while they are read."""

    def __init__(
        self, root: Root, source: str | None, scale_status: str, size: tuple[int, int] | None
    ) -> None:
        self.root = root
        self.meta = RootMeta(root, source, scale_status, size)
        self.episode_files = root.episode_files()
        self.rows: tuple[int, Any] | None = None

    def read(self, index: NDArray[Any], chosen: NDArray[Any], skip: bool) -> Iterator[Episode]:
        """Yield the chosen episodes, one data file after the other."""
        for part in files_of(index):
            kept = index[part][chosen[part]]
            if len(kept):
                yield from self.read_file(kept, skip)

    def read_file(self, part: NDArray[Any], skip: bool) -> Iterator[Episode]:
        """Yield the episodes of one data file; ``part`` is sorted by first row."""
        path = data_file_of(self.root, part)
        where = self.root.name(path)
        starts = part["dataset_from_index"] - part["base"]
        stops = starts + part["length"]
        with self.root.parquet(path) as file:
            names = file.schema_arrow.names
            try:
                dialect = dialect_of(names)
            except LeRobotError as error:
                raise LeRobotError(f"{where}: {error}") from None
            check_spans(where, part, starts, stops, file.metadata.num_rows)
            columns = [c for c in columns_of(dialect, extra=True) if c.name in names]
            wanted = list(zip(starts.tolist(), stops.tolist(), strict=True))
            for number, span in lerobot_files.spans(file, [c.name for c in columns], wanted):
                entry = part[number]
                place = f"{where}, episode {entry['episode_index']}"
                try:
                    yield self._episode(entry, path, dialect, columns, span)
                except (LeRobotError, EpisodeError) as error:
                    if not skip:
                        raise LeRobotError(f"{place}: {error}") from None
                    _LOG.warning("skipped %s: %s", place, error)

    def _episode(
        self,
        entry: NDArray[Any],
        path: str,
        dialect: Dialect,
        columns: list[Column],
        span: Span,
    ) -> Episode:
        got, arrays = _decoded(dialect, columns, span)
        _check_counters(got, entry)
        row = self._row(entry)
        ours = _ours(row[OURS]) if row.get(OURS) else None
        there = ours["extra"] if ours else [c.name for c in EXTRA]
        optional = {c.name: got.get(c.name) if c.name in there else None for c in EXTRA}
        told = ours or self.meta.described(entry, row, path, dialect, got)
        length, times = int(entry["length"]), optional["timestamp_s"]
        return Episode.from_dict(
            {
                "timestamps_s": told["start_s"] + np.arange(length) / self.root.fps
                if times is None
                else times,
                "presence_score": optional["presence_score"],
                "filled": optional["hand_filled"],
                **arrays,
                **{name: told[name] for name in _TOLD},
            }
        )

    def _row(self, entry: NDArray[Any]) -> dict[str, Any]:
        """Return everything that meta/episodes says of an episode, but its statistics."""
        number = int(entry["file"])
        if self.rows is None or self.rows[0] != number:
            with self.root.parquet(self.episode_files[number]) as file:
                names = [n for n in file.schema_arrow.names if not n.startswith(_BULK)]
                self.rows = number, file.read(columns=names)
        return self.rows[1].slice(int(entry["row"]), 1).to_pylist()[0]

    def groups(self, index: NDArray[Any]) -> Iterator[tuple[str, str | None]]:
        """Yield video uid and participant of each index record, from meta/episodes alone.

        They are those of the episode's ``meta``; the key stands for a uid that it does not have.
        """
        known: tuple[int, list[dict[str, Any]]] | None = None
        for number, place, row_number in index[["episode_index", "file", "row"]].tolist():
            if known is None or known[0] != place:
                with self.root.parquet(self.episode_files[place]) as file:
                    names = [n for n in (*ORIGIN_COLUMNS, OURS) if n in file.schema_arrow.names]
                    rows = file.read(columns=names)
                known = place, rows.to_pylist() if names else [{}] * len(rows)
            row = known[1][row_number]
            if row.get(OURS):
                told = _ours(row[OURS])
                yield group_of(told["meta"], told["key"])
            else:
                yield group_of(self.meta.origin(row), self.meta.key(row, number))


def files_of(index: NDArray[Any]) -> Iterator[slice]:
    """Yield which records of an index are of one data file, for each file in order."""
    places = index[["data/chunk_index", "data/file_index"]]
    seams = (np.flatnonzero(places[1:] != places[:-1]) + 1).tolist()
    ends = zip([0, *seams], [*seams, len(index)], strict=True)
    return (slice(first, last) for first, last in ends if first < last)


def data_file_of(root: Root, part: NDArray[Any]) -> str:
    """Return where the data file of these index records lies, within the root."""
    return root.data_file(int(part[0]["data/chunk_index"]), int(part[0]["data/file_index"]))


def _decoded(
    dialect: Dialect, columns: list[Column], span: Span
) -> tuple[dict[str, NDArray[Any]], dict[str, NDArray[Any]]]:
    """Return columns and decoded arrays of an episode, made for all rows read with it if possible.

    Where any of those rows are wrong, the episode's own are taken by themselves, so that an error
    is that of its own episode and counts its frames.
    """

    def decoded(batch: RowBatch) -> dict[str, NDArray[Any]]:
        read = batch.columns(columns)
        arrays = lerobot_codec.decode(dialect, read)
        for array in arrays.values():
            array.setflags(write=False)
        return {**read, **{f"{_DECODED}{name}": array for name, array in arrays.items()}}

    try:
        both = span.cut("decoded", decoded)
    except LeRobotError:
        got = span.columns(columns)
        return got, lerobot_codec.decode(dialect, got)
    arrays = {n.removeprefix(_DECODED): both.pop(n) for n in list(both) if n.startswith(_DECODED)}
    return both, arrays


_DECODED: Final = "decoded "


def _check_counters(got: Mapping[str, NDArray[Any]], entry: NDArray[Any]) -> None:
    """Refuse rows that are of another episode, or not its frames 0, 1, 2, ..."""
    length, number = int(entry["length"]), int(entry["episode_index"])
    expected = {"episode_index": number, "frame_index": np.arange(length)}
    for name, want in expected.items():
        if (bad := np.flatnonzero(got[name] != want)).size:
            k = int(bad[0])
            right = np.broadcast_to(want, length)[k]
            raise LeRobotError(f"{name}: expected {right}, got {got[name][k]} at frame {k}")


def _ours(text: str) -> dict[str, Any]:
    """Return what our own export says of an episode."""
    try:
        told = json.loads(text)
    except ValueError as error:
        raise LeRobotError(f"{OURS}: expected JSON, got an error: {error}") from None
    names = [*_TOLD, "start_s", "extra"]
    missing = [n for n in names if n not in told] if isinstance(told, dict) else names
    if missing:
        raise LeRobotError(f"{OURS}: expected the entries {names}, got none called {missing}")
    return cast("dict[str, Any]", told)
