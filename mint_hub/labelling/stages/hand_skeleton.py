"""The hand as a fitter sees it: 21 angles, 21 keypoints, and how the one moves the other.

Letters in shapes: N hands, 21 angles A in the order of `synth.hand_pose`, 21 points P in the order
of the hand state (16 joints of the tree, then five tips). All in the wrist's frame of a right hand;
a left hand is fitted as its mirror image.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mint_hub.conventions import JOINT_NAMES, JOINT_PARENTS, KEYPOINT_FROM_JOINT, Side
from mint_hub.geometry.hand_model import HandModel, chain
from mint_hub.geometry.rotations import matrix_to_rotvec, skew
from mint_hub.synth.hand_pose import DIGITS, MIRROR, NUM_ANGLES, joint_rotations

Floats = NDArray[np.float64]

_TIP_PARENTS: Final = tuple(
    JOINT_NAMES.index(f"{name}3") for name in ("thumb", "index", "middle", "ring", "pinky")
)
PARENTS: Final = (*JOINT_PARENTS, *_TIP_PARENTS)
"""Parent of each of the 21 points."""

THUMB_BASE: Final = slice(16, 19)
"""The three angles that are one rotation vector."""

ANGLE_JOINTS: Final = tuple(
    JOINT_NAMES.index(f"{name}{joint}")
    for name in DIGITS
    for joint in ((1, 1, 1, 2, 3) if name == "thumb" else (1, 2, 3, 1))
)
"""The joint that each angle turns."""

FLEXION: Final = np.array([(i < 16 and i % 4 != 3) or i > 18 for i in range(NUM_ANGLES)])
"""Angles whose axis turns with their own joint: all but the spreads and the thumb's base."""


@dataclass(frozen=True, eq=False)
class Posed:
    """N hands with given angles.

    Attributes:
        points: (N, 21, 3) keypoints in OpenPose's order, metres, wrist at the origin.
        rotations: (N, 15, 3, 3) joint rotations as a hand state stores them.
        jacobian: (N, 21, 3, 21) metres a radian of each angle, None when not asked for.

    """

    points: Floats
    rotations: Floats
    jacobian: Floats | None


def rest_points(model: HandModel, side: Side, shape_params: Floats) -> Floats:
    """Joints and tips of the flat hand, the wrist at the origin, a left one mirrored: (21, 3)."""
    asset = model.left if side == "left" else model.right
    joints = model.rest_joints(shape_params, side)
    rows = asset.tip_vertices
    tips = asset.template[rows] + asset.shape_directions[rows] @ shape_params
    points = np.concatenate([joints, tips]).astype(np.float64)
    return (points - points[0]) * MIRROR[side]


def pose(angles_rad: Floats, rest: Floats, with_jacobian: bool = True) -> Posed:
    """Bend hands.

    Args:
        angles_rad: (N, 21).
        rest: (N, 21, 3) or (21, 3), see `rest_points`.
        with_jacobian: whether to differentiate.

    """
    count = len(angles_rad)
    rest = np.broadcast_to(rest, (count, 21, 3))
    own = np.asarray(joint_rotations(np.rad2deg(angles_rad)), np.float64)
    upright = np.broadcast_to(np.eye(3), (count, 3, 3))
    turned, joints = (np.asarray(x) for x in chain(upright, own, rest[:, :16]))
    bones = rest[:, 16:] - rest[:, list(_TIP_PARENTS)]
    tips = joints[:, list(_TIP_PARENTS)] + (
        turned[:, list(_TIP_PARENTS)] @ bones[..., None]
    ).squeeze(-1)
    points = np.concatenate([joints, tips], 1)
    keypoints = points[:, list(KEYPOINT_FROM_JOINT)]
    if not with_jacobian:
        return Posed(keypoints, own, None)
    axes = _turning_axes(angles_rad, turned)  # (N, 21 A, 3)
    arms = keypoints[:, :, None] - joints[:, None, list(ANGLE_JOINTS)]  # (N, 21 P, 21 A, 3)
    moved = np.cross(axes[:, None], arms) * _moves()[:, :, None]
    return Posed(keypoints, own, np.swapaxes(moved, 2, 3))


def _turning_axes(angles_rad: Floats, turned: Floats) -> Floats:
    """Axis in the wrist's frame about which each angle turns what hangs on it, (N, 21, 3)."""
    axes = np.broadcast_to(_axes(), (len(angles_rad), NUM_ANGLES, 3)).copy()
    bent = (turned[:, list(ANGLE_JOINTS)] @ axes[..., None]).squeeze(-1)
    axes[:, FLEXION] = bent[:, FLEXION]
    thumb = np.swapaxes(left_jacobian(angles_rad[:, THUMB_BASE]), 1, 2)
    axes[:, THUMB_BASE] = thumb @ _axes()[THUMB_BASE]
    return axes


def left_jacobian(rotvec: Floats) -> Floats:
    """Turn that a change of a rotation vector makes, (..., 3) -> (..., 3, 3); columns are turns.

    I + (1 - cos t) / t^2 [w]x + (t - sin t) / t^3 [w]x^2 (Sola et al. 2018, eq. 145).
    """
    angle = np.maximum(np.linalg.norm(rotvec, axis=-1), 1e-4)[..., None, None]
    W: Any = skew(rotvec)
    first = 2 * (np.sin(angle / 2) / angle) ** 2
    return np.eye(3) + first * W + (angle - np.sin(angle)) / angle**3 * (W @ W)


def flexion_axes() -> Floats:
    """Axes of index, middle, pinky and ring finger in the flat hand, (4, 3); all three joints'."""
    return _axes()[:16:4]


@cache
def _axes() -> Floats:
    """Axis of each angle where the others are zero, read off `joint_rotations`: (21, 3)."""
    one_each = joint_rotations(10.0 * np.eye(NUM_ANGLES))
    turns = matrix_to_rotvec(one_each[range(NUM_ANGLES), np.array(ANGLE_JOINTS) - 1])
    return turns / np.linalg.norm(turns, axis=-1, keepdims=True)


@cache
def _moves() -> Floats:
    """1 where an angle (columns) moves a keypoint (rows), else 0: (21, 21)."""
    moves = np.zeros((len(PARENTS), NUM_ANGLES))
    for point in range(len(PARENTS)):
        above = PARENTS[point]
        while above > 0:
            moves[point, [i for i, joint in enumerate(ANGLE_JOINTS) if joint == above]] = 1
            above = PARENTS[above]
    return moves[list(KEYPOINT_FROM_JOINT)]
