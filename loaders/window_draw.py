"""Which windows a reader gives: checks of those that are asked for, and draws among all there are.

Letters: B windows, N episodes.
"""

import operator
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mint_hub.loaders.fields import require_window

Place = tuple[NDArray[np.int64], NDArray[np.int64]]
"""Episodes (B,) and first frames (B,) of windows."""


class WindowDraw:
    """Draws windows alike from all windows of a length in all episodes that count.

    Args:
        num_frames: (N,) of the episodes.

    """

    def __init__(self, num_frames: NDArray[np.int64]) -> None:
        self._num_frames = num_frames
        self._counts = np.ones(len(num_frames), bool)
        self._ends: dict[int, NDArray[np.int64]] = {}

    def leave_out(self, i: int) -> None:
        """Draw no windows of an episode from now on."""
        self._counts[i] = False
        self._ends.clear()

    def draw(self, batch: int, length: int, rng: np.random.Generator) -> Place:
        """Return ``batch`` windows of ``length`` frames.

        Raises:
            ValueError: no episode that counts is as long, or a number below 1.

        """
        numbers: dict[str, Any] = {"batch": batch, "length": length}
        for name, value in numbers.items():
            if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 1:
                raise ValueError(f"{name}: expected a whole number of at least 1, got {value!r}")
        if (ends := self._ends.get(length)) is None:
            counts = np.maximum(self._num_frames - (length - 1), 0)
            counts[~self._counts] = 0
            ends = self._ends[length] = np.cumsum(counts)
        if not len(ends) or not ends[-1]:
            raise ValueError(f"length: expected an episode of {length} frames, got none")
        drawn = rng.integers(0, ends[-1], batch)
        index = np.searchsorted(ends, drawn, side="right")
        return index, drawn - ends[index] + self._num_frames[index] - (length - 1)


def checked_windows(
    indices: ArrayLike, starts: ArrayLike, length: int, num_frames: NDArray[np.int64], key: Any
) -> Place:
    """Return windows that are asked for as (B,) and (B,), once they are seen to be there.

    Args:
        indices: episodes.
        starts: first frames.
        length: frames of each.
        num_frames: (N,) of all episodes.
        key: from the number of an episode to its key, for errors.

    Raises:
        ValueError: numbers that are not whole, or frames that are not all there.

    """
    index, start = np.atleast_1d(np.asarray(indices)), np.atleast_1d(np.asarray(starts))
    for name, array in (("indices", index), ("starts", start)):
        if array.size and array.dtype.kind not in "iu":
            raise ValueError(f"{name}: expected whole numbers, got {array.dtype}")
    if isinstance(length, bool) or not isinstance(length, int | np.integer):  # pyright: ignore[reportUnnecessaryIsInstance]
        raise ValueError(f"length: expected a whole number, got {length!r}")
    if index.shape != start.shape or index.ndim != 1:
        raise ValueError(
            f"starts: expected one for each of indices, got {start.shape} for {index.shape}"
        )
    index, start = index.astype(np.int64), start.astype(np.int64)
    if index.size and (index.min() < 0 or index.max() >= len(num_frames)):
        got = f"{index.min()} .. {index.max()}"
        raise ValueError(f"indices: expected 0 .. {len(num_frames) - 1}, got {got}")
    bad = np.flatnonzero((start < 0) | (length < 1) | (start + length > num_frames[index]))
    if bad.size:
        i = int(index[bad[0]])
        require_window(int(start[bad[0]]), length, int(num_frames[i]), key(i))
    return index, start


def checked_index(i: Any, count: int) -> int:
    """Return the number of one of ``count`` episodes, counted from the end where negative.

    Raises:
        IndexError: there is no such episode.
        TypeError: no whole number.

    """
    try:
        number = operator.index(i)
    except TypeError:
        raise TypeError(f"episode: expected a whole number, got {i!r}") from None
    if not -count <= number < count:
        raise IndexError(f"episode: expected 0 .. {count - 1}, got {number}")
    return number % count
