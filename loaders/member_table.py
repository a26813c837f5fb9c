"""The members of a sample of a shard, declared once.

A sample is an episode: ``json`` and plain npy arrays with one row a frame. MEMBERS says what every
column of every array is; whatever needs to know (bytes, features, cards, tables) reads it here.
Letters: T frames.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Final, Literal

import numpy as np

from mint_hub.conventions import SIDES
from mint_hub.geometry import hand_state as hands
from mint_hub.loaders.fields import EpisodeError

Format = Literal["compact", "lossless"]
"""``compact``: float16 rotations, one shape an episode; ``lossless``: all numbers in float32."""

META: Final = "json"
TRAJ: Final = "traj.npy"
ROT6D: Final = "rot6d.npy"
STATE: Final = "state.npy"
EXTRA: Final = "extra.npy"

ABSENT: Final = 0
OBSERVED: Final = 1
FILLED: Final = 2
"""Code of a presence column: the hand is there by interpolation over a gap."""

ROTATIONS: Final = slice(hands.ORIENTATION.start, hands.JOINT_ROTATIONS.stop)
"""The part of a hand state that ``rot6d.npy`` holds: orientation, then joint rotations."""


@dataclass(frozen=True)
class Column:
    """A run of neighbouring numbers of a member's rows."""

    name: str
    width: int
    unit: str
    frame: str
    description: str


@dataclass(frozen=True)
class Member:
    """Declaration of one npy member: rows of ``columns``, one row a frame."""

    name: str
    dtype: str
    columns: tuple[Column, ...]
    description: str

    @property
    def width(self) -> int:
        """Numbers a frame."""
        return sum(column.width for column in self.columns)

    @cached_property
    def slices(self) -> dict[str, slice]:
        """Where each column lies on the last axis, by name.

        >>> member(TRAJ).slices["fov_vh"]
        slice(7, 9, None)
        """
        stops = np.cumsum([column.width for column in self.columns]).tolist()
        return {
            column.name: slice(stop - column.width, stop)
            for column, stop in zip(self.columns, stops, strict=True)
        }


def _sides(name: str, width: int, unit: str, frame: str, description: str) -> tuple[Column, ...]:
    return tuple(Column(f"{s}_{name}", width, unit, frame, f"{s} {description}") for s in SIDES)


_NUM_JOINT_NUMBERS: Final = hands.JOINT_ROTATIONS.stop - hands.JOINT_ROTATIONS.start
_JOINTS_TEXT: Final = "joint rotations in MANO's order, first two rows each"
MEMBERS: Final = (
    Member(
        TRAJ,
        "float32",
        (
            Column("camera_translation", 3, "m", "camera from world", "camera pose, translation"),
            Column("camera_quat_xyzw", 4, "", "camera from world", "camera pose, w >= 0"),
            Column("fov_vh", 2, "rad", "image", "field of view, vertical then horizontal"),
            *_sides("wrist", 3, "m", "camera", "wrist joint; zero where absent"),
            *_sides("presence", 1, "", "", "hand: 0 absent, 1 observed, 2 filled"),
        ),
        "camera, wrists and presence",
    ),
    Member(
        ROT6D,
        "float16",
        tuple(
            column
            for side in SIDES
            for column in (
                Column(f"{side}_orientation", 6, "", "camera from hand", f"{side} wrist rotation"),
                Column(f"{side}_joints", _NUM_JOINT_NUMBERS, "", "parent joint", _JOINTS_TEXT),
            )
        ),
        "rotations of both hands (compact)",
    ),
    Member(
        STATE,
        "float32",
        _sides("hand_state", hands.HAND_STATE_SIZE, "m, 6D rows, shape", "camera", "hand state"),
        "all numbers of both hands (lossless)",
    ),
    Member(
        EXTRA,
        "float32",
        (
            Column("timestamp_offset", 1, "s", "video", "time of frame k - (start_s + k / fps)"),
            *_sides("score", 1, "probability", "", "presence score; NaN if there is none"),
        ),
        "exact times and presence scores (optional, by whole config)",
    ),
)
"""The npy members, declared once."""

_BY_NAME: Final = {m.name: m for m in MEMBERS}


def member(name: str) -> Member:
    """Return the declaration of an npy member.

    Raises:
        EpisodeError: there is no member of that name.

    """
    if name not in _BY_NAME:
        raise EpisodeError(f"member: expected one of {sorted(_BY_NAME)}, got {name!r}")
    return _BY_NAME[name]


def member_names(format: Format = "compact", extra: bool = False) -> tuple[str, ...]:
    """Return the members of every sample of such a config, in the order of the tar.

    >>> member_names("lossless", extra=True)
    ('json', 'traj.npy', 'state.npy', 'extra.npy')

    Raises:
        EpisodeError: another format.

    """
    if format not in ("compact", "lossless"):
        raise EpisodeError(f"format: expected 'compact' or 'lossless', got {format!r}")
    return (META, TRAJ, ROT6D if format == "compact" else STATE, *((EXTRA,) if extra else ()))
