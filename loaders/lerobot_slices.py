"""LeRobot v3 roots in slices, so that the processes that write a corpus read them as well.

A slice is a run of episodes of one data file that begin in neighbouring row groups, so that no row
group is decoded twice but at a seam. What to keep is decided by meta/episodes alone: the frames of
an episode that is left out are not decoded for it.
"""

import os
from collections.abc import Callable, Iterable, Iterator
from typing import Any, Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mint_hub.loaders import lerobot_files
from mint_hub.loaders.derived import SPLITS
from mint_hub.loaders.lerobot_columns import LeRobotError
from mint_hub.loaders.lerobot_files import open_root
from mint_hub.loaders.lerobot_index import episode_index
from mint_hub.loaders.lerobot_read import SCALE_STATUS, RootReader, data_file_of, files_of
from mint_hub.loaders.schema import Episode
from mint_hub.loaders.shards import split_of

SLICE_FRAMES: Final = 16_384
"""A slice ends with the row group in which it reaches this many frames."""


class LeRobotSlice(NamedTuple):
    """Episodes of one data file: the number of the root, and their records of its index."""

    root: int
    episodes: NDArray[Any]


class LeRobotSlices:
    """The episodes of LeRobot v3 roots, one root after the other, for ``write_corpus``.

    They are those of ``from_lerobot`` for each root, in its order, and give the same shards; the
    difference is that every process reads what it encodes. Iterates slices; meta/episodes is read
    while it goes.

    Args:
        roots: folders, or addresses that fsspec opens.
        keep: whether to keep an episode, given the uid of its video (its key, where there is none)
            and its participant (None where unknown), as ``shards.split_of`` takes them.
        scale_status: see ``from_lerobot``.
        image_size_hw: see ``from_lerobot``.
        on_error: see ``from_lerobot``.
        storage_options: see ``from_lerobot``.

    Raises:
        LeRobotError: while it is iterated or read, as ``from_lerobot`` says; or two of the roots
            are the same.

    """

    def __init__(
        self,
        roots: Iterable[str | os.PathLike[str]],
        keep: Callable[[str, str | None], bool] | None = None,
        *,
        scale_status: str = SCALE_STATUS,
        image_size_hw: tuple[int, int] | None = None,
        on_error: Literal["raise", "skip"] = "raise",
        storage_options: dict[str, Any] | None = None,
    ) -> None:
        if on_error not in ("raise", "skip"):
            raise ValueError(f"on_error: expected 'raise' or 'skip', got {on_error!r}")
        self._roots = [os.fspath(root) for root in roots]
        self._keep = keep
        self._options = (scale_status, image_size_hw)
        self._skip = on_error == "skip"
        self._storage_options = storage_options
        self._reader: tuple[int, RootReader] | None = None

    def __getstate__(self) -> dict[str, Any]:
        # What is kept is decided where the slices are made, and files are opened where they are
        # read: neither travels.
        return {**self.__dict__, "_keep": None, "_reader": None}

    def __iter__(self) -> Iterator[LeRobotSlice]:
        seen: dict[str, str] = {}
        for number, address in enumerate(self._roots):
            reader = self._opened(number)
            if (other := seen.setdefault(reader.root.identity, address)) is not address:
                raise LeRobotError(
                    f"roots: expected each once, got {other} and {address}, which are the same "
                    "root or copies of it: leave one out"
                )
            index = episode_index(reader.root)
            if self._keep is not None:
                groups = reader.groups(index)
                kept = np.fromiter((self._keep(*group) for group in groups), bool, len(index))
                index = index[kept]
            for part in files_of(index):
                for episodes in _by_row_groups(reader, index[part]):
                    yield LeRobotSlice(number, episodes)

    def read_slice(self, part: LeRobotSlice, /) -> Iterator[Episode]:
        """Yield the episodes of one slice.

        Raises:
            LeRobotError: as ``from_lerobot`` says.

        """
        return self._opened(part.root).read_file(part.episodes, self._skip)

    def _opened(self, number: int) -> RootReader:
        if self._reader is None or self._reader[0] != number:
            root = open_root(self._roots[number], self._storage_options)
            self._reader = number, RootReader(root, None, *self._options)
        return self._reader[1]


def splits_of(
    root: str | os.PathLike[str], storage_options: dict[str, Any] | None = None
) -> list[str]:
    """Return the splits that episodes of a root fall into by ``split_of``, in their usual order.

    Reads meta/episodes, up to where every split is seen.

    Raises:
        LeRobotError: as ``from_lerobot`` says.

    """
    opened = open_root(root, storage_options)
    reader, left = RootReader(opened, None, SCALE_STATUS, None), list(SPLITS)
    for group in reader.groups(episode_index(opened)):
        if (split := split_of(*group)) in left:
            left.remove(split)
        if not left:
            break
    return [split for split in SPLITS if split not in left]


def _by_row_groups(reader: RootReader, episodes: NDArray[Any]) -> Iterator[NDArray[Any]]:
    """Yield the episodes of one data file, sorted by first row, in slices."""
    with reader.root.parquet(data_file_of(reader.root, episodes)) as file:
        ends = lerobot_files.row_group_ends(file)
    starts = episodes["dataset_from_index"] - episodes["base"]
    group = np.searchsorted(ends, starts, side="right")
    first = frames = 0
    for i, length in enumerate(episodes["length"].tolist()):
        if frames >= SLICE_FRAMES and group[i] != group[i - 1]:
            yield episodes[first:i]
            first, frames = i, 0
        frames += length
    yield episodes[first:]
