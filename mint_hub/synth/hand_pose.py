"""A hand by its joint angles: 21 numbers, their limits, named postures, and a light model of both.

Angles are degrees, and the same for a left and a right hand: of index, middle, pinky and ring
finger each the flexion of its three joints and its spread (positive towards the thumb), then the
rotation vector of the base of the thumb (x opposes it to the fingers, -y closes it to the palm) and
the flexion of its other two joints. They turn about the axes of the straight hand
(`hand_anatomy.REST_TURN`). `HandProxy` skins a few hundred points of the hand, many poses
at once, which is what fitting a grasp needs.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mint_hub.conventions import JOINT_NAMES, Side
from mint_hub.geometry.hand_model import HandModel, chain
from mint_hub.geometry.rotations import rotvec_to_matrix
from mint_hub.synth.hand_anatomy import REST_TURN, SPLAY_DEG, THUMB_DIRECTIONS, THUMB_PALMAR

__all__ = [
    "DIGITS",
    "LIMITS_DEG",
    "NUM_ANGLES",
    "POSTURES",
    "HandProxy",
    "joint_rotations",
    "varied",
]

Floats = NDArray[np.float64]

FINGERS: Final = ("index", "middle", "pinky", "ring")
DIGITS: Final = (*FINGERS, "thumb")
NUM_ANGLES: Final = 21

MIRROR: Final = {"left": np.array([-1.0, 1.0, 1.0]), "right": np.ones(3)}
"""A left hand's points are a right hand's with the same angles, mirrored across x."""

_FINGER_LIMITS: Final = ((-12.0, 88.0), (0.0, 106.0), (-4.0, 72.0), (-14.0, 14.0))
_THUMB_LIMITS: Final = ((-12.0, 68.0), (-28.0, 46.0), (-22.0, 24.0), (-8.0, 52.0), (-12.0, 68.0))
LIMITS_DEG: Final = np.array([*(_FINGER_LIMITS * 4), *_THUMB_LIMITS])
"""(21, 2) lowest and highest angle of each."""


def _unit(vector: Any) -> Floats:
    return np.asarray(vector, float) / np.linalg.norm(vector)


def _finger_axis(name: str) -> Floats:
    rest = np.deg2rad(SPLAY_DEG[name])
    return np.array([np.sin(rest), 0.0, np.cos(rest)])


_AXES: Final = np.stack([_finger_axis(name) for name in FINGERS])
_THUMB_BEND: Final = _unit(np.cross(_unit(THUMB_DIRECTIONS[1]), THUMB_PALMAR))


def joint_rotations(angles_deg: Floats) -> Floats:
    """Joint rotations as a hand state stores them, (..., 21) degrees -> (..., 15, 3, 3)."""
    angles = np.deg2rad(np.asarray(angles_deg, float))
    leading = angles.shape[:-1]
    fingers = angles[..., :16].reshape(*leading, 4, 4)
    flexion = rotvec_to_matrix(fingers[..., :3, None] * _AXES[:, None])  # (..., 4, 3, 3, 3)
    turn = fingers[..., 3:] * np.array([0.0, 1.0, 0.0])
    flexion[..., 0, :, :] = rotvec_to_matrix(turn) @ flexion[..., 0, :, :]
    thumb = np.concatenate(
        [angles[..., None, 16:19], angles[..., 19:, None] * _THUMB_BEND], -2
    )  # (..., 3, 3)
    straight = np.concatenate([flexion.reshape(*leading, 12, 3, 3), rotvec_to_matrix(thumb)], -3)
    return REST_TURN @ straight @ REST_TURN.T


def _posture(
    curl: dict[str, tuple[float, float, float]],
    spread: dict[str, float],
    thumb: tuple[float, float, float, float, float],
) -> Floats:
    fingers = [(*curl[name], spread.get(name, 0.0)) for name in FINGERS]
    return np.array([*(a for finger in fingers for a in finger), *thumb])


def _even(
    a: float, b: float, c: float, slope: float = 0.0
) -> dict[str, tuple[float, float, float]]:
    """The same curl everywhere, ``slope`` degrees more from each finger to the next."""
    order = ("index", "middle", "ring", "pinky")
    return {n: (a + slope * i, b + slope * i, c) for i, n in enumerate(order)}


_SPREAD: Final = {"index": 3.0, "ring": -2.0, "pinky": -5.0}

POSTURES: Final[dict[str, Floats]] = {
    "flat": _posture(_even(2, 4, 2), {}, (4, 4, 0, 2, 2)),
    "relaxed": _posture(
        {
            "index": (18, 25, 12),
            "middle": (24, 30, 14),
            "ring": (28, 34, 16),
            "pinky": (30, 34, 18),
        },
        {"index": -4, "ring": 3, "pinky": 7},
        (14, -8, 4, 10, 14),
    ),
    "rest": _posture(
        {"index": (10, 16, 8), "middle": (12, 20, 10), "ring": (13, 22, 10), "pinky": (14, 22, 10)},
        {"index": 2, "ring": -2, "pinky": -4},
        (6, 0, 2, 6, 10),
    ),
    "loose_fist": _posture(_even(50, 62, 34, 3), {"pinky": 8}, (28, -8, 5, 22, 30)),
    "point": _posture(
        {"index": (8, 8, 4), "middle": (62, 84, 50), "ring": (68, 88, 52), "pinky": (70, 88, 52)},
        {"ring": 4, "pinky": 9},
        (30, -8, 5, 24, 40),
    ),
    "cylinder": _posture(_even(28, 34, 20, 2), _SPREAD, (52, 24, 6, 4, 12)),
    "wide": _posture(_even(4, 14, 10), _SPREAD, (40, 36, 6, 0, 4)),
    "pinch": _posture(
        {
            "index": (42, 52, 26),
            "middle": (44, 50, 24),
            "ring": (46, 50, 24),
            "pinky": (48, 48, 22),
        },
        {"index": -1, "pinky": 4},
        (46, 6, 2, 14, 12),
    ),
    "claw": _posture(_even(22, 34, 22, 1), _SPREAD, (50, 30, 4, 4, 10)),
    "palm": _posture(_even(8, 10, 6), {"index": 2, "pinky": -4}, (16, 22, 0, 2, 4)),
    "spread": _posture(_even(-2, 2, 2), {"index": 8, "ring": -6, "pinky": -12}, (4, 20, 0, -4, -6)),
    "hook": _posture(_even(22, 66, 40, 1), {"pinky": 5}, (22, 6, 2, 10, 14)),
}
"""Postures by name, (21,) degrees; each is inside LIMITS_DEG."""


def varied(angles_deg: Floats, rng: np.random.Generator, size: float = 1.0) -> Floats:
    """Change a posture (21,) as people's differ: the whole hand, each finger, each joint a little.

    ``size`` 1: deviations of 12 degrees of curl for the hand, 10 more for each finger, 6 more for
    each of its joints, 4 of spread, 9 of the thumb's joints. The result is inside LIMITS_DEG.
    """
    curl = rng.normal(0, 12) + rng.normal(0, 10, (4, 1)) + rng.normal(0, 6, (4, 3))
    fingers = np.column_stack([curl * (1.0, 1.2, 0.6), rng.normal(0, 4, 4)])
    change = np.concatenate([fingers.ravel(), rng.normal(0, 9, 5) * (1.0, 1.0, 0.5, 1.0, 1.2)])
    return np.clip(angles_deg + size * change, *LIMITS_DEG.T)


@dataclass(frozen=True, eq=False)
class HandProxy:
    """A few hundred points of one subject's hand, skinned in numpy, many poses at a time.

    Attributes:
        rest: (P, 3) points of the flat right hand, metres.
        weights: (P, 16) skin weights.
        rest_joints: (16, 3).
        digit: (P,) number in DIGITS that a point belongs to, -1 for the palm.
        segment: (P,) 0..15, the joint that moves the point most.
        pads: points (indices) of each digit's pad at its tip, in the order of DIGITS.
        shape_params: (10,) of the subject.

    """

    rest: Floats
    weights: Floats
    rest_joints: Floats
    digit: NDArray[np.int64]
    segment: NDArray[np.int64]
    pads: tuple[NDArray[np.int64], ...]
    shape_params: Floats
    palm: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, np.int64))

    @classmethod
    def of(
        cls, shape_params: Floats, model: HandModel | None = None, count: int = 480
    ) -> HandProxy:
        """Choose points all over a subject's hand, and every point of its pads."""
        asset = (model or HandModel.template()).right
        rest = asset.template + asset.shape_directions @ np.asarray(shape_params, float)
        segment = asset.skin_weights.argmax(1)
        straight = asset.template @ REST_TURN
        pads = [_pad(straight, segment, d) for d in range(len(DIGITS))]
        palm = _palm_pad(straight, segment)
        sparser = np.where(segment == 0, 0.4, 1.0)  # the palm needs fewer points than fingers
        chosen = _spread_out(asset.template, np.concatenate([*pads, palm]), count, sparser)
        place = {int(v): i for i, v in enumerate(chosen)}
        return cls(
            rest=rest[chosen],
            weights=asset.skin_weights[chosen].astype(float),
            rest_joints=asset.joint_regressor @ rest,
            digit=np.where(segment[chosen] == 0, -1, (segment[chosen] - 1) // 3),
            segment=segment[chosen],
            pads=tuple(np.array([place[int(v)] for v in pad]) for pad in pads),
            shape_params=np.asarray(shape_params, float),
            palm=np.array([place[int(v)] for v in palm]),
        )

    def points(self, angles_deg: Floats, side: Side = "right") -> Floats:
        """Skin the points in the wrist's frame: (N, 21) degrees -> (N, P, 3) metres."""
        rotations = joint_rotations(angles_deg)
        eye = np.broadcast_to(np.eye(3), (len(rotations), 3, 3))
        turned, joints = chain(eye, rotations, np.broadcast_to(self.rest_joints, (len(eye), 16, 3)))
        shift = joints - (turned @ self.rest_joints[:, :, None])[..., 0]
        motion = np.concatenate([turned, shift[..., None]], -1).reshape(len(eye), 16, 12)
        blended = (self.weights @ motion).reshape(len(eye), -1, 3, 4)
        skinned = (blended[..., :3] @ self.rest[:, :, None])[..., 0] + blended[..., 3]
        return skinned * MIRROR[side]

    def placed(self, T_from_wrist: Floats, angles_deg: Floats, side: Side) -> Floats:
        """Points (N, P, 3) in the frame that ``T_from_wrist`` (N, 4, 4) leads to."""
        points = self.points(angles_deg, side)
        return points @ np.swapaxes(T_from_wrist[:, :3, :3], 1, 2) + T_from_wrist[:, None, :3, 3]


def _pad(template: Floats, segment: NDArray[np.int64], digit: int) -> NDArray[np.int64]:
    """Points on the inner side of a digit's last bone, the half towards the tip."""
    last = JOINT_NAMES.index(f"{DIGITS[digit]}3")
    own = np.flatnonzero(segment == last)
    inward = _unit(THUMB_PALMAR) if DIGITS[digit] == "thumb" else np.array([0.0, -1.0, 0.0])
    axis = _unit(THUMB_DIRECTIONS[1])
    if DIGITS[digit] != "thumb":
        rest = np.deg2rad(SPLAY_DEG[DIGITS[digit]])
        axis = np.array([-np.cos(rest), 0.0, np.sin(rest)])
    inner, along = template[own] @ inward, template[own] @ axis
    low, high = np.quantile(along, (0.30, 0.86))
    good = (inner > np.quantile(inner, 0.62)) & (along > low) & (along < high)
    return own[good][:: max(1, int(good.sum()) // 14)]


def _palm_pad(template: Floats, segment: NDArray[np.int64]) -> NDArray[np.int64]:
    own = np.flatnonzero(segment == 0)
    x, y, z = template[own].T
    inner = (y < np.quantile(y, 0.25)) & (x < -0.035) & (x > -0.085) & (np.abs(z) < 0.025)
    return own[inner][:: max(1, int(inner.sum()) // 12)]


def _spread_out(
    points: Floats, seeds: NDArray[np.int64], count: int, weight: Floats
) -> NDArray[np.int64]:
    """Indices of ``seeds`` and of further points, each the farthest from those before it."""
    chosen = list(dict.fromkeys(int(s) for s in seeds))
    far = weight * np.linalg.norm(points[:, None] - points[chosen], axis=-1).min(1)
    while len(chosen) < count:
        chosen.append(int(far.argmax()))
        far = np.minimum(far, weight * np.linalg.norm(points - points[chosen[-1]], axis=-1))
    return np.array(chosen)
