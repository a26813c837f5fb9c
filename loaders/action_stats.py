"""Statistics of actions by definition, over a sample of chunks that keys and frames decide.

Actions are looked at in whole chunks of CHUNK_LENGTH steps. Of the chunks of a split, one for every
frame that starts one, those count whose hash (of the episode's key and the first frame) begins with
``halvings`` zero bits: all of a small split, one in 2**halvings of a large one, the same ones
wherever the episodes lie. Steps that a chunk's mask leaves out, absent hands among them, never
count; a state counts for the hands that are present in it.
"""

import hashlib
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mint_hub.conventions import SIDES
from mint_hub.geometry import camera_state
from mint_hub.loaders.actions import (
    CHUNK_LENGTH,
    DEFINITIONS,
    HAND_ACTION_SIZE,
    HAND_STATE_SIZE,
    Fingers,
    Relative,
    window_definitions,
)
from mint_hub.loaders.member_table import ABSENT, TRAJ, member
from mint_hub.loaders.sketch import Sketch

LEAST_CHUNKS: Final = 2048
"""About as many chunks are looked at, at the least, where there are as many."""

MOST_HALVINGS: Final = 10
"""No fewer than one chunk in 2**10 is looked at."""

STATE: Final = "state"

_CHUNKS_AT_ONCE: Final = 256


def halvings_for(num_frames: int) -> int:
    """Return how often to halve the chunks of a split of about so many frames.

    >>> [halvings_for(n) for n in (100, 4095, 4096, 100_000, 10**8)]
    [0, 0, 1, 5, 10]
    """
    return min(MOST_HALVINGS, max(0, (num_frames // LEAST_CHUNKS).bit_length() - 1))


def chosen_starts(key: str, num_frames: int, halvings: int) -> NDArray[np.int64]:
    """Return the first frames of the chunks of an episode that are looked at, ascending.

    The hash is the SplitMix64 finaliser (Steele, Lea and Flood 2014) of the frame's number added to
    64 bits of the key's sha256.
    """
    starts = np.arange(num_frames)
    if not halvings:
        return starts
    seed = int.from_bytes(hashlib.sha256(key.encode()).digest()[:8], "little")
    x = np.uint64(seed) + (starts + 1).astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15)
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    x ^= x >> np.uint64(31)
    return np.flatnonzero(x >> np.uint64(64 - halvings) == 0)


class ActionStats:
    """Sketches of states and of the actions of every definition, by source and hand."""

    def __init__(self, halvings: int = 0) -> None:
        self.halvings = halvings
        self.chunks: dict[str, int] = {}
        self.sketches: dict[str, dict[str, tuple[Sketch, ...]]] = {}
        self._waiting: dict[str, list[tuple[NDArray[Any], ...]]] = {}

    def add(
        self, source: str, key: str, traj: NDArray[np.float32], state: NDArray[np.float32]
    ) -> None:
        """Take in an episode: its ``traj.npy`` (T, 17) and its hand states (T, 2, 109)."""
        starts = chosen_starts(key, len(traj), self.halvings)
        for some in np.split(starts, range(_CHUNKS_AT_ONCE, len(starts), _CHUNKS_AT_ONCE)):
            frames = some[:, None] + np.arange(CHUNK_LENGTH + 1)
            inside = frames < len(traj)
            frames = frames.clip(max=len(traj) - 1)
            waiting = self._waiting.setdefault(source, [])
            waiting.append((traj[frames], state[frames], inside))
            if sum(len(part[0]) for part in waiting) >= _CHUNKS_AT_ONCE:
                self._settle(source)

    def merge(self, other: "ActionStats") -> None:
        """Take in what another with as many halvings has seen; in a fixed order, exactly."""
        assert self.halvings == other.halvings
        for mine in (self, other):
            for source in list(mine._waiting):
                mine._settle(source)
        for source, tables in other.sketches.items():
            self.chunks[source] = self.chunks.get(source, 0) + other.chunks[source]
            mine = self._of(source)
            for name, hands in tables.items():
                for ours, theirs in zip(mine[name], hands, strict=True):
                    ours.merge(theirs)

    def to_dict(self) -> dict[str, Any]:
        """Return statistics and how they were made, JSON-able.

        ``sources[source][name][side]`` is ``Sketch.to_dict``: under "state" of 61 numbers, under
        the name of each definition of 51.
        """
        self.merge(ActionStats(self.halvings))
        return {
            "chunk_length": CHUNK_LENGTH,
            "share": 0.5**self.halvings,
            "sampling": SAMPLING,
            "sources": {
                source: {
                    "chunks": self.chunks[source],
                    **{
                        name: {side: s.to_dict() for side, s in zip(SIDES, pair, strict=True)}
                        for name, pair in tables.items()
                    },
                }
                for source, tables in sorted(self.sketches.items())
            },
        }

    def _of(self, source: str) -> dict[str, tuple[Sketch, ...]]:
        if source not in self.sketches:
            sizes = dict.fromkeys((definition(*d) for d in DEFINITIONS), HAND_ACTION_SIZE)
            self.sketches[source] = {
                name: tuple(Sketch(size) for _ in SIDES)
                for name, size in {STATE: HAND_STATE_SIZE, **sizes}.items()
            }
        return self.sketches[source]

    def _settle(self, source: str) -> None:
        parts = zip(*self._waiting.pop(source), strict=True)
        traj, state, inside = (np.concatenate(part) for part in parts)
        self.chunks[source] = self.chunks.get(source, 0) + len(traj)
        sketches = self._of(source)
        if not len(traj):
            return
        slices = member(TRAJ).slices
        there = [traj[..., slices[f"{side}_presence"].start] != ABSENT for side in SIDES]
        camera = camera_state.unpack(traj[..., : slices["fov_vh"].stop].astype(np.float64))
        made = window_definitions(
            camera.T_camera_from_world(), state, np.stack(there, -1) & inside[..., None]
        )
        for words, chunks in made.items():
            numbers = chunks.action.reshape(*chunks.mask.shape, HAND_ACTION_SIZE)
            for hand, sketch in enumerate(sketches[definition(*words)]):
                sketch.add(numbers[..., hand, :][chunks.mask[..., hand]])
        chunks = made[DEFINITIONS[0]]
        for hand, sketch in enumerate(sketches[STATE]):
            each = chunks.state.reshape(len(chunks), len(SIDES), HAND_STATE_SIZE)
            sketch.add(each[chunks.state_mask[:, hand], hand])


SAMPLING: Final = (
    "chunks of chunk_length steps; a chunk is one frame of one episode, its first; share of all "
    "chunks, chosen by a hash of the episode's key and that frame; chunks = how many were chosen; "
    "a count is of the steps that the mask keeps, or of the hands present in a state"
)


def definition(relative: Relative, fingers: Fingers) -> str:
    """Return what statistics call a definition.

    >>> definition("step", "absolute")
    'step, absolute fingers'
    """
    return f"{relative}, {fingers} fingers"
