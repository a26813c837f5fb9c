"""The 109 numbers of a hand: where they lie, and what they mean.

Layout of one hand's state, last axis of size 109:

    translation          3    position of the wrist joint itself, metres, camera frame
    orientation         6    rotation of the wrist, camera from hand, ``rot6d_rows``
    joint rotations  15 x 6    each relative to its parent joint, in MANO's order, ``rot6d_rows``
    shape               10    numbers of the hand model's shape space (``mano`` or ``mint``)

The zero pose (identity rotations) is the flat hand: no mean pose is added. Joint rotations of a
left hand are stored as those of its mirror image, ``R_stored = D R_left D`` with
``D = diag(conventions.LEFT_MIRROR)``; its orientation and translation are not mirrored. This module
only packs and unpacks: :mod:`mint_hub.geometry.hand_model` turns states into joints and meshes.
Everything takes numpy arrays or torch tensors, with any leading dimensions.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from mint_hub.conventions import JOINT_NAMES, LEFT_MIRROR, Side
from mint_hub.geometry.arrays import Array, ArrayT, namespace, require_shape
from mint_hub.geometry.rotations import matrix_to_rot6d_rows, rot6d_rows_to_matrix

NUM_JOINT_ROTATIONS: Final = len(JOINT_NAMES) - 1
NUM_SHAPE_PARAMS: Final = 10

TRANSLATION: Final = slice(0, 3)
ORIENTATION: Final = slice(3, 9)
JOINT_ROTATIONS: Final = slice(9, 9 + 6 * NUM_JOINT_ROTATIONS)
SHAPE: Final = slice(JOINT_ROTATIONS.stop, JOINT_ROTATIONS.stop + NUM_SHAPE_PARAMS)
HAND_STATE_SIZE: Final = SHAPE.stop
"""Numbers of one hand in one frame: 109."""

_IDENTITY_ROT6D: Final = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0)


@dataclass(frozen=True)
class HandState:
    """One hand, or a batch of them, with its numbers named; numpy or torch throughout.

    Attributes:
        translation: (..., 3) wrist joint position, metres, camera frame.
        orientation_rot6d_rows: (..., 6) wrist rotation, camera from hand.
        joint_rot6d_rows: (..., 15, 6) parent-relative joint rotations, as stored (a left hand's are
            its mirror image's).
        shape_params: (..., 10) shape numbers of the hand model's shape space.

    """

    translation: Array
    orientation_rot6d_rows: Array
    joint_rot6d_rows: Array
    shape_params: Array

    @classmethod
    def from_matrices(
        cls,
        translation: Array,
        orientation: Array,
        joint_rotations: Array,
        shape_params: Array,
    ) -> HandState:
        """Make the state with these rotations as matrices, joint rotations already as stored.

        Args:
            translation: (..., 3) wrist joint position, metres, camera frame.
            orientation: (..., 3, 3) wrist rotation, camera from hand.
            joint_rotations: (..., 15, 3, 3) parent-relative, as stored: for a left hand of another
                source, ``mirror_rotations`` its true rotations first.
            shape_params: (..., 10).

        Raises:
            ValueError: a part has another trailing shape.

        """
        require_shape("orientation", orientation, (3, 3))
        require_shape("joint_rotations", joint_rotations, (NUM_JOINT_ROTATIONS, 3, 3))
        return cls(
            translation,
            matrix_to_rot6d_rows(orientation),
            matrix_to_rot6d_rows(joint_rotations),
            shape_params,
        )

    def orientation(self, check: bool = True) -> Array:
        """Decode the wrist rotation, camera from hand, (..., 3, 3).

        With ``check`` a zero, parallel or non-finite 6D row pair raises ValueError.
        """
        return rot6d_rows_to_matrix(self.orientation_rot6d_rows, check=check)

    def joint_rotations(self, side: Side | None = None, check: bool = True) -> Array:
        """Decode the parent-relative joint rotations, (..., 15, 3, 3).

        Without ``side`` they are as stored; with ``side="left"`` they are the left hand's own
        (``D R D``). With ``check`` a degenerate 6D row pair raises ValueError.
        """
        rotations = rot6d_rows_to_matrix(self.joint_rot6d_rows, check=check)
        return mirror_rotations(rotations) if side == "left" else rotations

    def pack(self) -> Array:
        """Make the (..., 109) array that ``unpack`` reads: ``unpack(x).pack() == x``.

        Raises:
            ValueError: a part has another trailing shape than the class describes.

        """
        parts = (
            self.translation,
            self.orientation_rot6d_rows,
            self.joint_rot6d_rows,
            self.shape_params,
        )
        require_shape("translation", self.translation, (3,))
        require_shape("orientation_rot6d_rows", self.orientation_rot6d_rows, (6,))
        require_shape("joint_rot6d_rows", self.joint_rot6d_rows, (NUM_JOINT_ROTATIONS, 6))
        require_shape("shape_params", self.shape_params, (NUM_SHAPE_PARAMS,))
        lib = namespace(*parts)
        leading = np.broadcast_shapes(
            *(tuple(p.shape[:-1]) for p in (parts[0], parts[1], parts[3]))
        )
        leading = np.broadcast_shapes(leading, tuple(parts[2].shape[:-2]))
        joints = parts[2].reshape((*parts[2].shape[:-2], 6 * NUM_JOINT_ROTATIONS))
        flat = (parts[0], parts[1], joints, parts[3])
        return lib.concatenate([lib.broadcast_to(p, (*leading, p.shape[-1])) for p in flat], -1)


def unpack(hand_state: Array) -> HandState:
    """Name the numbers of a hand state; views, nothing is copied.

    Args:
        hand_state: (..., 109), numpy or torch.

    Raises:
        ValueError: the last axis is not 109 long.

    """
    require_shape("hand_state", hand_state, (HAND_STATE_SIZE,))
    leading = tuple(hand_state.shape[:-1])
    return HandState(
        translation=hand_state[..., TRANSLATION],
        orientation_rot6d_rows=hand_state[..., ORIENTATION],
        joint_rot6d_rows=hand_state[..., JOINT_ROTATIONS].reshape(
            (*leading, NUM_JOINT_ROTATIONS, 6)
        ),
        shape_params=hand_state[..., SHAPE],
    )


def absent(shape: Sequence[int] = (), like: Array | None = None) -> Array:
    """How a hand that is not there is stored: zero translation and shape, identity rotations.

    Args:
        shape: leading dimensions of the result.
        like: an array or tensor whose kind, dtype and device the result takes; numpy float32
            without it.

    Returns:
        (*shape, 109), writable.

    """
    one = np.zeros(HAND_STATE_SIZE, np.float32)
    one[ORIENTATION] = _IDENTITY_ROT6D
    one[JOINT_ROTATIONS] = _IDENTITY_ROT6D * NUM_JOINT_ROTATIONS
    tiled = np.tile(one, (*shape, 1))
    if like is None:
        return tiled
    if isinstance(like, np.ndarray):
        return tiled.astype(like.dtype)
    return like.new_tensor(tiled)


def mirror_rotations(rotations: Array) -> Array:
    """Mirror rotations (..., 3, 3) across x: ``D R D`` with ``D = diag(LEFT_MIRROR)``.

    It is its own inverse, and maps stored joint rotations of a left hand to true ones and back.

    Raises:
        ValueError: the last two axes are not 3 x 3.

    """
    require_shape("rotations", rotations, (3, 3))
    signs = np.outer(LEFT_MIRROR, LEFT_MIRROR)
    if isinstance(rotations, np.ndarray):
        return rotations * signs.astype(rotations.dtype)
    return rotations * rotations.new_tensor(signs)


def keep_in_picture(hand_state: ArrayT, fov_vh_before: Array, fov_vh_after: Array) -> ArrayT:
    """Hands where they lay in the picture and as deep, under another field of view.

    x' = x tan(after / 2) / tan(before / 2), of horizontal angles; y alike, of vertical ones.

    Args:
        hand_state: (..., 2, 109), camera frame, metres.
        fov_vh_before: (..., 2) radians, (vertical, horizontal), that the hands were placed under.
        fov_vh_after: (..., 2) radians.

    Returns:
        (..., 2, 109): only x and y of translations differ.

    """
    xp = namespace(hand_state)
    ratio = xp.tan(fov_vh_after / 2) / xp.tan(fov_vh_before / 2)
    xy = hand_state[..., :2] * ratio[..., None, [1, 0]]
    return xp.concatenate([xy, hand_state[..., 2:]], -1)
