"""The person at the table: where head and elbows are, how hands rest, and which grasps are easy.

Workplace frame: origin on the table top in the middle of its near edge, x to the right, y away from
the person, z up, metres.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mint_hub.conventions import SIDES, Side
from mint_hub.geometry.rigid import rigid
from mint_hub.synth.grasps import Grasp, aligned, fit, hand_axes, opposed, posture_for
from mint_hub.synth.hand_anatomy import straight_axes
from mint_hub.synth.hand_pose import POSTURES, HandProxy, varied
from mint_hub.synth.motion import minimum_jerk
from mint_hub.synth.things import Grip, Thing

__all__ = ["Avoid", "Person", "clamps", "grasp_of", "outward"]

Floats = NDArray[np.float64]
Avoid = Callable[[Floats], float]

_MOST_EFFORT: Final = 1.1
_FITS: Final = 5

GRIP_VARIES: Final = 0.8
"""How much grips differ between people and things, as `hand_pose.varied` has it; the fit then takes
the fingers that touch to the surface, and the others stay."""


def outward(side: Side) -> float:
    """+1 for the right side, -1 for the left: the sign of x away from the middle."""
    return 1.0 if side == "right" else -1.0


@dataclass(frozen=True, eq=False)
class Person:
    """Who works at the table.

    Attributes:
        proxy: the hand; both hands of a person have one shape.
        eye: (3,) where the camera is on average.
        elbow_out: metres from the middle to an elbow.
        elbow_up: height of the elbows.
        tempo: factor on all durations.
        dominant: the side that does more.
        habits: seed of how postures differ from the named ones, see `posture`.

    """

    proxy: HandProxy
    eye: Floats
    elbow_out: float
    elbow_up: float
    tempo: float
    dominant: Side
    habits: int = 0

    def posture(self, name: str, side: Side, time: float, again: int = 0) -> Floats:
        """Angles (21,) of a named posture as this person has it, another one at another time.

        ``time`` counts in tenths of a second; ``again`` tells several at one time apart.
        """
        occasion = abs(round(10 * time)) + again
        words = (self.habits, SIDES.index(side), sum(map(ord, name)), occasion)
        return varied(POSTURES[name], np.random.default_rng(words))

    def grip(self, angles_deg: Floats, side: Side, thing: Thing) -> Floats:
        """Angles (21,) from which this person closes a hand on a thing, given the usual ones."""
        words = (self.habits, SIDES.index(side), round(1e6 * (thing.radius + thing.height)))
        return varied(angles_deg, np.random.default_rng(words), GRIP_VARIES)

    def elbow(self, side: Side, wrist: Floats) -> Floats:
        """Elbow (..., 3) that goes with a wrist position (..., 3): it follows, a third as far."""
        out = outward(side)
        base = np.array([out * self.elbow_out, min(float(self.eye[1]) - 0.02, -0.1), self.elbow_up])
        rest = np.array([out * 0.2, 0.12, 0.04])
        follow = np.array([0.38, 0.30, 0.42])
        elbow = base + follow * (np.asarray(wrist, float) - rest)
        height = np.maximum(elbow[..., 2], 0.035 - 0.3 * np.minimum(elbow[..., 1], 0))
        elbow[..., 2] = height
        behind = minimum_jerk((-0.04 - np.asarray(wrist, float)[..., 1]) / 0.22)[..., None]
        hanging = wrist + np.array([0.05 * out, -0.28, -0.10])
        return elbow + behind * (hanging - elbow)

    def effort(self, side: Side, T_work_from_wrist: Floats) -> float:
        """How awkward a wrist pose is: 0 easy, above 1.1 refused."""
        R, wrist = T_work_from_wrist[:3, :3] @ straight_axes(side), T_work_from_wrist[:3, 3]
        out = outward(side)
        back = R[:, 0] * out
        palm, thumb = -R[:, 1], R[:, 2]
        forearm = self.elbow(side, wrist) - wrist
        forearm /= np.linalg.norm(forearm)
        along = max(float(back @ forearm), 1e-3)
        sideways = np.arctan2(float(thumb @ forearm), along)
        flexed = np.arctan2(float(palm @ forearm), along)
        bent = 0.5 * (sideways / 0.55) ** 2 + 0.5 * (flexed / 0.95) ** 2
        turned = 0.9 * max(0.0, float(palm[0]) * out - 0.15)
        turned += 0.8 * max(0.0, float(palm[2]) - 0.1)
        turned += 0.9 * max(0.0, -float(thumb[2]) - 0.25) + 0.6 * max(0.0, thumb[0] * out - 0.2)
        return bent + turned

    def resting(
        self, side: Side, rng: np.random.Generator, posture: str, angles_deg: Floats
    ) -> Floats:
        """A hand lying on the table near its edge: T_work_from_wrist (4, 4)."""
        out = outward(side)
        ahead = np.array([-out * rng.uniform(0.1, 0.5), 1.0, -0.05])
        palm = np.array([-out * rng.uniform(0.0, 0.15), -0.05, -1.0])
        if posture == "loose_fist":
            palm = np.array([-out * rng.uniform(0.5, 0.9), 0.0, -0.6])
        at = np.array([out * rng.uniform(0.13, 0.25), rng.uniform(-0.01, 0.10), 0.0])
        return self.lowered(side, hand_axes(side, ahead, palm), at, angles_deg, 0.0015)

    def lap(self, side: Side, rng: np.random.Generator) -> Floats:
        """A hand out of sight, beside the body below the table."""
        out = outward(side)
        at = np.array([out * rng.uniform(0.30, 0.36), rng.uniform(-0.42, -0.30), -0.12])
        R = hand_axes(side, np.array([-0.2 * out, 1.0, -0.5]), np.array([-out * 0.6, -0.2, -0.7]))
        return np.asarray(rigid(R, at))

    def lowered(
        self, side: Side, R: Floats, at: Floats, angles_deg: Floats, clearance: float
    ) -> Floats:
        """The wrist pose above ``at`` whose lowest point is ``clearance`` above the table."""
        flat = np.asarray(rigid(R, np.array([at[0], at[1], 0.0])))
        points = self.proxy.placed(flat[None], angles_deg[None], side)[0]
        flat[2, 3] = clearance - float(points[:, 2].min())
        return flat


def grasp_of(
    person: Person, side: Side, thing: Thing, T_work_from_thing: Floats, avoid: Avoid | None = None
) -> Grasp | None:
    """The best grasp of a thing where it stands, or None where no good one is easy.

    Args:
        person: who takes it.
        side: with which hand.
        thing: what.
        T_work_from_thing: (4, 4) where.
        avoid: function from points (P, 3) of the hand in the workplace to how deep, in metres, they
            are in other things.

    """
    own = _best_grasp(person, side, thing, T_work_from_thing, avoid, habits=True)
    return own or _best_grasp(person, side, thing, T_work_from_thing, avoid, habits=False)


def _best_grasp(
    person: Person,
    side: Side,
    thing: Thing,
    T_work_from_thing: Floats,
    avoid: Avoid | None,
    habits: bool,
) -> Grasp | None:
    """Fit the easiest grips, begun as the person would, or as everybody does."""
    floor = -float(T_work_from_thing[2, 3])
    options: list[tuple[float, int, Floats, Floats, Grip]] = []
    for grip in thing.grips:
        angles = posture_for(person.proxy, grip.style, grip.width)
        if habits and grip.style != "flat":
            angles = person.grip(angles, side, thing)
        for begin in _starts(person, side, grip, angles, T_work_from_thing):
            effort = person.effort(side, T_work_from_thing @ begin)
            if effort < _MOST_EFFORT:
                alike = [g.style for g in thing.grips[: thing.grips.index(grip)]]
                preference = 0.25 * len({*alike} - {grip.style})
                options.append((effort + preference, len(options), begin, angles, grip))
    best: Grasp | None = None
    least = np.inf
    for effort, _, begin, angles, grip in sorted(options, key=lambda o: o[:2])[:_FITS]:
        made = fit(person.proxy, side, grip.style, thing.solid, begin, angles, floor)
        cost = 1000 * made.badness + 2 * effort
        if avoid is not None:
            wrist = T_work_from_thing @ made.T_thing_from_wrist
            hand = person.proxy.placed(wrist[None], made.angles_deg[None], side)[0]
            depth = avoid(hand)
            cost += 1000 * depth
            if depth > 0.006:
                continue
        if made.good and cost < least:
            best, least = made, cost
        if cost < 2 * effort + 2.5:
            break
    return best


def _starts(
    person: Person, side: Side, grip: Grip, angles: Floats, T_work_from_thing: Floats
) -> list[Floats]:
    """Wrist poses, in the thing's frame, from which a grip can be closed."""
    at = np.asarray(grip.at, float)
    R = T_work_from_thing[:3, :3]
    if grip.style in ("flat", "point"):
        here = T_work_from_thing[:3, 3] + R @ at
        ahead = here - person.elbow(side, here)
        ahead[2] = 0
        ahead /= np.linalg.norm(ahead)
        down = 0.2 if grip.style == "flat" else 0.55
        ahead = ahead - np.array([0, 0, down])
        own = hand_axes(side, ahead, np.array([0.0, 0.0, -1.0]))
        reach = 0.115 if grip.style == "flat" else 0.16
        spot = at + R.T @ (-reach * ahead + [0, 0, 0.028])
        return [np.asarray(rigid(R.T @ own, spot))]
    yaws = np.arange(0, 360, 24.0) if grip.yaws_deg is None else np.array(grip.yaws_deg)
    pads = opposed(person.proxy, side, grip.style, angles)
    starts: list[Floats] = []
    for yaw in np.deg2rad(yaws):
        across = np.array([np.cos(yaw), np.sin(yaw), 0.0])
        for sign in (-1.0, 1.0):
            level = sign * np.array([-np.sin(yaw), np.cos(yaw), 0.0])
            tilt = np.deg2rad(8 if grip.style == "wrap" else 58)
            approach = np.cos(tilt) * level - np.sin(tilt) * np.array([0, 0, 1.0])
            starts.append(aligned(pads, at, across, approach))
    return starts


def clamps(person: Person, thing: Thing, T_work_from_thing: Floats) -> dict[Side, Grasp] | None:
    """Both hands on a thing, one from each side; None where they do not fit well."""
    made: dict[Side, Grasp] = {}
    R, at = T_work_from_thing[:3, :3], T_work_from_thing[:3, 3]
    for side in SIDES:
        out = outward(side)
        reach = _edge(thing, R.T @ np.array([out, 0.0, 0.0]))
        height = max(0.062, 0.52 * thing.height)
        spot = at + np.array([out * (reach + 0.022), -0.085, height])
        own = hand_axes(side, np.array([-0.12 * out, 1.0, -0.12]), np.array([-out, -0.1, 0.0]))
        T = np.asarray(rigid(R.T @ own, R.T @ (spot - at)))
        angles = posture_for(person.proxy, "clamp", 0.0)
        grasp = fit(person.proxy, side, "clamp", thing.solid, T, angles, -float(at[2]))
        if not grasp.good:
            return None
        made[side] = grasp
    return made


def _edge(thing: Thing, direction: Floats) -> float:
    """Metres from the axis of a thing to its surface at half height, along ``direction``."""
    steps = np.linspace(0, 0.3, 301)
    line = np.array([0, 0, 0.5 * thing.height]) + steps[:, None] * direction
    inside = np.flatnonzero(thing.solid.distance(line) < 0.0005)
    return float(steps[inside[-1]]) if inside.size else thing.radius
