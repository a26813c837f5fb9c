"""Statistics of a split: what ``stats.json`` says of camera, hands and actions, by source.

``CorpusStats`` holds one ``Sketch`` for the camera and one a hand, over all frames, so that an
episode weighs as much as it has frames; a hand counts only in frames where it is present. Actions
are those of a sample of chunks (``action_stats``).
"""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mint_hub.conventions import SIDES
from mint_hub.geometry import hand_state as hands
from mint_hub.loaders import members
from mint_hub.loaders.action_stats import ActionStats
from mint_hub.loaders.manifest import STATS, read_sealed, write_sealed
from mint_hub.loaders.sketch import (
    QUANTILE_ABSOLUTE_ERROR,
    QUANTILE_RELATIVE_ERROR,
    QUANTILES,
    Sketch,
)
from mint_hub.loaders.tar_layout import CorpusError

__all__ = [
    "HAND_FIELDS",
    "QUANTILES",
    "QUANTILE_ABSOLUTE_ERROR",
    "QUANTILE_RELATIVE_ERROR",
    "STATS_VERSION",
    "UNKNOWN_SOURCE",
    "CorpusStats",
    "Sketch",
    "read_action_stats",
    "read_stats",
    "write_stats",
]

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

_BLOCK_FRAMES: Final = 1 << 14


class CorpusStats:
    """Sketches of camera, hands and actions by source, fed with the members of samples.

    ``halvings`` says how few chunks of actions are looked at: see ``ActionStats``.
    """

    def __init__(self, halvings: int = 0) -> None:
        self.sketches: dict[str, tuple[Sketch, Sketch, Sketch]] = {}
        self.actions = ActionStats(halvings)
        self._waiting: dict[str, list[tuple[NDArray[np.float32], NDArray[np.float32]]]] = {}

    def add(self, meta: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> None:
        """Take in an episode: its json member and its arrays, as ``members.arrays_of`` gives."""
        source = meta["source"] or UNKNOWN_SOURCE
        waiting = self._waiting.setdefault(source, [])
        traj, state = np.asarray(arrays[members.TRAJ]), _states(meta, arrays)
        self.actions.add(source, meta["key"], traj, state)
        waiting.append((traj, state))
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
        self.actions.merge(other.actions)

    def to_dict(self) -> dict[str, Any]:
        """Return ``{source: {camera | left | right: {field: statistics}}}``, JSON-able."""
        self.merge(CorpusStats(self.actions.halvings))
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
    splits[split] = {
        "content": content,
        "sources": stats.to_dict(),
        "actions": stats.actions.to_dict(),
    }
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
    return _read_entry(config_folder, split, content)["sources"]


def read_action_stats(config_folder: Path, split: str, content: str) -> dict[str, Any]:
    """Return ``ActionStats.to_dict`` of one split, for ``action_normaliser``.

    Raises:
        CorpusError: as ``read_stats``; or the file is older than statistics of actions.

    """
    entry = _read_entry(config_folder, split, content)
    if "actions" not in entry:
        path = config_folder / STATS
        raise CorpusError(
            f"{path}: expected statistics of actions of {split!r}, got none: it was "
            "written by an older mint-hub; write the split anew"
        )
    return entry["actions"]


def _read_entry(config_folder: Path, split: str, content: str) -> dict[str, Any]:
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
    return entry
