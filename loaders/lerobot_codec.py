"""From the columns of a LeRobot dialect to the arrays of an Episode, and back.

Pure arrays: files are read in ``lerobot_read`` and written in ``lerobot_write``.
"""

from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mint_hub.conventions import SIDES
from mint_hub.geometry import camera_state, rigid
from mint_hub.geometry import hand_state as hands
from mint_hub.geometry.rotations import continuous_quat_xyzw, matrix_to_rot6d_rows
from mint_hub.loaders.actions import matrix_to_euler_xyz
from mint_hub.loaders.lerobot_columns import Dialect, LeRobotError
from mint_hub.loaders.schema import Episode

Arrays = dict[str, Any]
"""Numpy arrays by name."""

UNIT_TOLERANCE: Final = 1e-3
"""How far a stored quaternion or rotation may be from a unit one: above: something else."""

HAND_SHAPE_IN_STATE: Final = (slice(51, 61), slice(112, 122))
"""Where ``observation.state`` (122 = two hands of wrist 3 + 3, joints 45, shape 10) has shapes."""


def decode(dialect: Dialect, columns: Mapping[str, NDArray[Any]]) -> Arrays:
    """Turn the label columns (T, width) of one episode into an Episode's four arrays.

    Absent hands become ``hand_state.absent``, whatever the source filled in for them.

    Returns:
        T_camera_from_world (T, 4, 4) float64, fov_vh_rad (T, 2) float32, hand_state (T, 2, 109)
        float32 in the camera frame, presence (T, 2) bool.

    Raises:
        LeRobotError: names the column, what was expected, what came, and the frame.

    """
    return _decode_camera(columns) if dialect == "camera" else _decode_world(columns)


def _decode_camera(columns: Mapping[str, NDArray[Any]]) -> Arrays:
    quat = columns["cam_quat"].astype(np.float64)
    length = np.linalg.norm(quat, axis=-1)
    _require("cam_quat", np.abs(length - 1) <= UNIT_TOLERANCE, "unit quaternions", length)
    trans, fov = columns["cam_trans"].astype(np.float64), columns["cam_fov"]
    _require("cam_trans", np.isfinite(trans).all(-1), "finite numbers", trans)
    camera = camera_state.CameraState(trans, quat, fov)
    presence = columns["hand_kept"]
    state = np.empty((len(quat), len(SIDES), hands.HAND_STATE_SIZE), np.float32)
    for hand, side in enumerate(SIDES):
        for name, where in _CAMERA_PARTS.items():
            state[:, hand, where] = columns[f"{side}_mano_{name}"]
    state[~presence] = hands.absent()
    return {
        "T_camera_from_world": camera.T_camera_from_world(),
        "fov_vh_rad": fov,
        "hand_state": state,
        "presence": presence,
    }


_CAMERA_PARTS: Final = {
    "transl_cam": hands.TRANSLATION,
    "orient6d": hands.ORIENTATION,
    "pose6d": hands.JOINT_ROTATIONS,
    "betas": hands.SHAPE,
}
"""Where each column of a hand lies in its state."""


def _decode_world(columns: Mapping[str, NDArray[Any]]) -> Arrays:
    T = columns["extrinsics_w2c"].reshape(-1, 4, 4).copy()
    last = np.abs(T[:, 3] - (0, 0, 0, 1)).max(-1)
    _require("extrinsics_w2c", last <= UNIT_TOLERANCE, "a last row of 0 0 0 1", T[:, 3])
    T[:, 3] = (0, 0, 0, 1)
    everywhere = np.ones(len(T), bool)
    _require_rotations("extrinsics_w2c", T[:, :3, :3], everywhere)
    _require("extrinsics_w2c", np.isfinite(T).all((-1, -2)), "finite numbers", T[:, :3, 3])
    presence = np.stack([columns[f"{side}_kept"].reshape(-1) for side in SIDES], axis=-1)
    states = [_hand_from_world(columns, hand, T, presence[:, hand]) for hand in range(len(SIDES))]
    return {
        "T_camera_from_world": T,
        "fov_vh_rad": columns["fov"][:, ::-1].astype(np.float32),
        "hand_state": np.stack(states, axis=1),
        "presence": presence,
    }


def _hand_from_world(
    columns: Mapping[str, NDArray[Any]],
    hand: int,
    T: NDArray[np.float64],
    present: NDArray[np.bool_],
) -> NDArray[np.float32]:
    """Hand state (T, 109) in the camera frame; absent where not ``present``."""
    side, num_frames = SIDES[hand], len(present)
    orient = columns[f"{side}_orient_world"].reshape(num_frames, 3, 3)
    joints = columns[f"{side}_hand_pose"].reshape(num_frames, hands.NUM_JOINT_ROTATIONS, 3, 3)
    _require_rotations(f"{side}_orient_world", orient, present)
    _require_rotations(f"{side}_hand_pose", joints, present)
    world = rigid.rigid(
        np.where(present[:, None, None], orient, np.eye(3)),
        np.where(present[:, None], columns[f"{side}_transl_world"], 0.0),
    )
    wrist = T @ world
    shape = np.zeros((num_frames, hands.NUM_SHAPE_PARAMS))
    if "observation.state" in columns:
        shape = columns["observation.state"][:, HAND_SHAPE_IN_STATE[hand]]
    state = hands.HandState(
        translation=wrist[:, :3, 3],
        orientation_rot6d_rows=matrix_to_rot6d_rows(wrist[:, :3, :3]),
        joint_rot6d_rows=matrix_to_rot6d_rows(joints),
        shape_params=shape,
    ).pack()
    return np.where(present[:, None], state, hands.absent()).astype(np.float32)


def _require(name: str, good: Any, expected: str, got: NDArray[Any]) -> None:
    if not good.all():
        frame = int(np.flatnonzero(~good)[0])
        raise LeRobotError(
            f"{name}: expected {expected}, got {got[frame].tolist()} at frame {frame}"
        )


def _require_rotations(name: str, matrices: NDArray[Any], where: NDArray[np.bool_]) -> None:
    """Refuse what is no rotation in frames ``where``; ``matrices`` (T, ..., 3, 3)."""
    stacked = matrices.reshape(len(matrices), -1, 3, 3)
    R = np.where(where[:, None, None, None], stacked, np.eye(3))
    x, y, z = R[..., 0, :], R[..., 1, :], R[..., 2, :]
    dots = ((x * x).sum(-1) - 1, (y * y).sum(-1) - 1, (x * y).sum(-1))
    errors = [np.abs(z - np.cross(x, y)).max((-1, -2)), *(np.abs(dot).max(-1) for dot in dots)]
    good = np.maximum.reduce(errors) <= UNIT_TOLERANCE
    _require(name, good, "rotation matrices, row by row", R[:, 0])


def encode(dialect: Dialect, episode: Episode) -> Arrays:
    """Label columns (T, width) of an episode: ``decode`` gives its arrays back.

    Quaternions start with w >= 0 and keep one sign along the episode. An absent hand is written as
    ``hand_state.absent``; in "world", ``observation.state`` of an absent hand is zero.
    """
    return _encode_camera(episode) if dialect == "camera" else _encode_world(episode)


def _encode_camera(episode: Episode) -> Arrays:
    camera = camera_state.from_matrices(episode.T_camera_from_world, episode.fov_vh_rad)
    columns: Arrays = {
        "hand_kept": episode.presence,
        "cam_trans": camera.translation,
        "cam_quat": continuous_quat_xyzw(camera.quat_xyzw),
        "cam_fov": episode.fov_vh_rad,
    }
    kept = np.where(episode.presence[..., None], episode.hand_state, hands.absent())
    for hand, side in enumerate(SIDES):
        state = hands.unpack(kept[:, hand])
        columns[f"{side}_mano_transl_cam"] = state.translation
        columns[f"{side}_mano_orient6d"] = state.orientation_rot6d_rows
        columns[f"{side}_mano_pose6d"] = state.joint_rot6d_rows.reshape(len(kept), -1)
        columns[f"{side}_mano_betas"] = state.shape_params
    return columns


def _encode_world(episode: Episode) -> Arrays:
    num_frames = episode.num_frames
    columns: Arrays = {
        "fov": episode.fov_vh_rad[:, ::-1],
        "intrinsics": episode.K.reshape(num_frames, 9),
        "extrinsics_w2c": episode.T_camera_from_world.reshape(num_frames, 16),
        "observation.state": _state_122(episode),
    }
    world = np.where(episode.presence[..., None, None], episode.wrist_world(), np.eye(4))
    kept = np.where(episode.presence[..., None], episode.hand_state, hands.absent())
    joints = hands.unpack(kept.astype(np.float64)).joint_rotations()
    for hand, side in enumerate(SIDES):
        columns[f"{side}_transl_world"] = world[:, hand, :3, 3]
        columns[f"{side}_orient_world"] = world[:, hand, :3, :3].reshape(num_frames, 9)
        columns[f"{side}_hand_pose"] = joints[:, hand].reshape(num_frames, -1)
        columns[f"{side}_kept"] = episode.presence[:, hand, None]
    return columns


def _state_122(episode: Episode) -> NDArray[np.float64]:
    """``observation.state`` (T, 122): wrist in the camera, extrinsic xyz angles, shape; a hand."""
    state = hands.unpack(episode.hand_state.astype(np.float64))
    R = np.concatenate([state.orientation()[..., None, :, :], state.joint_rotations()], axis=-3)
    angles = matrix_to_euler_xyz(R).reshape(episode.num_frames, len(SIDES), -1)
    both = np.concatenate([state.translation, angles, state.shape_params], axis=-1)
    return np.where(episode.presence[..., None], both, 0.0).reshape(episode.num_frames, -1)
