"""Statistics of numbers seen once: moments, extremes and quantiles in bounded memory.

``Sketch`` takes rows of C channels in any number of parts and merges with others. Counts, extremes
and histograms do not depend on how rows were divided; mean and variance follow Chan, Golub and
LeVeque (1983) and pool over all rows, so an episode weighs as much as it has frames. Quantiles come
from a histogram over the upper 16 bits of float32: 128 bins an octave, so an estimate is within
QUANTILE_RELATIVE_ERROR of a value of that rank, or QUANTILE_ABSOLUTE_ERROR where that is more, and
the memory never grows. Magnitudes from 2**14 on share one bin.

``CorpusStats`` holds one sketch for the camera and one a hand, by source; a hand counts only in
frames where it is present.
"""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mint_hub.conventions import SIDES
from mint_hub.geometry import hand_state as hands
from mint_hub.loaders import members
from mint_hub.loaders.manifest import STATS, read_sealed, write_sealed
from mint_hub.loaders.tar_layout import CorpusError

QUANTILES: Final = (0.01, 0.1, 0.5, 0.9, 0.99)
QUANTILE_RELATIVE_ERROR: Final = 2.0**-8
QUANTILE_ABSOLUTE_ERROR: Final = 2.0**-14
STATS_VERSION: Final = 1
UNKNOWN_SOURCE: Final = "unknown"
"""Under which episodes count whose json names no source."""

HAND_FIELDS: Final = {
    "translation": hands.TRANSLATION,
    "orientation_rot6d_rows": hands.ORIENTATION,
    "joint_rot6d_rows": hands.JOINT_ROTATIONS,
    "shape_params": hands.SHAPE,
}
"""What is said of each hand: where each field lies in a hand state."""

_SLOTS: Final = 128
_LOWEST: Final = (127 - 14) * _SLOTS
_TOP: Final = (127 + 14) * _SLOTS - _LOWEST + 1
_BINS: Final = 2 * _TOP + 1
_BLOCK_FRAMES: Final = 1 << 14


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


class CorpusStats:
    """Sketches of camera and hands by source, fed with the members of samples."""

    def __init__(self) -> None:
        self.sketches: dict[str, tuple[Sketch, Sketch, Sketch]] = {}
        self._waiting: dict[str, list[tuple[NDArray[np.float32], NDArray[np.float32]]]] = {}

    def add(self, meta: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> None:
        """Take in an episode: its json member and its arrays, as ``members.arrays_of`` gives."""
        source = meta["source"] or UNKNOWN_SOURCE
        waiting = self._waiting.setdefault(source, [])
        waiting.append((np.asarray(arrays[members.TRAJ]), _states(meta, arrays)))
        if sum(len(traj) for traj, _ in waiting) >= _BLOCK_FRAMES:
            self._settle(source)

    def merge(self, other: "CorpusStats") -> None:
        """Take in what another has seen; in a fixed order, results are equal to the last bit."""
        for mine in (self, other):
            for source in list(mine._waiting):
                mine._settle(source)
        for source, sketches in other.sketches.items():
            for mine, theirs in zip(self._of(source), sketches, strict=True):
                mine.merge(theirs)

    def to_dict(self) -> dict[str, Any]:
        """Return ``{source: {camera | left | right: {field: statistics}}}``, JSON-able."""
        self.merge(CorpusStats())
        camera = {k: v for k, v in members.member(members.TRAJ).slices.items() if k in _CAMERA}
        tables = (camera, HAND_FIELDS, HAND_FIELDS)
        return {
            source: {
                part: {name: sketch.to_dict(where) for name, where in table.items()}
                for part, table, sketch in zip(("camera", *SIDES), tables, sketches, strict=True)
            }
            for source, sketches in sorted(self.sketches.items())
        }

    def _of(self, source: str) -> tuple[Sketch, Sketch, Sketch]:
        if source not in self.sketches:
            hand = hands.HAND_STATE_SIZE
            self.sketches[source] = (Sketch(_CAMERA_WIDTH), Sketch(hand), Sketch(hand))
        return self.sketches[source]

    def _settle(self, source: str) -> None:
        waiting = self._waiting.pop(source)
        traj = np.concatenate([t for t, _ in waiting])
        state = np.concatenate([s for _, s in waiting])
        camera, *both = self._of(source)
        camera.add(traj[:, :_CAMERA_WIDTH])
        slices = members.member(members.TRAJ).slices
        for hand, (side, sketch) in enumerate(zip(SIDES, both, strict=True)):
            present = traj[:, slices[f"{side}_presence"]][:, 0] != members.ABSENT
            sketch.add(state[present, hand])


_CAMERA: Final = ("camera_translation", "camera_quat_xyzw", "fov_vh")
_CAMERA_WIDTH: Final = members.member(members.TRAJ).slices["fov_vh"].stop


def _states(meta: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> NDArray[np.float32]:
    """Hand states (T, 2, 109) of either format, without checks: what is stored is counted."""
    if members.STATE in arrays:
        return arrays[members.STATE].reshape(-1, 2, hands.HAND_STATE_SIZE)
    traj, slices = arrays[members.TRAJ], members.member(members.TRAJ).slices
    state = np.empty((len(traj), 2, hands.HAND_STATE_SIZE), np.float32)
    for hand, side in enumerate(SIDES):
        state[:, hand, hands.TRANSLATION] = traj[:, slices[f"{side}_wrist"]]
    rotations = slice(hands.ORIENTATION.start, hands.JOINT_ROTATIONS.stop)
    state[..., rotations] = arrays[members.ROT6D].reshape(len(traj), 2, -1)
    state[..., hands.SHAPE] = np.asarray(meta["shape"], np.float32)
    return state


def write_stats(
    config_folder: Path, split: str, content: str, stats: CorpusStats, scratch: Path
) -> None:
    """Put the statistics of a split into the config's ``stats.json``, bound to its content hash.

    The file is made in the folder ``scratch``, on the same disk, and renamed.
    """
    path = config_folder / STATS
    splits = read_sealed(path)["splits"] if path.exists() else {}
    splits[split] = {"content": content, "sources": stats.to_dict()}
    error = {"relative": QUANTILE_RELATIVE_ERROR, "absolute": QUANTILE_ABSOLUTE_ERROR}
    values = {"stats_version": STATS_VERSION, "quantile_error": error, "splits": splits}
    write_sealed(scratch / STATS, values)
    os.replace(scratch / STATS, path)


def read_stats(config_folder: Path, split: str, content: str) -> dict[str, Any]:
    """Return ``{source: {camera | left | right: {field: statistics}}}`` of one split.

    ``content`` is the ``content`` of the split's manifest.

    Raises:
        CorpusError: there are none, they are damaged, or they were made from other shards.

    """
    path = config_folder / STATS
    values = read_sealed(path)
    if (version := values["stats_version"]) > STATS_VERSION:
        raise CorpusError(f"{path}: expected stats_version at most {STATS_VERSION}, got {version}")
    entry = values["splits"].get(split)
    if entry is None:
        raise CorpusError(f"{path}: expected split {split!r}, got {sorted(values['splits'])}")
    if entry["content"] != content:
        raise CorpusError(
            f"{path}: expected statistics of content {content[:12]}, got {entry['content'][:12]}: "
            f"the shards of {split!r} were written anew"
        )
    return entry["sources"]
