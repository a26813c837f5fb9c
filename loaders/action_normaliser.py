"""Actions and states normalised by what ``stats.json`` says of a definition."""

import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mint_hub.conventions import SIDES
from mint_hub.loaders.action_stats import STATE, definition
from mint_hub.loaders.actions import (
    DEFINITIONS,
    HAND_ACTION_SIZE,
    HAND_STATE_SIZE,
    ActionChunks,
    Fingers,
    Relative,
)
from mint_hub.loaders.manifest import read_manifest
from mint_hub.loaders.stats import read_action_stats
from mint_hub.loaders.tar_layout import CorpusError

STD_FLOOR: Final = 1e-6
"""A number whose standard deviation is below this does not vary: it is centred, not scaled."""


@dataclass(frozen=True, eq=False)
class ActionNormaliser:
    """Actions and states to mean 0 and variance 1 over a corpus, and back, by one definition.

    What a mask leaves out is and stays zero. A hand that was never present is left as it is.

    Attributes:
        action_mean: (102,) and ``action_std`` (102,), of actions.
        state_mean: (122,) and ``state_std`` (122,), of states.
        relative: of the actions.
        fingers: of the actions.

    """

    action_mean: NDArray[np.float64]
    action_std: NDArray[np.float64]
    state_mean: NDArray[np.float64]
    state_std: NDArray[np.float64]
    relative: Relative = "step"
    fingers: Fingers = "absolute"

    @classmethod
    def from_stats(
        cls,
        stats: Mapping[str, Any],
        relative: Relative = "step",
        fingers: Fingers = "absolute",
        sources: Iterable[str] | None = None,
    ) -> "ActionNormaliser":
        """Build it from ``read_action_stats``, pooled over some sources, or all.

        Raises:
            CorpusError: a source has no statistics, or there are none at all.
            ValueError: no such definition.

        """
        if (relative, fingers) not in DEFINITIONS:
            raise ValueError(
                f"relative, fingers: expected one of {list(DEFINITIONS)}, got {(relative, fingers)}"
            )
        known = stats["sources"]
        names = sorted(known) if sources is None else list(sources)
        if missing := [name for name in names if name not in known] or not names:
            raise CorpusError(f"sources: expected some of {sorted(known)}, got {missing or names}")
        action = _pooled([known[n][definition(relative, fingers)] for n in names], HAND_ACTION_SIZE)
        state = _pooled([known[n][STATE] for n in names], HAND_STATE_SIZE)
        return cls(*action, *state, relative, fingers)

    @classmethod
    def from_corpus(
        cls,
        folder: str | os.PathLike[str],
        config: str,
        split: str = "train",
        relative: Relative = "step",
        fingers: Fingers = "absolute",
        sources: Iterable[str] | None = None,
    ) -> "ActionNormaliser":
        """Build it from the ``stats.json`` of a corpus in a folder.

        Raises:
            CorpusError: there is none for this split, or it is damaged or of other shards.

        """
        place = Path(folder) / config
        stats = read_action_stats(place, split, read_manifest(place / split).content)
        return cls.from_stats(stats, relative, fingers, sources)

    def normalise(self, chunks: ActionChunks) -> ActionChunks:
        """Return the chunks with (x - mean) / std for every number that counts.

        Raises:
            ValueError: chunks of another definition.

        """
        action = (chunks.action - self.action_mean) / self.action_std
        state = (chunks.state - self.state_mean) / self.state_std
        return self._masked(chunks, action, state)

    def denormalise(self, chunks: ActionChunks) -> ActionChunks:
        """Return the chunks with x * std + mean: the inverse of ``normalise``, to rounding.

        Raises:
            ValueError: chunks of another definition.

        """
        action = chunks.action * self.action_std + self.action_mean
        state = chunks.state * self.state_std + self.state_mean
        return self._masked(chunks, action, state)

    def _masked(
        self, chunks: ActionChunks, action: NDArray[Any], state: NDArray[Any]
    ) -> ActionChunks:
        if (chunks.relative, chunks.fingers) != (self.relative, self.fingers):
            raise ValueError(
                f"chunks: expected {definition(self.relative, self.fingers)!r}, got "
                f"{definition(chunks.relative, chunks.fingers)!r}"
            )
        counts = np.repeat(chunks.mask, HAND_ACTION_SIZE, axis=-1)
        present = np.repeat(chunks.state_mask, HAND_STATE_SIZE, axis=-1)
        return replace(
            chunks,
            action=np.where(counts, action, 0).astype(chunks.action.dtype),
            state=np.where(present, state, 0).astype(chunks.state.dtype),
        )


def _pooled(
    tables: Iterable[Mapping[str, Any]], size: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean and standard deviation of both hands, left first, over all of the tables."""
    means: list[NDArray[np.float64]] = []
    stds: list[NDArray[np.float64]] = []
    seen = list(tables)
    for side in SIDES:
        said = [table[side] for table in seen if table[side]["count"]]
        if not said:
            means.append(np.zeros(size))
            stds.append(np.ones(size))
            continue
        weight = np.array([s["count"] for s in said], float) / sum(s["count"] for s in said)
        mean = np.array([s["mean"] for s in said])
        centre = weight @ mean
        variance = weight @ (np.array([s["variance"] for s in said]) + (mean - centre) ** 2)
        std = np.sqrt(variance)
        means.append(centre)
        stds.append(np.where(std < STD_FLOOR, 1.0, std))
    return np.concatenate(means), np.concatenate(stds)
