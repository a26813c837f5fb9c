"""Which window is read when: a law of (seed, position) alone, whatever processes there are.

Windows lie in groups, one a source, each with a weight. An epoch takes from each group its share;
within a group every window comes once before any comes again.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from mint_hub.loaders.order import Order


@dataclass(frozen=True)
class MixtureOrder:
    """The endless order of a run over windows 0 .. N - 1 that lie in groups.

    Attributes:
        sizes: windows of each group, all at least 1; group g holds the numbers after those before.
        weights: share of each group; None: each window alike.
        seed: of the order.

    Raises:
        ValueError: no windows, an empty group, or weights that are no shares.

    """

    sizes: Sequence[int]
    weights: Sequence[float] | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        if not len(self.sizes) or min(self.sizes) < 1:
            raise ValueError(f"sizes: expected groups of at least one window, got {self.sizes}")
        if self.weights is None:
            return
        if len(self.weights) != len(self.sizes):
            raise ValueError(
                f"weights: expected one a group, {len(self.sizes)}, got {len(self.weights)}"
            )
        if not all(0 <= w < float("inf") for w in self.weights) or not sum(self.weights) > 0:
            raise ValueError(f"weights: expected numbers >= 0, one above 0, got {self.weights}")

    @cached_property
    def quotas(self) -> tuple[int, ...]:
        """Windows that an epoch takes from each group: at least one where the weight is above 0."""
        if self.weights is None:
            return tuple(self.sizes)
        total, every = sum(self.sizes), sum(self.weights)
        return tuple(max(1, round(total * w / every)) if w > 0 else 0 for w in self.weights)

    @property
    def epoch_length(self) -> int:
        """Positions of an epoch."""
        return sum(self.quotas)

    def window(self, position: int) -> int:
        """Return the number of the window at a position, 0 on.

        Raises:
            ValueError: a negative position.

        """
        if position < 0:
            raise ValueError(f"position: expected at least 0, got {position}")
        epoch, place = divmod(position, self.epoch_length)
        mixed = int(Order(self.epoch_length, self.seed).permute(epoch, [place])[0])
        ends = np.cumsum(self.quotas)
        group = int(np.searchsorted(ends, mixed, side="right"))
        quota, size = self.quotas[group], self.sizes[group]
        taken = epoch * quota + mixed - int(ends[group] - quota)
        turn, own = divmod(taken, size)
        inside = int(Order(size, self.seed + 1 + group).permute(turn, [own])[0])
        return sum(self.sizes[:group]) + inside


def group_weights(names: Sequence[str], weights: Mapping[str, float] | None) -> list[float] | None:
    """Weights of groups by name, in the groups' order; a group that is not named has weight 0.

    Raises:
        ValueError: a name that no group has; lists those there are.

    """
    if not weights:
        return None
    if unknown := sorted(set(weights) - set(names)):
        raise ValueError(f"mixture: expected sources of {sorted(names)}, got {unknown[0]!r}")
    return [float(weights.get(name, 0.0)) for name in names]
