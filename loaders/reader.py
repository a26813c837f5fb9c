"""Random access to a corpus: episodes, windows and batches of windows from memory-mapped shards.

    reader = CorpusReader("path/of/corpus", "ego4d", text="open the drawer", min_frames=64)
    episode = reader[0]                                    # a checked Episode
    rows = reader.arrays(0)["traj.npy"]                    # (T, 17), no copy
    batch = reader.random_windows(256, 16, rng)            # contiguous (256, 16, C) arrays

Opening reads the index, never a shard. A shard is mapped when something in it is asked for, and the
rows of an episode are where the index says, so a window costs one copy of its bytes. Letters: B
windows, L frames of a window, T frames of an episode, C columns of a member (``members.MEMBERS``).
"""

import os
import zlib
from collections.abc import Iterable, Iterator, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mint_hub.loaders.episode_table import EpisodeTable
from mint_hub.loaders.index import read_rows
from mint_hub.loaders.manifest import EPISODES, INDEX, FileRecord
from mint_hub.loaders.members import decode
from mint_hub.loaders.remote import split_files
from mint_hub.loaders.row_layout import Windows, row_layout
from mint_hub.loaders.schema import Episode
from mint_hub.loaders.selection import Selection
from mint_hub.loaders.shard_maps import ShardMaps
from mint_hub.loaders.tar_layout import CorpusError, key_at, members_at
from mint_hub.loaders.window_draw import WindowDraw, checked_index, checked_windows

if TYPE_CHECKING:
    from mint_hub.loaders.selection import Where
    from mint_hub.loaders.stream import CorpusStream

_NEW, _GOOD, _LOST = 0, 1, 2


class CorpusReader(Sequence[Episode]):
    """The episodes of one split that pass the filters, in the order of the shards.

    Args:
        location: the corpus: a folder, or an address that fsspec opens (``hf://datasets/...``,
            ``https://...``, ``s3://...``), whose files are fetched when needed and kept.
        config: name of the config.
        split: name of the split.
        where: see ``selection.Selection``, as for the next four.
        text: words in the text of a segment.
        source: one source or several.
        min_frames: fewest frames.
        presence: least share of frames with the left and with the right hand.
        verify: how much is compared with what was written. "size", when opening, the sizes of all
            shards in a folder (remote ones by hash as they arrive): finds what is missing or cut.
            Reading then looks at the headers and values of a sample, but a changed bit that leaves
            them valid comes back as another number, unseen. "sample" also compares the crc32 of
            each sample when it is first read, and raises where a bit of it changed. "full"
            compares every byte of all shards by hash when opening, as `mint-hub verify --full`.
        on_error: "raise", or "skip": what cannot be read is left out of iteration, random windows
            and streams, counted in ``num_skipped`` and named in ``problems``.
        cache_dir: where remote files are kept.
        storage_options: what fsspec passes to the file system of an address.

    Raises:
        CorpusError: no such split, or what it needs is missing or damaged; names the file.
        ValueError: an option has another value than these.

    """

    def __init__(
        self,
        location: str | os.PathLike[str],
        config: str,
        split: str = "train",
        *,
        where: "Where | None" = None,
        text: str | None = None,
        source: str | Sequence[str] | None = None,
        min_frames: int | None = None,
        presence: float | tuple[float, float] | None = None,
        verify: Literal["size", "sample", "full"] = "size",
        on_error: Literal["raise", "skip"] = "raise",
        cache_dir: str | os.PathLike[str] | None = None,
        storage_options: dict[str, Any] | None = None,
    ) -> None:
        _check_option("verify", verify, ("size", "sample", "full"))
        _check_option("on_error", on_error, ("raise", "skip"))
        self._files = split_files(
            location, config, split, cache_dir=cache_dir, storage_options=storage_options
        )
        self.manifest = self._files.manifest()
        self.on_error = on_error
        self._by_sample = verify == "sample"
        self.problems: list[str] = []
        self.num_skipped = 0
        self._records = {record.name: record for record in self.manifest.files}
        self._maps = ShardMaps(self._files, self.manifest)
        rows = read_rows(self._file(INDEX))
        if len(rows) != self.manifest.num_episodes:
            wanted = f"{self.manifest.num_episodes} rows of {INDEX}"
            raise CorpusError(f"{self._files.address}: expected {wanted}, got {len(rows)}")
        lost = self._verify(full=verify == "full")
        self._select(rows, Selection(where, text, source, min_frames, presence), lost)
        self._state = np.zeros(len(self.num_frames), np.uint8)
        self._draws = WindowDraw(self.num_frames)
        check = partial(self._files.check, self._records[EPISODES], full=True)
        samples = [shard.samples for shard in self.manifest.shards]
        self._table = EpisodeTable(partial(self._file, EPISODES), check, samples)

    # ------------------------------------------------------------- episodes

    def __len__(self) -> int:
        return len(self.num_frames)

    def __repr__(self) -> str:
        return (
            f"CorpusReader({self._files.address!r}, {len(self)} of {self.manifest.num_episodes} "
            f"episodes, {int(self.num_frames.sum())} frames)"
        )

    def __getitem__(self, i: Any) -> Any:
        """Return an Episode, or the list of those of a slice.

        Raises:
            IndexError: there is no such episode.
            CorpusError, EpisodeError: it cannot be read (ValueErrors); names shard and episode.

        """
        if isinstance(i, slice):
            return [self[k] for k in range(*i.indices(len(self)))]
        return decode(self._members(i), self._maps.name(int(self._shard[i])))

    def __iter__(self) -> Iterator[Episode]:
        """Yield the episodes; with ``on_error="skip"`` those that can be read."""
        return self.read(range(len(self)))

    def read(self, indices: Iterable[int]) -> Iterator[Episode]:
        """Yield these episodes; with ``on_error="skip"`` those that can be read."""
        for i in indices:
            if self._state[i] == _LOST:
                continue
            try:
                episode = self[i]
            except ValueError as error:
                self._lose(i, error)
                continue
            yield episode

    def key(self, i: int) -> str:
        """Return the key of an episode from the table, without opening its shard."""
        return self._table.key(int(self._row[i]))

    def arrays(self, i: int) -> dict[str, NDArray[Any]]:
        """Return an episode's members as (T, C) read-only views of the shard, by name; no copy.

        Raises:
            IndexError: there is no such episode.
            CorpusError: it cannot be read; names shard and episode.

        """
        i = checked_index(i, len(self))
        if self._state[i] != _GOOD:
            self._touch(i)
        num_frames = int(self.num_frames[i])
        view = self._maps.view(int(self._shard[i]))
        return {
            rows.name: np.frombuffer(view, rows.dtype, num_frames * rows.width, rows.at[i]).reshape(
                num_frames, rows.width
            )
            for rows in self._layout
        }

    def member(self, i: int, name: str) -> memoryview:
        """Return the bytes of any member of an episode, such as "json" or "mp4"; no copy.

        Raises:
            IndexError: there is no such episode.
            CorpusError: it cannot be read, or has no such member; names shard and episode.

        """
        members = self._members(i)
        if name not in members:
            place = f"{self._maps.name(int(self._shard[i]))}, episode {self.key(i)}"
            raise CorpusError(f"{place}: expected member {name}, got {sorted(members)}")
        return members[name]

    def iter_arrays(self) -> Iterator[tuple[int, dict[str, NDArray[Any]]]]:
        """Yield (i, ``arrays(i)``) for every episode; with "skip", for those that can be read."""
        for i in range(len(self)):
            if self._usable(i):
                yield i, self.arrays(i)

    # -------------------------------------------------------------- windows

    def window(self, i: int, start: int, length: int) -> dict[str, NDArray[Any]]:
        """Return frames start .. start + length - 1 of ``arrays(i)``, still views.

        Raises:
            ValueError: the frames are not all there, numbers that are not whole, or length < 1.

        """
        i = checked_index(i, len(self))
        checked_windows([i], [start], length, self.num_frames, self.key)
        return {name: rows[start : start + length] for name, rows in self.arrays(i).items()}

    def windows(
        self, indices: ArrayLike, starts: ArrayLike, length: int, *, as_torch: bool = False
    ) -> Windows:
        """Return these windows, in this order, copied side by side.

        Args:
            indices: (B,) episodes of the reader.
            starts: (B,) first frames.
            length: L.
            as_torch: tensors instead of arrays.

        Raises:
            ValueError: the frames are not all there, numbers that are not whole, or length < 1.
            CorpusError: an episode cannot be read; names shard and episode.

        """
        index, start = checked_windows(indices, starts, length, self.num_frames, self.key)
        for i in np.unique(index[self._state[index] != _GOOD]).tolist():
            self._touch(i)
        batch = self._gather(index, start, length)
        return batch.torch() if as_torch else batch

    def random_windows(
        self,
        batch: int,
        length: int,
        rng: np.random.Generator | int | None = None,
        *,
        as_torch: bool = False,
    ) -> Windows:
        """Return ``batch`` windows drawn alike from all windows of that length in all episodes.

        With ``on_error="skip"``, windows of episodes that cannot be read are drawn again.

        Args:
            batch: B.
            length: L.
            rng: a numpy generator, or its seed; the same state gives the same windows.
            as_torch: tensors instead of arrays.

        Raises:
            ValueError: no episode is as long as that, or every one that is cannot be read.

        """
        rng = np.random.default_rng(rng)
        index, start = self._draws.draw(batch, length, rng)
        while (bad := np.flatnonzero(~self._usable_mask(index))).size:
            index[bad], start[bad] = self._draws.draw(len(bad), length, rng)
        result = self._gather(index, start, length)
        return result.torch() if as_torch else result

    def stream(self, batch: int, length: int | None = None, **options: Any) -> "CorpusStream":
        """Return a torch IterableDataset of batches in elastic order; see ``CorpusStream``."""
        from mint_hub.loaders.stream import CorpusStream

        reader: Any = self
        return CorpusStream(reader, batch, length, **options)

    def usable(self, indices: ArrayLike) -> NDArray[np.bool_]:
        """Return which episodes can be read, (B,); with ``on_error="raise"`` raise at the first.

        Raises:
            CorpusError: an episode cannot be read; names shard and episode.

        """
        return self._usable_mask(np.asarray(indices, np.int64))

    # -------------------------------------------------------------- opening

    def _file(self, name: str) -> Any:
        if name not in self._records:
            raise CorpusError(f"{self._files.address}: expected {name} in its shards.json")
        record: FileRecord = self._records[name]
        self._files.check(record, full=name == INDEX)
        return self._files.path(record)

    def _verify(self, full: bool) -> list[int]:
        """Return the shards that fail; with ``on_error="raise"`` the first one raises."""
        failed: list[int] = []
        for number, shard in enumerate(self.manifest.shards):
            try:
                self._files.check(shard, full)
            except CorpusError as error:
                if self.on_error == "raise":
                    raise
                failed.append(number)
                self.problems.append(str(error))
        if full or self._by_sample:
            self._files.check(self._records[EPISODES], full=True)
        return failed

    def _select(self, rows: NDArray[np.void], selection: Selection, lost: list[int]) -> None:
        """Keep what reading needs of the chosen rows, as plain arrays."""
        chosen = selection.rows(self._file(EPISODES)) if selection else np.arange(len(rows))
        if len(chosen) and chosen[-1] >= len(rows):
            raise CorpusError(f"{self._files.address}: {EPISODES} has more rows than {INDEX}")
        if lost:
            bad = np.isin(rows["shard"][chosen], lost)
            self.num_skipped += int(bad.sum())
            chosen = chosen[~bad]
        self._row, mine = chosen.astype(np.uint32), rows[chosen]
        self._shard = mine["shard"].astype(np.uint32)
        self._offset = mine["offset"].astype(np.int64)
        self._size = mine["size"].astype(np.uint32)
        self.num_frames = mine["num_frames"].astype(np.int64)
        self._layout = row_layout(mine, self.manifest)

    # -------------------------------------------------------------- reading

    def _members(self, i: int) -> dict[str, memoryview]:
        i = checked_index(i, len(self))
        if self._state[i] != _GOOD:
            self._touch(i)
        shard, offset = int(self._shard[i]), int(self._offset[i])
        view, name = self._maps.view(shard), self._maps.name(shard)
        found = members_at(view, offset, int(self._size[i]), name)
        return {m.name: view[m.offset : m.offset + m.size] for m in found}

    def _touch(self, i: int) -> None:
        """See, once an episode, that its rows are where the index says; CorpusError if not."""
        shard = int(self._shard[i])
        if self._maps.is_new(shard):
            view, place = self._maps.view(shard), self._maps.name(shard)
            expected, got = self._table.first_key(shard), key_at(view, 0, place)
            if got != expected:
                self._maps.drop(shard)
                raise CorpusError(
                    f"{place}: expected episode {expected} first, got {got}: is it another shard?"
                )
        view, num_frames = self._maps.view(shard), int(self.num_frames[i])
        for rows in self._layout:
            if not rows.is_there(view, i, num_frames):
                raise CorpusError(
                    f"{rows.name}: expected ({num_frames}, {rows.width}) {rows.dtype.name} at byte "
                    f"{rows.at[i]}, got other bytes in {self._maps.name(shard)}, "
                    f"episode {self.key(i)}"
                )
        if self._by_sample:
            start = int(self._offset[i])
            got = zlib.crc32(view[start : start + int(self._size[i])])
            if got != (expected := self._table.crc32(int(self._row[i]))):
                raise CorpusError(
                    f"{self._maps.name(shard)}, episode {self.key(i)}: expected bytes of crc32 "
                    f"{expected:08x}, got {got:08x}: the file has changed since it was written"
                )
        self._state[i] = _GOOD

    def _usable(self, i: int) -> bool:
        if self._state[i] == _NEW:
            try:
                self._touch(i)
            except CorpusError as error:
                self._lose(i, error)
        return bool(self._state[i] == _GOOD)

    def _usable_mask(self, index: NDArray[np.int64]) -> NDArray[np.bool_]:
        state = self._state[index]
        if not (state == _GOOD).all():
            for i in np.unique(index[state == _NEW]).tolist():
                self._usable(i)
            state = self._state[index]
        return state == _GOOD

    def _lose(self, i: int, error: ValueError) -> None:
        """Count an episode that cannot be read, or raise."""
        if self.on_error == "raise":
            raise error
        self._state[i] = _LOST
        self._draws.leave_out(i)
        self.num_skipped += 1
        self.problems.append(str(error))

    def _gather(self, index: NDArray[np.int64], start: NDArray[np.int64], length: int) -> Windows:
        views = self._maps.views(self._shard[index])
        arrays = {rows.name: rows.gather(views, index, start, length) for rows in self._layout}
        return Windows(index, start, arrays)


def _check_option(name: str, value: str, known: tuple[str, ...]) -> None:
    if value not in known:
        raise ValueError(f"{name}: expected one of {known}, got {value!r}")
