"""The anatomy of the licence-free hand: measured bones, and the flesh modelled around them.

Millimetres, right hand, its own straight axes: the forearm along x, fingers along -x, palm facing
-y, thumb towards +z. `REST_TURN` leads from them to the axes in which the template rests. The
measurements and their sources are named in :mod:`mint_hub.synth.make_hand`.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.interpolate import PchipInterpolator

from mint_hub.conventions import Side
from mint_hub.geometry.rotations import rotvec_to_matrix
from mint_hub.synth.hand_surface import round_cone, smooth_min

REST_TURN_DEG: Final = (-2.0, -9.5, 3.5)
"""How the template rests, from the straight axes: a rotation vector about the wrist, degrees.

MANO's resting hand lies turned in its own axes, towards the little finger. Measured: VITRA's
annotation of an Ego4D clip gives joints, wrist and joint rotations of a MANO right hand, which
leave constant bones; they put the knuckles of index, middle, ring and little finger at about
(-92, -5, 22), (-99, -1, -3), (-85, -4, -28) and (-72, -11, -46) mm from the wrist. Laid on the
directions of those four, the straight hand turns by about (-3, -8.5, 3) degrees; fitted to the
annotated joints, where fingers and thumb count too, by about (-1, -10, 4). This is the middle.
"""

REST_TURN: Final = np.asarray(rotvec_to_matrix(np.deg2rad(REST_TURN_DEG)), np.float64)
"""R_rest_from_straight (3, 3) of a right hand."""


def straight_axes(side: Side) -> np.ndarray:
    """R_rest_from_straight (3, 3) of either hand.

    Columns are where the forearm of a right hand (the fingers of a left one), the back of the hand
    and the side of the thumb lie in the axes of a hand state.
    """
    mirror = np.diag([-1.0 if side == "left" else 1.0, 1.0, 1.0])
    return mirror @ REST_TURN @ mirror


FINGERS: Final = ("index", "middle", "pinky", "ring", "thumb")
"""In the order of conventions.JOINT_NAMES."""

BONES_MM: Final[dict[str, tuple[float, float, float]]] = {
    "index": (39.78, 22.38, 15.82 + 3.84),
    "middle": (44.63, 26.33, 17.40 + 3.95),
    "ring": (41.37, 25.65, 17.30 + 3.95),
    "pinky": (32.74, 18.11, 15.96 + 3.73),
    "thumb": (46.22, 31.57, 21.67 + 5.67),
}
"""The three bones after each finger's three joints, the last one with the flesh of the tip."""

BONE_SD_MM: Final[dict[str, tuple[float, float, float]]] = {
    "index": (4.94, 2.51, 2.26),
    "middle": (3.81, 3.00, 1.85),
    "ring": (3.87, 3.29, 2.22),
    "pinky": (2.77, 2.54, 2.45),
    "thumb": (3.94, 3.13, 1.60),
}
"""Standard deviations of those bones among adults, the same table."""

ROOT_MM: Final[dict[str, tuple[float, float, float]]] = {
    "index": (-90.0, -0.5, 27.0),
    "middle": (-91.5, 2.0, 7.5),
    "ring": (-86.0, 0.5, -11.0),
    "pinky": (-76.5, -3.5, -27.5),
    "thumb": (-20.0, -8.0, 22.0),
}
"""First joint of each finger: knuckles, and the base of the thumb."""

CARPAL_MM: Final[dict[str, tuple[float, float, float]]] = {
    "index": (-22.0, -3.0, 12.0),
    "middle": (-22.0, -1.5, 4.0),
    "ring": (-22.0, -2.0, -5.0),
    "pinky": (-22.0, -3.5, -12.0),
    "thumb": (-14.0, -5.0, 14.0),
}
"""Where each metacarpal leaves the carpus (for the thumb: a point behind its base)."""

SPLAY_DEG: Final = {"index": 9.5, "middle": 1.5, "ring": -7.0, "pinky": -17.0}
"""Direction of the straight fingers in the palm's plane, from -x towards +z."""

THUMB_DIRECTIONS: Final = ((-0.775, -0.26, 0.575), (-0.845, -0.17, 0.505))
"""Of the thumb's metacarpal, and of its two straight phalanges."""

THUMB_PALMAR: Final = (-0.20, -0.72, -0.66)
"""Where the pad of the thumb faces."""

RADII_MM: Final = {
    "index": (9.7, 8.2),
    "middle": (9.8, 8.3),
    "ring": (9.2, 7.8),
    "pinky": (8.2, 7.1),
    "thumb": (11.0, 10.0),
}
"""Mean radius at the middle and last joint (thumb: at its last joint and at the pad)."""


@dataclass(frozen=True)
class Finger:
    """A finger's joints and tip (4, 3), its straight axis, where its back faces, its radii."""

    joints: np.ndarray
    axis: np.ndarray
    dorsal: np.ndarray
    radii: tuple[float, float]

    @property
    def lateral(self) -> np.ndarray:
        """Across the finger, in the plane of its nail."""
        return np.cross(self.axis, self.dorsal)


def fingers() -> dict[str, Finger]:
    """Place the five fingers of the mean hand, straight, millimetres."""
    made: dict[str, Finger] = {}
    for name in FINGERS:
        if name == "thumb":
            first, second = (np.array(d) / np.linalg.norm(d) for d in THUMB_DIRECTIONS)
            directions, dorsal = (first, second, second), -np.array(THUMB_PALMAR)
        else:
            angle = np.deg2rad(SPLAY_DEG[name])
            axis = np.array([-np.cos(angle), 0.0, np.sin(angle)])
            directions, dorsal = (axis, axis, axis), np.array([0.0, 1.0, 0.0])
        steps = [d * length for d, length in zip(directions, BONES_MM[name], strict=True)]
        joints = np.array(ROOT_MM[name]) + np.concatenate([np.zeros((1, 3)), np.cumsum(steps, 0)])
        dorsal = dorsal - (dorsal @ directions[2]) * directions[2]
        made[name] = Finger(joints, directions[2], dorsal / np.linalg.norm(dorsal), RADII_MM[name])
    return made


def hand_distance(points: np.ndarray, hand: dict[str, Finger]) -> np.ndarray:
    """Signed distance of the straight hand, millimetres, (N, 3) -> (N,)."""
    digits = np.full(len(points), 1e3)
    for name in ("index", "middle", "ring", "pinky"):
        digits = smooth_min(digits, finger_distance(points, hand[name], 0), 1.2)
    whole = smooth_min(palm_distance(points, hand), digits, 7.0)
    return smooth_min(whole, thumb_distance(points, hand), 9.0)


def finger_distance(points: np.ndarray, finger: Finger, straight_from: int) -> np.ndarray:
    """Model a straight finger: a rod of varying radius, flat at the nail, round at the tip."""
    root, axis = finger.joints[straight_from], finger.axis
    ends = np.linalg.norm(finger.joints[straight_from:] - root, axis=1)
    length, middle, last = ends[-1], ends[-3], ends[-2]
    r_middle, r_last = finger.radii
    cap = 1.15 * r_last
    if straight_from:
        stops = [0.0, 0.5 * last, last, last + 0.45 * (length - last), length - cap]
        sizes = [r_middle * 1.0, r_middle * 0.94, r_middle, r_last * 1.04, r_last * 0.97]
    else:
        stops = [-6.0, 0.5 * middle, middle, (middle + last) / 2, last, length - cap]
        mean = (r_middle + r_last) / 2
        sizes = [r_middle * 1.04, r_middle * 0.96, r_middle, mean * 0.955, r_last, r_last * 0.95]
    radius = PchipInterpolator(stops, sizes)
    offset = points - root
    along, side, back = offset @ axis, offset @ finger.lateral, offset @ finger.dorsal
    beyond = np.clip((along - last) / (length - last), 0.0, 1.0)
    back = back + 0.9 * beyond
    back = back / np.where(back > 0, 0.95 - 0.13 * beyond, 0.96)
    over_tip = np.maximum(along - stops[-1], 0.0) * (sizes[-1] / cap)
    before = np.maximum(stops[0] - along, 0.0)
    across = np.sqrt(side**2 + back**2 + over_tip**2 + before**2)
    return across - radius(np.clip(along, stops[0], stops[-1]))


def thumb_distance(points: np.ndarray, hand: dict[str, Finger]) -> np.ndarray:
    """Model the thumb with the ball of the thumb and the web to the index finger."""
    thumb, index = hand["thumb"], hand["index"]
    base, knuckle = thumb.joints[0], thumb.joints[1]
    carpal = np.array(CARPAL_MM["thumb"])
    made = finger_distance(points, thumb, 1)
    metacarpal = round_cone(points, carpal, knuckle, (13.0, 11.2))
    made = smooth_min(made, metacarpal, 5.0)
    ball = round_cone(
        points,
        base + np.array([2.0, -4.0, -8.0]),
        knuckle + np.array([8.0, -3.0, -11.0]),
        (11.0, 9.0),
    )
    made = smooth_min(made, ball, 9.0)
    inner = np.array(CARPAL_MM["index"])
    web = round_cone(
        points,
        base + 0.72 * (knuckle - base) + np.array([0.0, 1.0, -4.0]),
        inner + 0.62 * (index.joints[0] - inner) + np.array([0.0, -2.0, 4.0]),
        (6.5, 8.0),
    )
    return smooth_min(made, web, 10.0)


def palm_distance(points: np.ndarray, hand: dict[str, Finger]) -> np.ndarray:
    """Model metacarpals, muscle masses, webs between the fingers, and the stump of the forearm."""
    up = np.array([0.0, 1.0, 0.0])
    heads = {"index": 11.6, "middle": 12.0, "ring": 11.5, "pinky": 10.6}
    made = np.full(len(points), 1e3)
    for name, head in heads.items():
        bone = round_cone(
            points, np.array(CARPAL_MM[name]), hand[name].joints[0], (9.0, head), up, 0.98
        )
        made = smooth_min(made, bone, 9.0)
    masses = [
        ((-14.0, -6.0, -17.0), (-58.0, -7.0, -28.0), (12.0, 10.0)),  # ball of the little finger
        ((-80.0, -6.5, 22.0), (-70.0, -8.0, -23.0), (8.5, 8.0)),  # pads below the fingers
    ]
    for start, end, radii in masses:
        made = smooth_min(made, round_cone(points, np.array(start), np.array(end), radii), 9.0)
    order = ("index", "middle", "ring", "pinky")
    for one, other in itertools.pairwise(order):
        a, b = hand[one].joints, hand[other].joints
        lower = np.array([0.0, -2.5, 0.0])
        start, end = a[0] + 0.24 * (a[1] - a[0]), b[0] + 0.24 * (b[1] - b[0])
        web = round_cone(points, start + lower, end + lower, (5.0, 5.0))
        made = smooth_min(made, web, 6.0)
    return smooth_min(made, wrist_distance(points), 24.0)


def wrist_distance(points: np.ndarray) -> np.ndarray:
    """Model the end of the forearm: an elliptic cylinder, rounded where it is cut."""
    x, y, z = points[:, 0], points[:, 1], points[:, 2]
    half_width = 26.5 + 0.06 * np.clip(x + 10, 0, 50)
    scaled = np.sqrt((z / half_width) ** 2 + ((y + 1.0) / 18.5) ** 2 + 1e-9)
    slope = np.sqrt((z / half_width**2) ** 2 + ((y + 1.0) / 18.5**2) ** 2 + 1e-9)
    wall = np.minimum(scaled * (scaled - 1) / slope, 60.0)
    cut = x - 30.0
    inner_end = -x - 30.0
    return -smooth_min(-wall, -np.maximum(cut, inner_end), 8.0)
