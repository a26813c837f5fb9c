"""From hand states to joints, keypoints and meshes: one linear-blend skinning for every hand.

Two hands go through it: the template that comes with mint-hub (``shape_space`` "mint", no licence
needed), and the user's own MANO files ("mano"). Shape numbers mean nothing across the two. A
right hand rests with fingers about -x, palm about -y, thumb about +z, a little turned towards the
little finger as MANO's is; a left hand is mirrored across x.

Skinning follows Loper et al. 2015 (SMPL, eq. 2-7) with the joint tree of Romero et al. 2017 (MANO),
except that a state's translation is the position of the wrist joint itself.
"""

from __future__ import annotations

import os
import warnings
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, Final

import numpy as np

from mint_hub.assets import read_asset
from mint_hub.conventions import (
    JOINT_PARENTS,
    KEYPOINT_FROM_JOINT,
    LEFT,
    MANO_FINGERTIP_VERTICES,
    RIGHT,
    SIDES,
    ShapeSpace,
    Side,
)
from mint_hub.geometry.arrays import Array, namespace
from mint_hub.geometry.hand_asset import (
    HandAsset,
    closed_mesh,
    load_hand_asset,
    mirrored_asset,
)
from mint_hub.geometry.hand_state import unpack
from mint_hub.geometry.mano_files import (
    ManoTensors,
    find_mano_files,
    read_mano_file,
    shape_directions_for_left,
)

MANO_DIR_VARIABLE: Final = "MINT_HUB_MANO_DIR"
TEMPLATE_FILE: Final = "hand_template.safetensors"


@dataclass(frozen=True, eq=False)
class HandModel:
    """A pair of hands that turns states into geometry.

    Attributes:
        name: which hand model this is, for the record of every result.
        shape_space: what its ten shape numbers mean, "mint" or "mano".
        left: geometry of the left hand.
        right: geometry of the right hand.

    """

    name: str
    shape_space: ShapeSpace
    left: HandAsset
    right: HandAsset
    _warned: set[str] = field(default_factory=set[str], repr=False)

    @classmethod
    def default(
        cls, mano_dir: Path | str | None = None, cache_dir: Path | str | None = None
    ) -> HandModel:
        """Take the user's MANO hand where a folder is given, else the template.

        Args:
            mano_dir: folder with MANO's files; without it the environment variable
                MINT_HUB_MANO_DIR is asked.
            cache_dir: see ``from_mano``.

        Raises:
            FileNotFoundError: a folder is given but holds no MANO_RIGHT.pkl.

        """
        folder = mano_dir if mano_dir is not None else os.environ.get(MANO_DIR_VARIABLE)
        return cls.from_mano(folder, cache_dir) if folder else cls.template()

    @classmethod
    def template(cls) -> HandModel:
        """Give the hand that comes with mint-hub (``mint_hub/assets/README.md``); loaded once."""
        return _template()

    @classmethod
    def from_mano(cls, folder: Path | str, cache_dir: Path | str | None = None) -> HandModel:
        """Read the hand of the user's MANO files.

        With MANO_RIGHT.pkl alone, the left hand is its mirror image; a warning and the model's name
        say so. MANO_LEFT's shape directions are repaired where they are the right hand's.

        Args:
            folder: holds MANO_RIGHT.pkl and MANO_LEFT.pkl.
            cache_dir: where the arrays are kept as safetensors after the first reading.

        Raises:
            FileNotFoundError: the folder holds no MANO_RIGHT.pkl.
            ValueError: a file is not a MANO hand, or asks to run something.

        """
        files = find_mano_files(folder)
        tensors = read_mano_file(files["right"], cache_dir)
        right = _mano_asset(tensors, tensors["f"])
        if "left" not in files:
            message = f"{folder}: no MANO_LEFT.pkl; the left hand is MANO_RIGHT's mirror image"
            warnings.warn(message, stacklevel=2)
            return cls("mano-right-mirrored", "mano", mirrored_asset(right), right)
        left = dict(read_mano_file(files["left"], cache_dir))
        left["shapedirs"], _ = shape_directions_for_left(left["shapedirs"], tensors["shapedirs"])
        return cls("mano", "mano", _mano_asset(left, tensors["f"][:, [0, 2, 1]]), right)

    def faces(self, side: Side) -> np.ndarray:
        """Triangles of the closed mesh, (F, 3) int64, counter-clockwise from outside."""
        return self._asset(side).faces

    def keypoints(
        self, hand_state: Array, shape_space: ShapeSpace | None = None, check: bool = True
    ) -> Array:
        """Compute the 21 keypoints of both hands, in OpenPose's order.

        Args:
            hand_state: (..., 2, 109), left hand first.
            shape_space: of the state's shape numbers; this model's own when not said. Shapes of
                another space are replaced by the mean shape, with one warning.
            check: raise ValueError on degenerate rotations (costs a synchronisation on devices).

        Returns:
            (..., 2, 21, 3) metres, in the frame of the state (the camera's).

        Raises:
            ValueError: another shape than (..., 2, 109); a degenerate rotation with ``check``.

        """
        if hand_state.ndim < 2 or hand_state.shape[-2] != len(SIDES):
            raise ValueError(f"hand_state: expected (..., 2, 109), got {tuple(hand_state.shape)}")
        lib = namespace(hand_state)
        hands = [
            self._joints_and_tips(hand_state[..., i, :], SIDES[i], shape_space, check)
            for i in (LEFT, RIGHT)
        ]
        return lib.stack(hands, -3)[..., list(KEYPOINT_FROM_JOINT), :]

    def joints(
        self,
        hand_state: Array,
        side: Side,
        shape_space: ShapeSpace | None = None,
        check: bool = True,
    ) -> Array:
        """Compute one side's 16 joints, MANO's order: (..., 109) -> (..., 16, 3), metres."""
        return self._joints_and_tips(hand_state, side, shape_space, check)[..., :16, :]

    def vertices(
        self,
        hand_state: Array,
        side: Side,
        shape_space: ShapeSpace | None = None,
        check: bool = True,
    ) -> Array:
        """Compute one side's meshes: (..., 109) -> (..., V, 3), metres, frame of the state."""
        pose = self._pose(hand_state, side, shape_space, check)
        rest = pose.rest_points("vertices")
        return pose.place(pose.skin(rest, "vertices"))

    def rest_joints(self, shape_params: Array, side: Side) -> Array:
        """Joints of the flat hand in the model's own frame: (..., 10) -> (..., 16, 3), metres.

        The first is J0, the rest wrist: a MANO ``transl`` is a state's translation minus J0.
        """
        asset = self._asset(side).on(shape_params)
        offsets = (shape_params @ asset["joint_shape"]).reshape((*shape_params.shape[:-1], 16, 3))
        return asset["joint_template"] + offsets

    def _joints_and_tips(
        self, hand_state: Array, side: Side, shape_space: ShapeSpace | None, check: bool
    ) -> Array:
        pose = self._pose(hand_state, side, shape_space, check)
        tips = pose.skin(pose.rest_points("tips"), "tips")
        return pose.place(namespace(hand_state).concatenate([pose.positions, tips], -2))

    def _asset(self, side: Side) -> HandAsset:
        if side not in SIDES:
            raise ValueError(f"side: expected 'left' or 'right', got {side!r}")
        return self.left if side == "left" else self.right

    def _pose(
        self, hand_state: Array, side: Side, shape_space: ShapeSpace | None, check: bool
    ) -> _Pose:
        """Forward kinematics, with all leading dimensions flattened to one."""
        asset = self._asset(side)
        leading = tuple(hand_state.shape[:-1])
        state = unpack(hand_state.reshape((-1, hand_state.shape[-1])))
        shape_params = state.shape_params
        if shape_space is not None and shape_space != self.shape_space:
            self._warn_mean_shape(shape_space)
            shape_params = shape_params * 0
        joint_rotations = state.joint_rotations(side, check=check)
        rest = self.rest_joints(shape_params, side)
        rotations, positions = chain(state.orientation(check=check), joint_rotations, rest)
        return _Pose(
            asset.on(hand_state),
            leading,
            state.translation,
            shape_params,
            joint_rotations,
            rest,
            rotations,
            positions,
        )

    def _warn_mean_shape(self, shape_space: ShapeSpace) -> None:
        if shape_space in self._warned:
            return
        self._warned.add(shape_space)
        warnings.warn(
            f"shape numbers of the {shape_space!r} space mean nothing to the hand model "
            f"{self.name!r} ({self.shape_space!r}): its mean shape is used",
            stacklevel=5,
        )


@dataclass(frozen=True)
class _Pose:
    """N posed skeletons of one side, the wrist at the origin, and what their skinning needs."""

    asset: dict[str, Any]
    leading: tuple[int, ...]
    translation: Array  # (N, 3)
    shape_params: Array  # (N, 10)
    joint_rotations: Array  # (N, 15, 3, 3) of this side
    rest: Array  # (N, 16, 3)
    rotations: Array  # (N, 16, 3, 3) frame of the state from each joint
    positions: Array  # (N, 16, 3) relative to the wrist

    def rest_points(self, which: str) -> Array:
        """Shaped and pose-corrected points of the flat hand, (N, P, 3); SMPL eq. 2-5."""
        count = len(self.shape_params)
        template = self.asset[f"{which}_template"]
        flat = self.shape_params @ self.asset[f"{which}_shape"]
        pose_directions = self.asset[f"{which}_pose"]
        if pose_directions is not None:
            lib = namespace(self.joint_rotations)
            like = self.joint_rotations
            eye = lib.eye(3, dtype=like.dtype, device=like.device)
            flat = flat + (like - eye).reshape((count, -1)) @ pose_directions
        return template + flat.reshape((count, len(template), 3))

    def skin(self, points: Array, which: str) -> Array:
        """Blend the joints' rigid motions over ``points`` (N, P, 3); SMPL eq. 6-7."""
        lib = namespace(points)
        shifts = self.positions - (self.rotations * self.rest[..., None, :]).sum(-1)
        motions = lib.concatenate([self.rotations, shifts[..., None]], -1)  # (N, 16, 3, 4)
        blended = self.asset[f"{which}_weights"] @ motions.reshape((len(points), -1, 12))
        blended = blended.reshape((*points.shape[:2], 3, 4))
        return (blended[..., :3] * points[..., None, :]).sum(-1) + blended[..., 3]

    def place(self, points: Array) -> Array:
        """Put the wrist at the translation and give the leading dimensions back."""
        placed = points + self.translation[:, None]
        return placed.reshape((*self.leading, *points.shape[1:]))


def chain(orientation: Array, joint_rotations: Array, rest_joints: Array) -> tuple[Array, Array]:
    """Forward kinematics down the tree of 16 joints, a finger's joints of equal depth at a time.

    Args:
        orientation: (..., 3, 3) wrist rotation.
        joint_rotations: (..., 15, 3, 3) parent-relative rotations of the hand itself (a left hand's
            already unmirrored).
        rest_joints: (..., 16, 3) joints of the flat hand; joint frames are the identity there.

    Returns:
        Rotations (..., 16, 3, 3) and positions (..., 16, 3), the wrist at the origin.

    """
    lib = namespace(orientation, joint_rotations, rest_joints)
    rotations = [orientation[..., None, :, :]]
    positions = [0 * rest_joints[..., :1, :]]
    order = [0]
    for level in _tree_levels():
        parents = [order.index(JOINT_PARENTS[j]) for j in level]
        known_rotations = lib.concatenate(rotations, -3)[..., parents, :, :]
        known_positions = lib.concatenate(positions, -2)[..., parents, :]
        bones = rest_joints[..., level, :] - rest_joints[..., [JOINT_PARENTS[j] for j in level], :]
        own = joint_rotations[..., [j - 1 for j in level], :, :]
        rotations.append(known_rotations @ own)
        positions.append(known_positions + (known_rotations * bones[..., None, :]).sum(-1))
        order += level
    back = [order.index(j) for j in range(len(order))]
    return (
        lib.concatenate(rotations, -3)[..., back, :, :],
        lib.concatenate(positions, -2)[..., back, :],
    )


@cache
def _tree_levels() -> tuple[list[int], ...]:
    levels: list[list[int]] = [[0]]
    while sum(map(len, levels)) < len(JOINT_PARENTS):
        levels.append([j for j, parent in enumerate(JOINT_PARENTS) if parent in levels[-1]])
    return tuple(levels[1:])


@cache
def _template() -> HandModel:
    right = load_hand_asset(read_asset(TEMPLATE_FILE))
    return HandModel("mint-hand-template-1", "mint", mirrored_asset(right), right)


def _mano_asset(tensors: ManoTensors, faces: np.ndarray) -> HandAsset:
    return HandAsset(
        template=tensors["v_template"],
        shape_directions=tensors["shapedirs"],
        pose_directions=tensors["posedirs"],
        joint_regressor=tensors["J_regressor"],
        skin_weights=tensors["weights"],
        faces=closed_mesh(faces),
        tip_vertices=np.array(MANO_FINGERTIP_VERTICES),
    )
