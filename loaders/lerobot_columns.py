"""The two dialects of LeRobot v3 labels, and the numbers behind their columns.

Both describe the same frames; a file is told by its column names, never by what its values look
like. T frames; matrices are flattened row by row; sides and frames are ``mint_hub.conventions``'.

"camera"
    ``cam_trans`` and ``cam_quat`` (world-to-camera, xyzw), ``cam_fov`` as (vertical, horizontal),
    and for each side the 109 numbers of ``geometry.hand_state`` in the camera frame, float32.
"world"
    ``extrinsics_w2c`` (4 x 4), ``fov`` as (horizontal, vertical), ``intrinsics``, and for each side
    the wrist joint and its orientation in the world with the joint rotations as matrices, float64.
    Wrist and joint rotations mean the same as in the hand state: the wrist joint itself, and a left
    hand's joint rotations as its mirror image's. Shapes stand in ``observation.state``.
"""

from collections.abc import Collection
from dataclasses import dataclass
from typing import Any, Final, Literal

from mint_hub.conventions import SIDES
from mint_hub.geometry import hand_state as hands

Dialect = Literal["camera", "world"]


class LeRobotError(ValueError):
    """A LeRobot root breaks its contract; the message names file, column, expected and got."""


@dataclass(frozen=True)
class Column:
    """One column of the frame table: ``width`` numbers a frame (1: a plain number, no list)."""

    name: str
    dtype: str
    width: int
    names: tuple[str, ...] | None = None
    required: bool = True

    def feature(self) -> dict[str, Any]:
        """Return this column as ``features`` of info.json describe it."""
        names = list(self.names) if self.names else None
        return {"dtype": self.dtype, "shape": [self.width], "names": names}


_SIDES = ("left", "right")
COUNTERS: Final = (
    Column("index", "int64", 1, required=False),
    Column("episode_index", "int64", 1),
    Column("frame_index", "int64", 1),
    Column("task_index", "int64", 1, required=False),
    Column("main_type", "int64", 1, required=False),
    Column("timestamp", "float64", 1, required=False),
    Column("state_mask", "bool", 2, _SIDES, required=False),
)
"""What both dialects count: ``main_type`` is the hand of the text: 0 left, 1 right, -1 unsaid."""

LABELS: Final[dict[Dialect, tuple[Column, ...]]] = {
    "camera": (
        Column("hand_kept", "bool", 2, _SIDES),
        Column("cam_trans", "float32", 3, ("x", "y", "z")),
        Column("cam_quat", "float32", 4, ("x", "y", "z", "w")),
        Column("cam_fov", "float32", 2, ("vertical", "horizontal")),
        *(
            Column(f"{side}_mano_{name}", "float32", width)
            for side in SIDES
            for name, width in (
                ("transl_cam", 3),
                ("orient6d", 6),
                ("pose6d", 6 * hands.NUM_JOINT_ROTATIONS),
                ("betas", hands.NUM_SHAPE_PARAMS),
            )
        ),
    ),
    "world": (
        Column("fov", "float64", 2, ("horizontal", "vertical")),
        Column("intrinsics", "float64", 9, required=False),
        Column("extrinsics_w2c", "float64", 16),
        Column("observation.state", "float64", 122, required=False),
        *(
            Column(f"{side}_{name}", dtype, width)
            for side in SIDES
            for name, dtype, width in (
                ("transl_world", "float64", 3),
                ("orient_world", "float64", 9),
                ("hand_pose", "float64", 9 * hands.NUM_JOINT_ROTATIONS),
                ("kept", "bool", 1),
            )
        ),
    ),
}
"""The labels of each dialect."""

EXTRA: Final = (
    Column("timestamp_s", "float64", 1, required=False),
    Column("presence_score", "float32", 2, _SIDES, required=False),
    Column("hand_filled", "bool", 2, _SIDES, required=False),
)
"""Ours, on request: what an Episode says beyond the two dialects."""


def columns_of(dialect: Dialect, extra: bool = False) -> tuple[Column, ...]:
    """All columns of a dialect, in the order in which they are written."""
    return (*COUNTERS, *LABELS[dialect], *(EXTRA if extra else ()))


def dialect_of(names: Collection[str]) -> Dialect:
    """Tell the dialect by column names; "camera", which is exact, where a file has both.

    Raises:
        LeRobotError: neither dialect is complete; the nearer one's missing columns are listed.

    """
    missing = {
        dialect: [c.name for c in (*COUNTERS, *columns) if c.required and c.name not in names]
        for dialect, columns in LABELS.items()
    }
    best: Dialect = "camera" if len(missing["camera"]) <= len(missing["world"]) else "world"
    if missing[best]:
        raise LeRobotError(
            f"expected every column of the camera or the world dialect, got neither: "
            f"nearest is {best!r}, without {missing[best]}"
        )
    return best
