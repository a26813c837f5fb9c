"""Hands of known pose, and what a detector would say of them."""

import numpy as np

from mint_hub.conventions import LEFT, RIGHT
from mint_hub.geometry.hand_model import HandModel
from mint_hub.geometry.hand_state import HandState, absent
from mint_hub.geometry.rotations import rotvec_to_matrix
from mint_hub.labelling.records import Detections
from mint_hub.labelling.stages.hand_evidence import turn_from_axis
from mint_hub.synth.hand_pose import LIMITS_DEG, POSTURES, joint_rotations

SIZE_HW = (384, 512)
FOCAL = 300.0
K = np.array([[FOCAL, 0, SIZE_HW[1] / 2], [0, FOCAL, SIZE_HW[0] / 2], [0, 0, 1.0]])


def states(rng, hand, spread_m=0.2, depth_m=(0.25, 0.7), angles_deg=None, turn_rad=1.5):
    """Random hand states (N, 109) float64 of hands (N,), in front of the camera."""
    count = len(hand)
    if angles_deg is None:
        names = rng.choice(list(POSTURES), count)
        angles_deg = np.stack([POSTURES[n] for n in names]) + rng.normal(0, 5, (count, 21))
        angles_deg = np.clip(angles_deg, *LIMITS_DEG.T)
    place = np.column_stack(
        [rng.uniform(-spread_m, spread_m, (count, 2)), rng.uniform(*depth_m, count)]
    )
    turn = rotvec_to_matrix(rng.normal(0, turn_rad, (count, 3)))
    rotations = joint_rotations(angles_deg)
    return HandState.from_matrices(place, turn, rotations, np.zeros((count, 10))).pack()


def keypoints(state, hand):
    """Points (N, 21, 3) of states (N, 109) of hands (N,)."""
    both = np.tile(absent((2,)).astype(np.float64), (len(state), 1, 1))
    both[np.arange(len(state)), hand] = state
    return HandModel.template().keypoints(both)[np.arange(len(state)), hand]


def landmarks(points, rng=None, pixels=0.0, metres=0.0):
    """Pixels (N, 21, 2), and metres (N, 21, 3) as if seen on the optical axis, of points."""
    on_plane = points[..., :2] / points[..., 2:]
    uv = on_plane * FOCAL + K[:2, 2]
    local = (points - points.mean(1, keepdims=True)) @ turn_from_axis(on_plane.mean(1))
    if rng is not None:
        uv = uv + rng.normal(0, pixels, uv.shape)
        local = local + rng.normal(0, metres, local.shape)
    return uv, local


def detections(frame, uv, metres, right_score, score=0.9):
    """Make detections of landmarks, in order of frame."""
    order = np.argsort(frame, kind="stable")
    count = len(order)
    with np.errstate(invalid="ignore"):
        box = np.concatenate([uv.min(1), uv.max(1)], -1)
    return Detections(
        frame=np.asarray(frame, np.int32)[order],
        box_xyxy=box[order].astype(np.float32),
        score=np.broadcast_to(np.float32(score), (count,)).copy(),
        right_score=np.asarray(right_score, np.float32)[order],
        landmarks_uv=uv[order].astype(np.float32),
        landmarks_m=metres[order].astype(np.float32),
    )


def both_sides(count):
    """LEFT and RIGHT in turns, (N,)."""
    return np.where(np.arange(count) % 2 == 0, LEFT, RIGHT)
