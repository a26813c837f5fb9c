"""How sure a number is: the bootstrap over recordings.

Windows of one recording are alike, so whole recordings are drawn, with all their clips: treated as
independent, a hundred windows of one video would seem to settle anything. A draw is a weight for
each clip, how often it came up. Draws are made a block at a time, so that memory does not grow with
their number.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

RESAMPLES: Final = 1000
SEED: Final = 0
BLOCK_VALUES: Final = 200_000
"""How many weights are held at once."""

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Resamples:
    """RESAMPLES draws of recordings, with replacement; the same for the same grouping.

    Attributes:
        recording: (N,) number of the recording of each of N clips.
        count: how many recordings; fewer than two are not drawn from.

    """

    recording: NDArray[np.intp]
    count: int

    @classmethod
    def of(cls, recordings: Sequence[str]) -> "Resamples":
        """Group clips by the name of their recording, in the order of first appearance."""
        numbers = {name: i for i, name in enumerate(dict.fromkeys(recordings))}
        return cls(np.array([numbers[name] for name in recordings], np.intp), len(numbers))

    def blocks(self) -> Iterator[Floats]:
        """Yield weights (B, N) until there are RESAMPLES rows; nothing of a single recording."""
        if self.count < 2:
            return
        rng, size = np.random.default_rng(SEED), max(1, BLOCK_VALUES // len(self.recording))
        for start in range(0, RESAMPLES, size):
            rows = min(size, RESAMPLES - start)
            drawn = rng.integers(0, self.count, (rows, self.count))
            at = drawn + self.count * np.arange(rows)[:, None]
            often = np.bincount(at.ravel(), minlength=rows * self.count).reshape(rows, -1)
            yield often[:, self.recording].astype(np.float64)

    def groups(self) -> list[NDArray[np.intp]]:
        """Return the numbers of the clips of each recording."""
        return [np.flatnonzero(self.recording == i) for i in range(self.count)]

    def has_several(self, known: NDArray[np.bool_]) -> bool:
        """Whether at least two recordings have a clip with the number; ``known`` is (N,)."""
        return len(np.unique(self.recording[known])) > 1


def drawn_metrics(parts: Sequence[Any], kind: Any, draws: Resamples) -> list[dict[str, float]]:
    """Return the metrics of the sum of statistics, for each draw."""
    names = list(kind().to_dict())
    table = np.array([[part.to_dict()[name] for name in names] for part in parts], float)
    return [
        kind(**dict(zip(names, row, strict=True))).metrics()
        for weights in draws.blocks()
        for row in (weights @ table).tolist()
    ]


def drawn_means(table: Floats, draws: Resamples) -> Floats:
    """Return the means of the known values of columns (N, ...), for each draw (D, ...).

    NaN where a draw has none. All columns of one call cost one pass over the draws.
    """
    known = np.isfinite(table)
    values = np.where(known, table, 0.0)
    found = [_ratio(weights @ values, weights @ known) for weights in draws.blocks()]
    return np.concatenate([*found, np.zeros((0, *table.shape[1:]))])


def drawn_medians(table: Floats, draws: Resamples) -> Floats:
    """Return the medians of the known values of columns (N, M), for each draw (D, M); see above."""
    orders = [np.argsort(column)[: int(np.isfinite(column).sum())] for column in table.T]
    found = [
        np.stack([_medians(weights, table[:, k], order) for k, order in enumerate(orders)], axis=1)
        for weights in draws.blocks()
    ]
    return np.concatenate([*found, np.zeros((0, *table.shape[1:]))])


def _medians(weights: Floats, column: Floats, order: NDArray[np.intp]) -> Floats:
    """Medians under weights (B, N); ``order`` sorts the known values of the column (N,)."""
    if not len(order):
        return np.full(len(weights), np.nan)
    below = np.cumsum(weights[:, order], axis=1)
    total = below[:, -1]
    middle = [
        column[order][(below > place[:, None]).argmax(axis=1)]
        for place in ((total - 1) // 2, total // 2)
    ]
    return np.where(total > 0, (middle[0] + middle[1]) / 2, np.nan)


def percentiles(values: Floats) -> tuple[float, float]:
    """The 95 % interval of what came out of draws; NaN where most have no value."""
    known = values[np.isfinite(values)]
    if len(known) < max(1, len(values) // 2):
        return float("nan"), float("nan")
    low, high = np.percentile(known, [2.5, 97.5])
    return float(low), float(high)


def _ratio(total: Floats, count: Floats) -> Floats:
    return np.divide(total, count, out=np.full(total.shape, np.nan), where=count > 0)
