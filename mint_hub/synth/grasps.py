"""Fingers close on a thing: a hand's pose that touches a surface without going into it.

A grasp begins as a named posture laid against the thing (`aligned`, `laid`), and is then fitted by
Levenberg-Marquardt over the wrist and all 21 joint angles: chosen pads on the surface, no point of
the hand inside the thing or below what the thing stands on, angles near the posture and within
their limits. Metres and degrees; the thing's own frame, z up.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mint_hub.conventions import Side
from mint_hub.geometry.rigid import rigid
from mint_hub.geometry.rotations import rotvec_to_matrix
from mint_hub.synth.hand_anatomy import straight_axes
from mint_hub.synth.hand_pose import DIGITS, LIMITS_DEG, NUM_ANGLES, POSTURES, HandProxy
from mint_hub.synth.solids import Solid

__all__ = ["CONTACTS", "Grasp", "aligned", "fit", "hand_axes", "opposed", "posture_for"]

Floats = NDArray[np.float64]

CONTACTS: Final[dict[str, tuple[str, ...]]] = {
    "wrap": ("index", "middle", "ring", "pinky", "thumb", "palm"),
    "pinch": ("index", "middle", "thumb"),
    "claw": ("index", "middle", "ring", "thumb"),
    "flat": ("index", "middle", "ring", "pinky"),
    "clamp": ("index", "middle", "ring", "pinky", "palm"),
    "point": ("index",),
}
"""Which parts of the hand touch the thing, by the style of a grasp."""

_OPEN: Final = {"wrap": ("cylinder", "wide"), "pinch": ("pinch", "wide"), "claw": ("pinch", "wide")}
_OPPOSED: Final = {
    "wrap": ("index", "middle", "ring"),
    "pinch": ("index", "middle"),
    "claw": ("index", "middle", "ring"),
}

_PRIOR_DEG: Final = np.array([*((28.0, 30.0, 20.0, 5.0) * 4), 18.0, 18.0, 9.0, 18.0, 22.0])
_WRIST_PRIOR: Final = np.array([*(np.deg2rad([14.0] * 3)), *([0.022] * 3)])
_CONTACT_M: Final = 0.0012
_FLUSH_M: Final = 0.008
_INSIDE_M: Final = 0.0008
_BELOW_M: Final = 0.0015
_TOUCH_M: Final = 0.0004
_ABOVE_M: Final = 0.0025
_SCALE: Final = np.array([*([0.01] * 3), *([0.001] * 3), *([1.0] * NUM_ANGLES)])


@dataclass(frozen=True, eq=False)
class Grasp:
    """How one hand holds one thing.

    Attributes:
        style: key of CONTACTS.
        side: which hand.
        T_thing_from_wrist: (4, 4).
        angles_deg: (21,).
        gap_m: largest distance of a contact from the surface.
        depth_m: how deep the deepest point is inside the thing, or below its support.

    """

    style: str
    side: Side
    T_thing_from_wrist: Floats
    angles_deg: Floats
    gap_m: float
    depth_m: float

    @property
    def retreat(self) -> Floats:
        """Direction, in the thing's frame, in which the opened hand leaves."""
        R = self.T_thing_from_wrist[:3, :3] @ straight_axes(self.side)
        fingers = -R[:, 0] if self.side == "right" else R[:, 0]
        palm = -R[:, 1]
        way = {"wrap": -fingers - 0.35 * palm, "clamp": -palm, "flat": -palm, "point": -palm}
        out = way.get(self.style, -fingers - 0.8 * palm)
        return out / np.linalg.norm(out)

    @property
    def opened_deg(self) -> Floats:
        """Angles (21,) of the hand just before it closes, and just after it opens."""
        wide = POSTURES["palm" if self.style in ("flat", "clamp") else "wide"]
        share = {"point": 0.0, "wrap": 0.72, "clamp": 0.5, "flat": 0.5}.get(self.style, 0.45)
        return self.angles_deg + share * (wide - self.angles_deg)

    @property
    def good(self) -> bool:
        """Whether it touches where it should and goes in nowhere."""
        return self.gap_m < 0.005 and self.depth_m < 0.0035

    @property
    def badness(self) -> float:
        """Metres by which it misses and goes in; what to compare grasps by."""
        return self.gap_m + 2 * self.depth_m


def hand_axes(side: Side, fingers: Floats, palm: Floats) -> Floats:
    """Wrist rotation (3, 3) whose fingers point along ``fingers`` and whose palm faces ``palm``."""
    ahead = np.asarray(fingers, float) / np.linalg.norm(fingers)
    x = -ahead if side == "right" else ahead
    y = -np.asarray(palm, float)
    y = y - (y @ x) * x
    y /= np.linalg.norm(y)
    return np.stack([x, y, np.cross(x, y)], -1) @ straight_axes(side).T


def posture_for(proxy: HandProxy, style: str, width_m: float) -> Floats:
    """Angles (21,) of a style, opened so that a thing of this width fits between the pads."""
    if style not in _OPEN:
        return POSTURES[{"flat": "palm", "clamp": "palm", "point": "point"}[style]]
    closed, wide = (POSTURES[name] for name in _OPEN[style])
    family = closed + np.linspace(0, 1, 17)[:, None] * (wide - closed)
    thumb, fingers = _pads(proxy, proxy.points(family), style)
    opening = np.linalg.norm(fingers - thumb, axis=-1)
    return family[int(np.abs(opening - width_m - 0.012).argmin())]


def _pads(proxy: HandProxy, points: Floats, style: str) -> tuple[Floats, Floats]:
    """Middle of the thumb's pad and of the opposed fingers' pads, (N, 3) each."""
    centres = {name: points[:, pad].mean(1) for name, pad in zip(DIGITS, proxy.pads, strict=True)}
    return centres["thumb"], np.mean([centres[name] for name in _OPPOSED[style]], axis=0)


def opposed(proxy: HandProxy, side: Side, style: str, angles_deg: Floats) -> tuple[Floats, Floats]:
    """Middle of the thumb's pad and of the pads it opposes, (3,) each, in the wrist's frame."""
    thumb, fingers = _pads(proxy, proxy.points(angles_deg[None], side), style)
    return thumb[0], fingers[0]


def aligned(pads: tuple[Floats, Floats], at: Floats, across: Floats, approach: Floats) -> Floats:
    """Lay an opposing posture around a point: T_thing_from_wrist (4, 4).

    Args:
        pads: of the posture, from `opposed`.
        at: (3,) point of the thing that comes between thumb and fingers.
        across: (3,) direction from the thumb to the fingers.
        approach: (3,) direction in which the hand comes, perpendicular to ``across`` or made so.

    """
    thumb, fingers = pads
    middle = (thumb + fingers) / 2
    own = _frame(fingers - thumb, middle)
    R = _frame(across, approach) @ own.T
    return np.asarray(rigid(R, np.asarray(at, float) - R @ middle))


def _frame(first: Floats, second: Floats) -> Floats:
    a = first / np.linalg.norm(first)
    b = second - (second @ a) * a
    b /= np.linalg.norm(b)
    return np.stack([a, b, np.cross(a, b)], -1)


def fit(
    proxy: HandProxy,
    side: Side,
    style: str,
    solid: Solid,
    T_thing_from_wrist: Floats,
    angles_deg: Floats,
    floor_z: float = 0.0,
    iterations: int = 24,
) -> Grasp:
    """Close a hand on a solid, beginning at a wrist pose and a posture.

    Args:
        proxy: the hand.
        side: which hand.
        style: key of CONTACTS.
        solid: the thing.
        T_thing_from_wrist: (4, 4) where the hand begins.
        angles_deg: (21,) the posture it keeps near to.
        floor_z: height, in the thing's frame, of what it stands on.
        iterations: of Levenberg-Marquardt.

    """
    problem = _Problem(proxy, side, style, solid, T_thing_from_wrist, angles_deg, floor_z)
    q = np.zeros(6 + NUM_ANGLES)
    damping, value = 1e-2, problem.residuals(q[None])[0]
    for _ in range(iterations):
        J = problem.slope(q)
        H, g = J.T @ J, J.T @ value
        tries = damping * np.array([0.1, 1.0, 10.0, 100.0])
        moves = np.stack([-np.linalg.solve(H + m * np.diag(1e-3 + H.diagonal()), g) for m in tries])
        options = problem.clipped(q + moves * _SCALE)
        results = problem.residuals(options)
        best = int((results**2).sum(1).argmin())
        gain = (value**2).sum() - (results[best] ** 2).sum()
        damping = float(np.clip(tries[best], 1e-5, 1e3))
        if gain <= 0:
            break
        q, value = options[best], results[best]
        if gain < 3e-4 * (value**2).sum():
            break
    return problem.grasp(q)


class _Problem:
    """Residuals of many candidate hands at once."""

    def __init__(
        self,
        proxy: HandProxy,
        side: Side,
        style: str,
        solid: Solid,
        T: Floats,
        angles: Floats,
        floor_z: float,
    ) -> None:
        self.proxy, self.style, self.solid = proxy, style, solid
        self.side: Side = side
        self.T, self.angles, self.floor_z = T, angles, floor_z
        groups = {**dict(zip(DIGITS, proxy.pads, strict=True)), "palm": proxy.palm}
        self.contacts = [groups[name] for name in CONTACTS[style]]
        self.weight = 0.35 if style == "clamp" else 1.0

    def clipped(self, q: Floats) -> Floats:
        """Keep angles within their limits."""
        angles = np.clip(self.angles + q[:, 6:], LIMITS_DEG[:, 0], LIMITS_DEG[:, 1])
        return np.concatenate([q[:, :6], angles - self.angles], 1)

    def wrist(self, q: Floats) -> Floats:
        """T_thing_from_wrist (N, 4, 4)."""
        R = rotvec_to_matrix(q[:, :3]) @ self.T[:3, :3]
        return np.asarray(rigid(R, self.T[:3, 3] + q[:, 3:6]))

    def points(self, q: Floats) -> Floats:
        """Points of the hand in the thing's frame, (N, P, 3)."""
        return self.proxy.placed(self.wrist(q), self.angles + q[:, 6:], self.side)

    def residuals(self, q: Floats) -> Floats:
        """(N, 27) -> (N, R): contacts, flush pads, what is inside, what is below, the prior."""
        points = self.points(q)
        distance = self.solid.distance(points)
        near = np.stack([distance[:, group].min(1) for group in self.contacts], 1)
        flush = np.stack([distance[:, group].mean(1) for group in self.contacts], 1)
        inside = np.maximum(0, -distance - _TOUCH_M) / _INSIDE_M
        below = np.maximum(0, self.floor_z + _ABOVE_M - points[..., 2]) / _BELOW_M
        prior = [q[:, :6] / _WRIST_PRIOR, q[:, 6:] / _PRIOR_DEG]
        return np.concatenate(
            [self.weight * near / _CONTACT_M, flush / _FLUSH_M, inside, below, *prior], 1
        )

    def slope(self, q: Floats) -> Floats:
        """Derivatives (R, 27) of the residuals by the scaled parameters."""
        points = self.points(np.concatenate([q[None], q + np.diag(_SCALE)]))
        here, moved = points[0], points[1:] - points[0]
        shifts = 1e-5 * np.concatenate([np.zeros((1, 3)), np.eye(3)])
        samples = self.solid.distance(here + shifts[:, None])
        distance, normal = samples[0], (samples[1:] - samples[0]).T / 1e-5
        by_distance = (moved * normal).sum(-1)  # (27, P)
        near = [by_distance[:, group[distance[group].argmin()]] for group in self.contacts]
        flush = [by_distance[:, group].mean(1) for group in self.contacts]
        inside = -by_distance * (-distance > _TOUCH_M) / _INSIDE_M
        below = -moved[..., 2] * (here[:, 2] < self.floor_z + _ABOVE_M) / _BELOW_M
        prior = np.diag(_SCALE / np.concatenate([_WRIST_PRIOR, _PRIOR_DEG]))
        contact = self.weight * np.stack(near) / _CONTACT_M
        return np.concatenate([contact, np.stack(flush) / _FLUSH_M, inside.T, below.T, prior])

    def grasp(self, q: Floats) -> Grasp:
        """Finish: the grasp and how well it holds."""
        points = self.points(q[None])[0]
        distance = self.solid.distance(points)
        gaps = [float(distance[group].min()) for group in self.contacts]
        needed = gaps[:-1] if self.style in ("wrap", "clamp") else gaps
        depth = max(float(-distance.min()), float(self.floor_z - points[:, 2].min()), 0.0)
        return Grasp(
            self.style,
            self.side,
            self.wrist(q[None])[0],
            self.angles + q[6:],
            float(np.sort(needed)[-2 if len(needed) > 3 else -1]),
            depth,
        )
