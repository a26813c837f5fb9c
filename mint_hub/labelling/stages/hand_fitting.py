"""Hands from landmarks: wrist pose and 21 joint angles by batched damped least squares.

Each hand is fitted by itself, all at once: Levenberg-Marquardt (Marquardt 1963) with a damping of
its own on two kinds of evidence, the landmarks in the image and the directions of the bones in the
detector's own 3-D landmarks, under soft joint limits. Bone lengths are fixed, so apparent size
tells depth, as far as the person's hand is as large as the model's. The noise of both kinds is
estimated hand by hand, so good landmarks are followed closely and bad ones leave more to the prior.

Letters in shapes: N hands, 21 landmarks in OpenPose order, B bones. Left hands are mirrored across
the camera's x and fitted as right ones.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mint_hub.geometry.rotations import matrix_to_rotvec, nearest_rotation, skew
from mint_hub.labelling.stages.hand_evidence import BONES, Evidence, Pose
from mint_hub.labelling.stages.hand_skeleton import flexion_axes
from mint_hub.labelling.stages.hand_skeleton import pose as bend
from mint_hub.synth.hand_pose import LIMITS_DEG, NUM_ANGLES, POSTURES

Floats = NDArray[np.float64]
Bool = NDArray[np.bool_]

NEAR_M: Final = 0.02
"""No point of a hand is nearer to the camera plane."""

PALM: Final = (0, 1, 5, 9, 13, 17)
"""Keypoints that move with the wrist alone."""

_FINGERS: Final = ((5, 6, 7), (9, 10, 11), (17, 18, 19), (13, 14, 15))
"""Bones of index, middle, pinky and ring finger, root to tip, as numbers in BONES."""

_SIZE: Final = 6 + NUM_ANGLES
_POSTURE: Final = np.asarray(np.deg2rad(POSTURES["relaxed"]), np.float64)
_LOW, _HIGH = np.deg2rad(LIMITS_DEG).T


@dataclass(frozen=True)
class FittingSettings:
    """How hands are fitted.

    Attributes:
        noise_floor: noise is not believed to be smaller than this share of what it was before.
        posture_deg: standard deviation of an angle from the relaxed hand.
        limit_deg: standard deviation of an angle beyond its limit.
        robust_sigmas: residuals beyond so many standard deviations weigh less (Cauchy).
        iterations: steps at most, before and again after the noise is estimated.
        tolerance: a step that lowers the cost by less than this share is the last.

    """

    noise_floor: float = 0.1
    posture_deg: float = 60.0
    limit_deg: float = 6.0
    robust_sigmas: float = 2.5
    iterations: int = 15
    tolerance: float = 1e-4


@dataclass(frozen=True, eq=False)
class Fit:
    """N fitted hands.

    Attributes:
        pose: where they are.
        points: (N, 21, 3) keypoints in the camera frame, metres.
        cost: (N,) what is left of the sum of squares, in units of the noise first believed.
        seen_residual: (N,) weighted mean distance from ``seen``, on the plane at depth 1.
        direction_residual: (N,) mean angle between directions, radians; NaN where there are none.

    """

    pose: Pose
    points: Floats
    cost: Floats
    seen_residual: Floats
    direction_residual: Floats


def fit_hands(evidence: Evidence, settings: FittingSettings, start: Pose | None = None) -> Fit:
    """Fit every hand by itself.

    Args:
        evidence: of N hands, each with some landmark of weight above 0.
        settings: noise, priors and steps.
        start: where to begin; without it, from the palm's turn in the 3-D landmarks.

    """
    found = _descend(start or first_guess(evidence), evidence, settings)
    measured = _with_measured_noise(evidence, found, settings)
    found = _descend(found, measured, settings)
    bent = bend(found.angles, evidence.rest, with_jacobian=False)
    points = _placed(found, bent.points)
    cost = _normal_equations(found, evidence, settings, with_jacobian=False)[0]
    off, turn = _misses(found, evidence)
    weight = evidence.weight
    seen_residual = (np.linalg.norm(off, axis=-1) * weight).sum(1) / weight.sum(1)
    chord = np.clip(np.linalg.norm(turn, axis=-1) / 2, 0, 1)
    bones = evidence.bone_weight
    angle = (2 * np.arcsin(chord) * bones).sum(1) / np.where(bones.any(1), bones.sum(1), np.nan)
    return Fit(found, points, cost, seen_residual, angle)


def first_guess(evidence: Evidence) -> Pose:
    """Turn hands by the palm's bones, bend fingers by their own, place them by least squares."""
    count = len(evidence.seen)
    angles = np.tile(_POSTURE, (count, 1))
    points = bend(angles, evidence.rest, with_jacobian=False).points
    bones = points[:, BONES[:, 1]] - points[:, BONES[:, 0]]
    palm = np.isin(BONES, PALM).all(1)
    outer = np.swapaxes(evidence.directions[:, palm], 1, 2) @ bones[:, palm]
    rotation = nearest_rotation(outer + 1e-9 * np.eye(3), check=False)
    angles[:, :16] = _bent_as_seen(evidence.directions @ rotation, bones, evidence.bone_weight)
    points = bend(angles, evidence.rest, with_jacobian=False).points
    return Pose(rotation, placed_by_size(points @ np.swapaxes(rotation, 1, 2), evidence), angles)


def _bent_as_seen(own: Floats, bones: Floats, known: Floats) -> Floats:
    """Flexions of four fingers from bone directions (N, B, 3) in the wrist's frame: (N, 16).

    Relaxed where a finger has no directions, and in spread. ``bones`` are the relaxed hand's.
    """
    angles = np.tile(_POSTURE[:16], (len(own), 1)).reshape(-1, 4, 4)
    for number, finger in enumerate(_FINGERS):
        axis = flexion_axes()[number]
        first = bones[:, finger[:1]]  # (N, 1, 3), already bent by the posture's first angle
        ahead = (first * own[:, finger]).sum(-1)
        inward = (np.cross(axis, first) * own[:, finger]).sum(-1)
        bent = np.arctan2(inward, ahead) + angles[:, number, :1]
        turn = np.diff(bent, axis=1, prepend=0.0)
        turn = (turn + np.pi) % (2 * np.pi) - np.pi
        seen = known[:, finger].all(1)
        angles[seen, number, :3] = turn[seen]
    flat = angles.reshape(-1, 16)
    return np.asarray(np.clip(flat, _LOW[:16], _HIGH[:16]), np.float64)


def placed_by_size(points: Floats, evidence: Evidence) -> Floats:
    """Translation that puts points (N, 21, 3) onto their sight lines, (N, 3), in front.

    x - u z = 0 and y - v z = 0 for every point are linear in the translation.
    """
    seen, weight = evidence.seen, evidence.weight
    count = len(points)
    rows = np.zeros((count, 21, 2, 3))
    rows[..., :2] = np.eye(2)
    rows[..., 2] = -seen
    right = seen * points[..., 2:] - points[..., :2]
    rows = (rows * weight[..., None, None]).reshape(count, -1, 3)
    normal = np.swapaxes(rows, 1, 2) @ rows + 1e-9 * np.eye(3)
    moved = np.swapaxes(rows, 1, 2) @ (right * weight[..., None]).reshape(count, -1, 1)
    found = np.asarray(np.linalg.solve(normal, moved)[..., 0], np.float64)
    nearest = 2 * NEAR_M - points[..., 2].min(1)
    behind = found[:, 2] < nearest
    depth = np.where(behind, np.maximum(0.4, nearest), found[:, 2])
    middle = (seen * weight[..., None]).sum(1) / weight.sum(1)[:, None]
    found[behind, :2] = (middle * depth[:, None])[behind]
    found[:, 2] = depth
    return found


def _descend(found: Pose, evidence: Evidence, settings: FittingSettings) -> Pose:
    """Go downhill until no hand gains any more."""
    damping = np.full(len(found.angles), 1e-2)
    going = np.arange(len(found.angles))
    scale = np.eye(_SIZE)
    for _ in range(settings.iterations):
        now, known = found[going], evidence[going]
        cost, curvature, slope = _normal_equations(now, known, settings)
        diagonal = np.diagonal(curvature, axis1=1, axis2=2)
        damped = curvature + (damping[going, None] * diagonal + 1e-9)[:, None] * scale
        step = -np.linalg.solve(damped, slope[..., None])[..., 0]
        there = now.moved(np.clip(step, -0.7, 0.7).astype(np.float64))
        after = _normal_equations(there, known, settings, with_jacobian=False)[0]
        better = after < cost
        found = found.updated(going[better], there[better])
        damping[going] = np.where(better, damping[going] * 0.2, damping[going] * 8.0)
        done = better & (cost - after < settings.tolerance * cost) | (damping[going] > 1e6)
        going = going[~done]
        if not len(going):
            break
    return found


def _with_measured_noise(evidence: Evidence, found: Pose, settings: FittingSettings) -> Evidence:
    """Lower both noises to what the fit leaves over, by medians, as far as the floor allows."""
    off, turn = _misses(found, evidence)

    def spread(miss: Floats, weight: Floats, size: int, before: Floats) -> Floats:
        squares = np.where(weight > 0, (miss**2).sum(-1) / size, np.nan)
        known = np.isfinite(squares).any(1)
        squares[~known] = 1.0
        # Of unit variance, the median of squares averaged over two axes is .69, over three .79.
        measured = np.sqrt(np.nanmedian(squares, axis=1) / (0.69 if size == 2 else 0.79))
        return np.where(known, np.clip(measured, settings.noise_floor * before, before), before)

    return replace(
        evidence,
        seen_noise=spread(off, evidence.weight, 2, evidence.seen_noise),
        direction_noise=spread(turn, evidence.bone_weight, 3, evidence.direction_noise),
    )


def _misses(found: Pose, evidence: Evidence) -> tuple[Floats, Floats]:
    """Fitted minus seen landmarks (N, 21, 2), and directions (N, B, 3) in the wrist's frame."""
    bent = bend(found.angles, evidence.rest, with_jacobian=False)
    points = _placed(found, bent.points)
    bones = bent.points[:, BONES[:, 1]] - bent.points[:, BONES[:, 0]]
    bones /= np.linalg.norm(bones, axis=-1, keepdims=True)
    own = evidence.directions @ found.rotation
    turn = (bones - own) * evidence.bone_weight[..., None]
    return points[..., :2] / np.maximum(points[..., 2:], NEAR_M) - evidence.seen, turn


def _placed(found: Pose, points: Floats) -> Floats:
    return points @ np.swapaxes(found.rotation, 1, 2) + found.translation[:, None]


def _normal_equations(
    found: Pose, evidence: Evidence, settings: FittingSettings, with_jacobian: bool = True
) -> tuple[Floats, Floats, Floats]:
    """Cost (N,), approximate curvature (N, 27, 27) and half slope (N, 27) at a pose."""
    count = len(found.angles)
    bent = bend(found.angles, evidence.rest, with_jacobian)
    cost, curvature, slope = _prior(found, evidence, settings)
    for residual, jacobian in (
        _image_rows(found, evidence, bent.points, bent.jacobian),
        _direction_rows(found, evidence, bent.points, bent.jacobian),
    ):
        square = (residual**2).sum(-1)
        most = settings.robust_sigmas**2
        cost = cost + most * np.log1p(square / most).sum(1)
        if jacobian is not None:
            weight = 1 / (1 + square / most)
            rows = jacobian.reshape(count, -1, _SIZE)
            weighed = np.swapaxes((jacobian * weight[..., None, None]).reshape(rows.shape), 1, 2)
            curvature = curvature + weighed @ rows
            slope = slope + (weighed @ residual.reshape(count, -1, 1))[..., 0]
    points = _placed(found, bent.points)
    cost = np.where((points[..., 2] > NEAR_M).all(1), cost, np.inf)
    return cost, curvature, slope


def _image_rows(
    found: Pose, evidence: Evidence, local: Floats, bending: Floats | None
) -> tuple[Floats, Floats | None]:
    """Landmarks in the image: residuals (N, 21, 2), slopes (N, 21, 2, 27), in sigmas."""
    points = _placed(found, local)
    depth = np.maximum(points[..., 2:], NEAR_M)
    on_plane = points[..., :2] / depth
    weight = np.sqrt(evidence.weight)[..., None] / evidence.seen_noise[:, None, None]
    residual = (on_plane - evidence.seen) * weight
    if bending is None:
        return residual, None
    motion = np.empty((*points.shape, _SIZE))
    turning: Any = skew(local)
    motion[..., :3] = found.rotation[:, None] @ -turning
    motion[..., 3:6] = np.eye(3)
    motion[..., 6:] = found.rotation[:, None] @ bending
    flat = motion[..., :2, :] - on_plane[..., None] * motion[..., 2:, :]
    return residual, flat * (weight / depth)[..., None]


def _direction_rows(
    found: Pose, evidence: Evidence, local: Floats, bending: Floats | None
) -> tuple[Floats, Floats | None]:
    """Directions of bones in the wrist's frame: residuals (N, B, 3), slopes (N, B, 3, 27)."""
    bones = local[:, BONES[:, 1]] - local[:, BONES[:, 0]]
    length = np.linalg.norm(bones, axis=-1, keepdims=True)
    own = evidence.directions @ found.rotation
    weight = evidence.bone_weight[..., None] / evidence.direction_noise[:, None, None]
    residual = (bones / length - own) * weight
    if bending is None:
        return residual, None
    slopes = np.zeros((*bones.shape, _SIZE))
    turning: Any = skew(own)
    slopes[..., :3] = -turning
    slopes[..., 6:] = (bending[:, BONES[:, 1]] - bending[:, BONES[:, 0]]) / length[..., None]
    return residual, slopes * weight[..., None]


def _prior(
    found: Pose, evidence: Evidence, settings: FittingSettings
) -> tuple[Floats, Floats, Floats]:
    """Posture, joint limits and neighbouring frames: cost, curvature and half slope."""
    count = len(found.angles)
    diagonal = np.zeros((count, _SIZE))
    residual = np.zeros((count, _SIZE))  # times precision
    likely = np.deg2rad(settings.posture_deg) ** -2
    beyond = found.angles - np.clip(found.angles, _LOW, _HIGH)
    limit = np.deg2rad(settings.limit_deg) ** -2
    off = found.angles - _POSTURE
    cost = likely * (off**2).sum(1) + limit * (beyond**2).sum(1)
    diagonal[:, 6:] = likely + limit * (beyond != 0)
    residual[:, 6:] = likely * off + limit * beyond
    if evidence.near is not None and evidence.near_noise is not None:
        turn_p, depth_p, bend_p = (evidence.near_noise**-2).T[..., None]
        turn = matrix_to_rotvec(np.swapaxes(evidence.near.rotation, 1, 2) @ found.rotation)
        depth = np.maximum(found.translation[:, 2:], NEAR_M)
        farther = np.log(depth / evidence.near.translation[:, 2:])
        bent = found.angles - evidence.near.angles
        cost = cost + (turn_p * turn**2).sum(1) + (depth_p * farther**2).sum(1)
        cost = cost + (bend_p * bent**2).sum(1)
        residual[:, :3] += turn_p * turn
        residual[:, 5:6] += depth_p * farther / depth
        residual[:, 6:] += bend_p * bent
        diagonal[:, :3] += turn_p
        diagonal[:, 5:6] += depth_p / depth**2
        diagonal[:, 6:] += bend_p
    return cost, diagonal[..., None] * np.eye(_SIZE), residual
