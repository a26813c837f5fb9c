"""Statistics of numbers seen once: moments, extremes and quantiles in bounded memory.

``Sketch`` takes rows of C channels in any number of parts and merges with others. Counts, extremes
and histograms do not depend on how rows were divided; mean and variance follow Chan, Golub and
LeVeque (1983) and pool over all rows. Quantiles come from a histogram over the upper 16 bits of
float32: 128 bins an octave, so an estimate is within QUANTILE_RELATIVE_ERROR of a value of that
rank, or QUANTILE_ABSOLUTE_ERROR where that is more, and the memory never grows. Magnitudes from
2**14 on share one bin.
"""

from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

QUANTILES: Final = (0.01, 0.1, 0.5, 0.9, 0.99)
QUANTILE_RELATIVE_ERROR: Final = 2.0**-8
QUANTILE_ABSOLUTE_ERROR: Final = 2.0**-14

_SLOTS: Final = 128
_LOWEST: Final = (127 - 14) * _SLOTS
_TOP: Final = (127 + 14) * _SLOTS - _LOWEST + 1
_BINS: Final = 2 * _TOP + 1


class Sketch:
    """Count, mean, variance, min, max and quantiles of C channels."""

    def __init__(self, channels: int) -> None:
        self.count = 0
        self.mean = np.zeros(channels)
        self.squares = np.zeros(channels)
        self.min = np.full(channels, np.inf)
        self.max = np.full(channels, -np.inf)
        self.histogram = np.zeros((channels, _BINS), np.int64)

    def add(self, rows: ArrayLike) -> None:
        """Take in finite rows (N, C); N may be 0."""
        columns = np.ascontiguousarray(np.asarray(rows, np.float32).T)
        count = columns.shape[1]
        if not count:
            return
        mean, squares = np.empty((2, len(columns)))
        slots = _SLOT_OF[columns.view(np.uint32) >> np.uint32(16)]
        for channel, column in enumerate(columns):  # one at a time, so that it stays in the cache
            exact = column.astype(np.float64)
            mean[channel] = exact.mean()
            squares[channel] = np.square(exact - mean[channel]).sum()
            self.histogram[channel] += np.bincount(slots[channel], minlength=_BINS)
        self._pool(count, mean, squares)
        self.min = np.minimum(self.min, columns.min(axis=1))
        self.max = np.maximum(self.max, columns.max(axis=1))

    def merge(self, other: "Sketch") -> None:
        """Take in what another sketch of as many channels has seen."""
        if other.count:
            self._pool(other.count, other.mean, other.squares)
            self.min = np.minimum(self.min, other.min)
            self.max = np.maximum(self.max, other.max)
            self.histogram += other.histogram

    def quantile(self, q: float) -> NDArray[np.float64]:
        """Return the smallest value with at least ``q`` of the rows at or below: (C,), as above."""
        if not self.count:
            return np.full(len(self.mean), np.nan)
        rank = max(1, int(np.ceil(q * self.count)))
        slot = (np.cumsum(self.histogram, axis=1) < rank).sum(axis=1) - _TOP
        return np.clip(np.sign(slot) * _BIN_CENTRES[np.abs(slot)], self.min, self.max)

    def to_dict(self, channels: slice = slice(None)) -> dict[str, Any]:
        """Return the statistics of some channels, JSON-able; None where no row was seen."""
        if not self.count:
            empty = dict.fromkeys(("mean", "variance", "min", "max"))
            return {"count": 0, **empty, "quantiles": {f"{q:g}": None for q in QUANTILES}}
        return {
            "count": self.count,
            "mean": self.mean[channels].tolist(),
            "variance": (self.squares / self.count)[channels].tolist(),
            "min": self.min[channels].tolist(),
            "max": self.max[channels].tolist(),
            "quantiles": {f"{q:g}": self.quantile(q)[channels].tolist() for q in QUANTILES},
        }

    def _pool(self, count: int, mean: NDArray[np.float64], squares: NDArray[np.float64]) -> None:
        total = self.count + count
        step = mean - self.mean
        self.squares = self.squares + squares + step**2 * (self.count * count / total)
        self.mean = self.mean + step * (count / total)
        self.count = total


def _bin_centres() -> NDArray[np.float64]:
    edges = ((np.arange(_TOP + 1) + _LOWEST).astype(np.uint32) << 16).view(np.float32)
    return np.concatenate([[0.0], (edges[:-1].astype(np.float64) + edges[1:]) / 2, edges[-1:]])


def _slot_of() -> NDArray[np.int16]:
    """Bin of a float32 by its upper 16 bits: sign, then magnitude."""
    upper = np.arange(1 << 16)
    size = np.clip((upper & 0x7FFF) - _LOWEST + 1, 0, _TOP)
    return (_TOP + np.where(upper & 0x8000, -size, size)).astype(np.int16)


_BIN_CENTRES: Final = _bin_centres()
_SLOT_OF: Final = _slot_of()
