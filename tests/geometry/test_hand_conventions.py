"""MANO's conventions on a real annotation, without MANO's files.

25 real frames give a right hand's wrist orientation, 15 joint rotations and 21 joints. Chaining the
rotations down the tree makes every joint linear in constant bone offsets, so those are fitted by
least squares; only the right conventions leave a residual of about a millimetre.
"""

from pathlib import Path

import numpy as np
import pytest

from mint_hub.conventions import JOINT_NAMES, JOINT_PARENTS, KEYPOINT_FROM_JOINT
from mint_hub.geometry.hand_model import HandModel, chain
from mint_hub.geometry.hand_state import HandState, mirror_rotations, unpack
from mint_hub.geometry.plain_pickle import load_plain_npy
from mint_hub.geometry.rotations import matrix_to_rotvec, nearest_rotation

LIMIT_M = 0.002
FRAMES = 25
TIP_PARENTS = (15, 3, 6, 12, 9)
KNUCKLES = [JOINT_NAMES.index(f"{name}1") for name in ("index", "middle", "ring", "pinky")]


@pytest.fixture(scope="module")
def right_hand(real_dir: Path) -> dict[str, np.ndarray]:
    (path,) = (real_dir / "ego4d").glob("*.npy")
    hand = load_plain_npy(path)["right"]
    assert hand["kept_frames"].all()
    return hand


def fitted_bones(orientation: np.ndarray, rotations: np.ndarray, keypoints: np.ndarray):
    """Best constant bones (21, 3) to each point from its parent, and mean misses (21,), metres."""
    joints = np.empty_like(keypoints)
    joints[:, list(KEYPOINT_FROM_JOINT)] = keypoints
    rest = np.zeros((16, 3))
    world, _ = chain(orientation, rotations, np.broadcast_to(rest, (len(orientation), 16, 3)))
    parents = (*JOINT_PARENTS, *TIP_PARENTS)
    best, misses = np.zeros((21, 3)), np.zeros(21)
    for j in range(1, 21):
        parent = parents[j]
        bones = np.einsum("tba,tb->ta", world[:, parent], joints[:, j] - joints[:, parent])
        best[j] = bones.mean(0)
        fitted = np.einsum("tab,b->ta", world[:, parent], best[j])
        misses[j] = np.linalg.norm(joints[:, parent] + fitted - joints[:, j], axis=1).mean()
    return best, misses


def bone_fit_residual_m(orientation: np.ndarray, rotations: np.ndarray, keypoints: np.ndarray):
    """Largest per-joint mean distance, over frames, between joints and the best constant bones."""
    return float(fitted_bones(orientation, rotations, keypoints)[1].max())


def test_the_conventions_explain_every_joint(right_hand):
    residual = bone_fit_residual_m(
        right_hand["global_orient_camspace"],
        right_hand["hand_pose"],
        right_hand["joints_camspace"].astype(np.float64),
    )
    assert residual < LIMIT_M


def test_the_template_rests_as_manos_hand_does(right_hand):
    """Fitted bones are the annotated hand at rest; ours lies as it does, though not as large."""
    theirs, _ = fitted_bones(
        right_hand["global_orient_camspace"],
        right_hand["hand_pose"],
        right_hand["joints_camspace"].astype(np.float64),
    )
    ours = HandModel.template().rest_joints(np.zeros(10), "right")
    ours = (ours - ours[0])[KNUCKLES]
    a, b = (v / np.linalg.norm(v, axis=1, keepdims=True) for v in (theirs[KNUCKLES], ours))
    yaw = [np.rad2deg(np.arctan2(v[:, 2], -v[:, 0])) for v in (a, b)]
    assert abs((yaw[1] - yaw[0]).mean()) < 3
    turn = matrix_to_rotvec(nearest_rotation(a.T @ b))
    assert np.rad2deg(np.linalg.norm(turn)) < 3


def test_packing_the_annotation_keeps_them(right_hand):
    """The same through the 109 numbers, whose 6D holds rows, and float32."""
    keypoints = right_hand["joints_camspace"].astype(np.float64)
    packed = HandState.from_matrices(
        keypoints[:, 0],
        right_hand["global_orient_camspace"],
        right_hand["hand_pose"],
        right_hand["beta"],
    ).pack()
    state = unpack(packed.astype(np.float32))
    residual = bone_fit_residual_m(state.orientation(), state.joint_rotations("right"), keypoints)
    assert residual < LIMIT_M


WRONG = {
    "left hand's mirror": lambda o, r: (o, mirror_rotations(r)),
    "joints in OpenPose order": lambda o, r: (
        o,
        r[:, [12, 13, 14, 0, 1, 2, 3, 4, 5, 9, 10, 11, 6, 7, 8]],
    ),
    "ring and pinky exchanged": lambda o, r: (
        o,
        r[:, [0, 1, 2, 3, 4, 5, 9, 10, 11, 6, 7, 8, 12, 13, 14]],
    ),
    "6D rows read as columns": lambda o, r: (o.swapaxes(-1, -2), r.swapaxes(-1, -2)),
    "joint rotations transposed": lambda o, r: (o, r.swapaxes(-1, -2)),
    "orientation transposed": lambda o, r: (o.swapaxes(-1, -2), r),
    "joint rotations not chained": lambda o, r: (o, np.broadcast_to(np.eye(3), r.shape)),
}


@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_convention_fails_the_same_limit(right_hand, name):
    orientation, rotations = WRONG[name](
        right_hand["global_orient_camspace"], right_hand["hand_pose"]
    )
    residual = bone_fit_residual_m(
        orientation, rotations, right_hand["joints_camspace"].astype(np.float64)
    )
    assert residual > LIMIT_M
