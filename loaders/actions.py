"""Action chunks for robot learning, in VITRA's definition, and back from actions to poses.

Letters in shapes: N chunks, L steps a chunk (16), 2 hands (left, right).

A hand's action has 51 numbers: wrist step 3 (metres), wrist rotation step 3 and finger joints
15 x 3, as Euler angles (radians). A chunk that starts at frame s lives in the camera of frame s:
with p_k, R_k a wrist's place and rotation at frame s + k, in that camera, action k is

    wrist step       p_{k+1} - p_k         "anchor": p_{k+1} - p_0
    rotation step    R_{k+1} R_k^T         "anchor": R_{k+1} R_0^T
    fingers          F_{k+1}               "relative" fingers: F_{k+1} F_k^T, or F_{k+1} F_0^T

Euler angles are extrinsic "xyz": R = Rz(c) Ry(b) Rx(a) is written (a, b, c). Finger rotations are
those of ``geometry.hand_state``: relative to the parent joint, a left hand's as its mirror image's,
which is how VITRA stores them too. Both hands are 102 numbers. The state of a chunk has 61 a hand:
wrist 3 and 3, fingers 45, shape 10, at frame s.

A step counts (mask true) where the hand is present at both its ends ("anchor": at frame s and at
k + 1) and k + 1 is a frame of the episode. Hence the last frame has no action; VITRA's own code
marks a zero step as valid there. What does not count is zero.

``action_dataset`` gives them to a torch training loop, with pictures and text.

Source: VITRA (arXiv 2510.21571) and its released code.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import DTypeLike, NDArray

from mint_hub.conventions import SIDES
from mint_hub.geometry import hand_state as hands
from mint_hub.loaders.schema import Episode

Float = NDArray[np.float64]
Relative = Literal["step", "anchor"]
Fingers = Literal["absolute", "relative"]

NUM_FINGER_ANGLES: Final = 3 * hands.NUM_JOINT_ROTATIONS
HAND_ACTION_SIZE: Final = 6 + NUM_FINGER_ANGLES
ACTION_SIZE: Final = len(SIDES) * HAND_ACTION_SIZE
HAND_STATE_SIZE: Final = HAND_ACTION_SIZE + hands.NUM_SHAPE_PARAMS
STATE_SIZE: Final = len(SIDES) * HAND_STATE_SIZE
PADDED_ACTION_SIZE: Final = 192
PADDED_STATE_SIZE: Final = PADDED_ACTION_SIZE + len(SIDES) * hands.NUM_SHAPE_PARAMS
CHUNK_LENGTH: Final = 16
DEFINITIONS: Final[tuple[tuple[Relative, Fingers], ...]] = (
    ("step", "absolute"),
    ("anchor", "absolute"),
    ("step", "relative"),
    ("anchor", "relative"),
)
"""What an action may be; the first is VITRA's."""

GIMBAL_COSINE: Final = 1e-7
"""Cosine of the middle angle below which the first and third turn about one axis: the third is
then 0."""


@dataclass(frozen=True, eq=False)
class ActionChunks:
    """Actions of N chunks, each in the camera frame of its own first frame.

    Attributes:
        action: (N, L, 102), left hand first; zero where the mask is false.
        mask: (N, L, 2) bool, which steps count.
        state: (N, 122) what each chunk starts from; zero for an absent hand.
        state_mask: (N, 2) bool, which hands are present at the start.
        relative: "step" or "anchor".
        fingers: "absolute" or "relative".

    """

    action: NDArray[Any]
    mask: NDArray[np.bool_]
    state: NDArray[Any]
    state_mask: NDArray[np.bool_]
    relative: Relative = "step"
    fingers: Fingers = "absolute"

    def __len__(self) -> int:
        """N."""
        return len(self.action)


def action_chunks(
    episode: Episode,
    starts: Sequence[int] | NDArray[np.integer[Any]] | None = None,
    *,
    length: int = CHUNK_LENGTH,
    relative: Relative = "step",
    fingers: Fingers = "absolute",
    dtype: DTypeLike = np.float32,
) -> ActionChunks:
    """Action chunks of an episode.

    Args:
        episode: its camera and hands.
        starts: (N,) first frames; every frame when None. Chunks may run past the end: those steps
            are masked.
        length: L, steps a chunk.
        relative: steps from frame to frame, or "anchor": from the chunk's first frame.
        fingers: finger joints at k + 1, or "relative": their turn since k (or since the anchor).
        dtype: of the result; everything is computed in float64.

    Raises:
        ValueError: a start outside the episode, length < 1, or an unknown word.

    """
    last = episode.num_frames - 1
    first = np.arange(last + 1) if starts is None else np.asarray(starts)
    if first.ndim != 1 or not np.issubdtype(first.dtype, np.integer):
        raise ValueError(f"starts: expected whole numbers (N,), got {first.dtype} {first.shape}")
    if ((first < 0) | (first > last)).any():
        bad = int(first[(first < 0) | (first > last)][0])
        raise ValueError(
            f"starts: expected 0 <= start <= {last}, got {bad} (episode {episode.key})"
        )
    if length < 1:
        raise ValueError(f"length: expected at least 1, got {length}")
    wanted = first[:, None] + np.arange(length + 1)
    frames = _Frames.of(episode.T_camera_from_world, episode.hand_state, episode.presence)
    return _chunks(frames, wanted.clip(max=last), wanted <= last, relative, fingers, dtype)


def window_actions(
    T_camera_from_world: NDArray[Any],
    hand_state: NDArray[Any],
    presence: NDArray[np.bool_],
    *,
    relative: Relative = "step",
    fingers: Fingers = "absolute",
    dtype: DTypeLike = np.float32,
) -> ActionChunks:
    """One chunk for each of N windows of L + 1 frames, as a reader's random windows give them.

    Args:
        T_camera_from_world: (N, L + 1, 4, 4), metres.
        hand_state: (N, L + 1, 2, 109), camera frame.
        presence: (N, L + 1, 2) bool.
        relative: see ``action_chunks``.
        fingers: see ``action_chunks``.
        dtype: of the result.

    Raises:
        ValueError: shapes that disagree, or windows of fewer than 2 frames.

    """
    flat, index = _window_frames(T_camera_from_world, hand_state, presence)
    return _chunks(flat, index, np.ones(index.shape, bool), relative, fingers, dtype)


def window_definitions(
    T_camera_from_world: NDArray[Any],
    hand_state: NDArray[Any],
    presence: NDArray[np.bool_],
    *,
    dtype: DTypeLike = np.float32,
) -> dict[tuple[Relative, Fingers], ActionChunks]:
    """Return what ``window_actions`` returns in each of DEFINITIONS, computed together."""
    flat, index = _window_frames(T_camera_from_world, hand_state, presence)
    inside = np.ones(index.shape, bool)
    return {d: _chunks(flat, index, inside, *d, dtype) for d in DEFINITIONS}


def _window_frames(
    T_camera_from_world: NDArray[Any], hand_state: NDArray[Any], presence: NDArray[np.bool_]
) -> "tuple[_Frames, NDArray[np.int64]]":
    """The frames of all windows, and which of them each window (N, L + 1) is."""
    count, frames = presence.shape[:2] if presence.ndim == 3 else (0, 0)
    for name, array, tail in (
        ("T_camera_from_world", T_camera_from_world, (4, 4)),
        ("hand_state", hand_state, (2, hands.HAND_STATE_SIZE)),
        ("presence", presence, (2,)),
    ):
        if array.shape != (count, frames, *tail) or frames < 2:
            tail_text = ", ".join(map(str, tail))
            raise ValueError(f"{name}: expected (N, L + 1 >= 2, {tail_text}), got {array.shape}")
    flat = _Frames.of(
        T_camera_from_world.reshape(-1, 4, 4),
        hand_state.reshape(-1, 2, hands.HAND_STATE_SIZE),
        presence.reshape(-1, 2),
    )
    return flat, np.arange(count * frames).reshape(count, frames)


@dataclass(frozen=True, eq=False)
class ChunkPoses:
    """Hands along N chunks, frames 0 .. L, in the camera frame of each chunk's first frame.

    Attributes:
        hand_state: (N, L + 1, 2, 109); ``hand_state.absent`` where not known.
        known: (N, L + 1, 2) bool: whether the steps up to this frame all count.

    """

    hand_state: Float
    known: NDArray[np.bool_]


def integrate(chunks: ActionChunks) -> ChunkPoses:
    """Follow the actions from the state: the inverse of ``action_chunks``, to rounding.

    Raises:
        ValueError: arrays of other shapes than ``ActionChunks`` says.

    """
    count, length = _checked_lengths(chunks)
    anchored, absolute = chunks.relative == "anchor", chunks.fingers == "absolute"
    action = chunks.action.astype(np.float64).reshape(count, length, 2, HAND_ACTION_SIZE)
    state = chunks.state.astype(np.float64).reshape(count, 2, HAND_STATE_SIZE)
    step_turn = euler_xyz_to_matrix(action[..., 3:6])
    finger_turn = euler_xyz_to_matrix(_joint_angles(action[..., 6:]))
    place, turn = [state[..., :3]], [euler_xyz_to_matrix(state[..., 3:6])]
    joints = [euler_xyz_to_matrix(_joint_angles(state[..., 6:HAND_ACTION_SIZE]))]
    known = [chunks.state_mask]
    for k in range(length):
        base = 0 if anchored else k
        place.append(place[base] + action[:, k, :, :3])
        turn.append(step_turn[:, k] @ turn[base])
        joints.append(finger_turn[:, k] if absolute else finger_turn[:, k] @ joints[base])
        known.append(known[base] & chunks.mask[:, k])
    shape = np.broadcast_to(
        state[:, None, :, HAND_ACTION_SIZE:], (count, length + 1, 2, hands.NUM_SHAPE_PARAMS)
    )
    packed = hands.HandState.from_matrices(
        np.stack(place, 1), np.stack(turn, 1), np.stack(joints, 1), shape
    ).pack()
    mask = np.stack(known, 1)
    absent = hands.absent(mask.shape, like=np.asarray(packed))
    return ChunkPoses(np.where(mask[..., None], packed, absent), mask)


def pad_action(
    action: NDArray[Any], mask: NDArray[np.bool_]
) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    """Pad actions (..., 102) and masks (..., 2) to VITRA's (..., 192), the mask one a number."""
    padded = np.zeros((*action.shape[:-1], PADDED_ACTION_SIZE), action.dtype)
    padded_mask = np.zeros(padded.shape, bool)
    padded_mask[..., :ACTION_SIZE] = np.repeat(mask, HAND_ACTION_SIZE, axis=-1)
    padded[..., :ACTION_SIZE] = np.where(padded_mask[..., :ACTION_SIZE], action, 0)
    return padded, padded_mask


def pad_state(
    state: NDArray[Any], mask: NDArray[np.bool_], *, with_shape: bool = False
) -> tuple[NDArray[Any], NDArray[np.bool_]]:
    """Pad states (..., 122) and masks (..., 2) to VITRA's (..., 212), the mask one a number.

    Poses come first, left then right, like an action's; the last 20 places are for the shapes,
    left then right. VITRA's code leaves those empty: ``with_shape`` fills them.
    """
    each = state.reshape(*state.shape[:-1], 2, HAND_STATE_SIZE)
    pose = each[..., :HAND_ACTION_SIZE].reshape(*state.shape[:-1], ACTION_SIZE)
    padded = np.zeros((*state.shape[:-1], PADDED_STATE_SIZE), state.dtype)
    padded_mask = np.zeros(padded.shape, bool)
    padded[..., :PADDED_ACTION_SIZE], padded_mask[..., :PADDED_ACTION_SIZE] = pad_action(pose, mask)
    if with_shape:
        shape = each[..., HAND_ACTION_SIZE:].reshape(*state.shape[:-1], -1)
        shape_mask = np.repeat(mask, hands.NUM_SHAPE_PARAMS, axis=-1)
        padded[..., PADDED_ACTION_SIZE:] = np.where(shape_mask, shape, 0)
        padded_mask[..., PADDED_ACTION_SIZE:] = shape_mask
    return padded, padded_mask


def matrix_to_euler_xyz(R: NDArray[Any]) -> NDArray[Any]:
    """Extrinsic "xyz" angles (..., 3), radians, of rotations (..., 3, 3): R = Rz(c) Ry(b) Rx(a).

    b lies in [-pi/2, pi/2]. Where cos b is 0, only a turn of a and c together is determined: c is
    then 0.
    """
    cosine = np.hypot(R[..., 0, 0], R[..., 1, 0])
    locked = cosine < GIMBAL_COSINE
    a = np.arctan2(R[..., 2, 1], R[..., 2, 2])
    b = np.arctan2(-R[..., 2, 0], cosine)
    c = np.arctan2(R[..., 1, 0], R[..., 0, 0])
    if locked.any():
        a = np.where(locked, np.arctan2(-R[..., 1, 2], R[..., 1, 1]), a)
        c = np.where(locked, 0.0, c)
    return np.stack([a, b, c], axis=-1)


def euler_xyz_to_matrix(angles: NDArray[Any]) -> NDArray[Any]:
    """Rotations (..., 3, 3) of extrinsic "xyz" angles (..., 3), radians."""
    (ca, cb, cc), (sa, sb, sc) = (np.moveaxis(f(angles), -1, 0) for f in (np.cos, np.sin))
    rows = (
        (cc * cb, cc * sb * sa - sc * ca, cc * sb * ca + sc * sa),
        (sc * cb, sc * sb * sa + cc * ca, sc * sb * ca - cc * sa),
        (-sb, cb * sa, cb * ca),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


@dataclass(frozen=True, eq=False)
class _Frames:
    """F frames, in the world where they have a place: what chunks are gathered from."""

    T_camera_from_world: Float  # (F, 4, 4)
    place: Float  # (F, 2, 3) world
    turn: Float  # (F, 2, 3, 3) world from wrist
    joints: Float  # (F, 2, 15, 3, 3) as stored
    shape: Float  # (F, 2, 10)
    presence: NDArray[np.bool_]  # (F, 2)

    @cached_property
    def angles(self) -> Float:
        """Finger angles (F, 2, 45)."""
        return _finger_angles(self.joints)

    @classmethod
    def of(
        cls, T_camera_from_world: NDArray[Any], hand_state: NDArray[Any], presence: NDArray[Any]
    ) -> "_Frames":
        T = np.asarray(T_camera_from_world, np.float64)
        back = T[:, None, :3, :3].swapaxes(-1, -2)  # world from camera
        state = hands.unpack(np.asarray(hand_state, np.float64))
        place = (back @ (state.translation - T[:, None, :3, 3])[..., None])[..., 0]
        turn = back @ state.orientation()
        joints, shape = np.asarray(state.joint_rotations()), np.asarray(state.shape_params)
        return cls(T, place, turn, joints, shape, presence)


def _chunks(
    frames: _Frames,
    index: NDArray[np.integer[Any]],
    inside: NDArray[np.bool_],
    relative: Relative,
    fingers: Fingers,
    dtype: DTypeLike,
) -> ActionChunks:
    """Chunks of the frames ``index`` (N, L + 1), where ``inside`` says which of them exist."""
    if relative not in ("step", "anchor") or fingers not in ("absolute", "relative"):
        raise ValueError(
            "relative, fingers: expected 'step' or 'anchor' and 'absolute' or 'relative', got "
            f"{relative!r} and {fingers!r}"
        )
    first, after = index[:, 0], index[:, 1:]
    before = index[:, :-1] if relative == "step" else np.repeat(first[:, None], after.shape[1], 1)
    camera = frames.T_camera_from_world[first]
    R = camera[:, None, None, :3, :3]
    step = (R @ (frames.place[after] - frames.place[before])[..., None])[..., 0]
    turn = frames.turn[after] @ frames.turn[before].swapaxes(-1, -2)
    if fingers == "absolute":
        angles = frames.angles[after]
    else:
        turned = frames.joints[after] @ frames.joints[before].swapaxes(-1, -2)
        angles = _finger_angles(turned)
    turn_angles = matrix_to_euler_xyz(R @ turn @ R.swapaxes(-1, -2))
    action = np.concatenate([step, turn_angles, angles], axis=-1)
    mask = frames.presence[before] & frames.presence[after] & inside[:, 1:, None]
    action = np.where(mask[..., None], action, 0.0)
    state_mask = frames.presence[first]
    state = np.concatenate(
        [
            (camera[:, None, :3, :3] @ frames.place[first][..., None])[..., 0]
            + camera[:, None, :3, 3],
            matrix_to_euler_xyz(camera[:, None, :3, :3] @ frames.turn[first]),
            frames.angles[first],
            frames.shape[first],
        ],
        axis=-1,
    )
    state = np.where(state_mask[..., None], state, 0.0)
    return ActionChunks(
        action.reshape(*after.shape, ACTION_SIZE).astype(dtype),
        mask,
        state.reshape(len(first), STATE_SIZE).astype(dtype),
        state_mask,
        relative,
        fingers,
    )


def _finger_angles(joints: NDArray[Any]) -> NDArray[Any]:
    """Euler angles (..., 45) of joint rotations (..., 15, 3, 3)."""
    angles = matrix_to_euler_xyz(joints)
    return angles.reshape(*angles.shape[:-2], NUM_FINGER_ANGLES)


def _joint_angles(fingers: NDArray[Any]) -> NDArray[Any]:
    """(..., 45) as (..., 15, 3)."""
    return fingers.reshape(*fingers.shape[:-1], hands.NUM_JOINT_ROTATIONS, 3)


def _checked_lengths(chunks: ActionChunks) -> tuple[int, int]:
    """Return (N, L) of chunks whose shapes agree."""
    count, length = chunks.action.shape[:2] if chunks.action.ndim == 3 else (0, 0)
    for name, expected in (
        ("action", (count, length, ACTION_SIZE)),
        ("mask", (count, length, 2)),
        ("state", (count, STATE_SIZE)),
        ("state_mask", (count, 2)),
    ):
        if (got := getattr(chunks, name).shape) != expected:
            raise ValueError(f"{name}: expected {expected} beside action, got {got}")
    return count, length
