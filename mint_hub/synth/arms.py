"""The arm behind a hand: a tube that grows out of the wrist and bends to the elbow and shoulder.

It leaves the hand along the hand's own axis, inside the end of its mesh, so that no pose opens a
gap, turns to the direction of the forearm without twisting, and at the elbow to that of the upper
arm. A sleeve is a second, wider tube around it with an open cuff.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mint_hub.conventions import Side
from mint_hub.geometry.hand_model import HandModel
from mint_hub.geometry.hand_state import absent, unpack
from mint_hub.geometry.rotations import rotvec_to_matrix
from mint_hub.synth.hand_anatomy import straight_axes

SEGMENTS: Final = 24
BEND_M: Final = (0.0, 0.055)
"""From where to where beyond the hand's mesh the tube turns to the forearm's direction."""

ELBOW_M: Final = 0.04
"""The tube turns from the forearm to the upper arm within this distance of the elbow."""

ELBOW_RATIO: Final = 1.5
"""Half width of the forearm where it is thickest over that of the wrist."""


@dataclass(frozen=True)
class Wrist:
    """Where a hand's mesh ends, in its straight axes: metres along its axis, and an ellipse there.

    Attributes:
        end: distance from the wrist joint to the end of the mesh.
        middle: (2,) y and z of the ellipse.
        half: (2,) half axes along y and z.

    """

    end: float
    middle: NDArray[np.float64]
    half: NDArray[np.float64]


def wrist_of(model: HandModel, side: Side, shape_params: NDArray[np.floating]) -> Wrist:
    """Measure the end of a hand of that shape (10,)."""
    shape = np.asarray(shape_params, np.float32)
    state = replace(unpack(absent()), shape_params=shape).pack()
    points = np.asarray(model.vertices(state, side), np.float64) @ straight_axes(side)
    outward = _outward(side) * points[:, 0]
    ring = points[outward > outward.max() - 0.012][:, 1:]
    low, high = ring.min(0), ring.max(0)
    return Wrist(float(outward.max()), (low + high) / 2, (high - low) / 2)


@dataclass(frozen=True, eq=False)
class Rings:
    """A tube as distances from the wrist joint (N,) and factors and extras on the half axes."""

    along: NDArray[np.float64]
    widen: NDArray[np.float64]
    extra: NDArray[np.float64]


def skin_rings(wrist: Wrist, elbow: float, end: float) -> Rings:
    """Rings of the bare arm from inside the hand to ``end``, closed there.

    ``elbow`` and ``end`` are metres from the wrist joint along the arm.
    """
    steps = 8 + round(28 * end)
    starts = [wrist.end - 0.014, wrist.end - 0.003]
    along = np.concatenate([starts, np.linspace(wrist.end + 0.004, end, steps), [end]])
    widen = _muscle(along, wrist.end, elbow)
    widen[0], widen[-1] = 0.9, 0.0
    return Rings(along, widen, np.zeros(len(along)))


def sleeve_rings(wrist: Wrist, elbow: float, end: float, seed: int) -> Rings:
    """Rings of a sleeve: from inside its cuff, around the lip, to ``end``, closed there."""
    rng = np.random.default_rng(seed)
    cuff = wrist.end - 0.02 + 0.05 * rng.uniform() ** 2
    loose = rng.uniform(0.004, 0.010)
    hem = cuff + rng.uniform(0.025, 0.06)
    lip = [cuff + 0.022, cuff + 0.001, cuff, cuff]
    band = np.linspace(cuff + 0.002, hem, 7)
    sleeve = np.linspace(hem + 0.012, end, 14 + round(34 * end))
    along = np.concatenate([lip, band, [hem, hem + 0.003], sleeve, [end]])
    relief = np.array([-2.5, -2.0, -1.5, 0.2, *np.full(7, 0.8), -0.4, 0.3])
    extra = loose + 0.001 * np.concatenate([relief, np.zeros(len(along) - len(relief))])
    start = len(relief)
    folds = np.interp(along, np.linspace(hem, end, 20), rng.normal(size=20))
    looser = 0.0022 * folds + 0.006 * np.clip((along - hem) / elbow, 0, 1)
    extra[start:] += looser[start:]
    widen = _muscle(along, wrist.end, elbow)
    widen[-1] = extra[-1] = 0.0
    return Rings(along, widen, extra)


@dataclass(frozen=True, eq=False)
class Direction:
    """Where an arm goes, in the frame of the hand's state.

    Attributes:
        forearm: (T, 3) from the wrist to the elbow, any length.
        upper_arm: (T, 3) from the elbow to the shoulder.
        elbow: metres from the wrist to the elbow.

    """

    forearm: NDArray[np.floating]
    upper_arm: NDArray[np.floating]
    elbow: float

    def upper_arm_length(self) -> NDArray[np.floating]:
        """Metres (T,) from the elbow to the shoulder, where ``upper_arm`` ends there."""
        return np.linalg.norm(self.upper_arm, axis=-1)


def tube_points(
    hand_state: NDArray[np.floating], to: Direction, side: Side, wrist: Wrist, rings: Rings
) -> NDArray[np.float32]:
    """Points of a tube, (T, 109) -> (T, N * (SEGMENTS + 1), 3), frame of the state.

    Where a direction is zero, or straight back, the arm goes on as before.
    """
    parts = unpack(np.asarray(hand_state, np.float64))
    R = np.asarray(parts.orientation(check=False)) @ straight_axes(side)
    axis = _outward(side) * R[..., :, 0]
    fine = np.linspace(0.0, float(rings.along.max()), 120)
    first = _bending(axis, to.forearm, fine, wrist.end + BEND_M[0], wrist.end + BEND_M[1])
    straight = (first[:, -1] @ axis[..., None])[..., 0]
    second = _bending(straight, to.upper_arm, fine, to.elbow - ELBOW_M, to.elbow + ELBOW_M)
    turned = second @ first  # (T, 120, 3, 3)
    tangents = turned @ axis[:, None, :, None]
    steps = np.diff(fine, prepend=0.0)[:, None]
    centers = np.cumsum(tangents[..., 0] * steps, axis=1)
    frames = turned @ R[:, None, :, 1:]  # (T, 120, 3, 2)
    # The upper arm reaches the shoulder in every frame, long or short.
    beyond = np.maximum(rings.along - to.elbow, 0.0)
    short = 1 - to.upper_arm_length()[:, None] / max(float(beyond.max()), 1e-9)
    along = rings.along - beyond * np.clip(short, 0.0, 0.9)
    index = np.clip(along / fine[-1] * (len(fine) - 1), 0, len(fine) - 1)
    low = np.minimum(index.astype(int), len(fine) - 2)
    share, k = (index - low)[..., None], np.arange(len(R))[:, None]
    center = centers[k, low] * (1 - share) + centers[k, low + 1] * share
    share = share[..., None]
    frame = frames[k, low] * (1 - share) + frames[k, low + 1] * share
    radii = _round_off(wrist, rings)
    ring_angle = np.linspace(0, 2 * np.pi, SEGMENTS + 1)
    circle = np.stack([np.cos(ring_angle), np.sin(ring_angle)], -1)
    flat = wrist.middle + circle * radii[:, None]  # (N, S + 1, 2)
    points = center[:, :, None] + np.einsum("tnij,nsj->tnsi", frame, flat)
    points = points + np.asarray(parts.translation)[:, None, None]
    return points.reshape(len(points), -1, 3).astype(np.float32)


def _bending(
    start: NDArray[np.floating],
    end: NDArray[np.floating],
    along: NDArray[np.float64],
    low: float,
    high: float,
) -> NDArray[np.float64]:
    """Rotations (T, len(along), 3, 3) that turn ``start`` to ``end`` (T, 3) from low to high."""
    target = np.asarray(end, np.float64)
    target = target / np.maximum(np.linalg.norm(target, axis=-1, keepdims=True), 1e-12)
    turn = np.cross(start, target)
    sine = np.linalg.norm(turn, axis=-1, keepdims=True)
    angle = np.arctan2(sine, (start * target).sum(-1, keepdims=True))
    rotvec = np.where(sine > 1e-6, turn / np.maximum(sine, 1e-12) * angle, 0.0)
    t = np.clip((along - low) / (high - low), 0, 1)
    share = t * t * (3 - 2 * t)
    return np.asarray(rotvec_to_matrix(share[:, None] * rotvec[:, None]))


@lru_cache(maxsize=32)
def tube_faces(num_rings: int, side: Side) -> NDArray[np.int32]:
    """Triangles of a tube, outward."""
    k = np.arange(num_rings * (SEGMENTS + 1)).reshape(num_rings, SEGMENTS + 1)
    p, q, r, s = (part.ravel() for part in (k[:-1, :-1], k[:-1, 1:], k[1:, 1:], k[1:, :-1]))
    faces = np.concatenate([np.stack([p, q, r], -1), np.stack([p, r, s], -1)])
    return (faces if side == "right" else faces[:, ::-1]).astype(np.int32)


def tube_uv(rings: Rings, repeat_m: float) -> NDArray[np.float32]:
    """Texture coordinates (N * (SEGMENTS + 1), 2): once around, along in repeats."""
    around = np.linspace(0, 1, SEGMENTS + 1)
    path = np.abs(np.diff(rings.along, prepend=rings.along[0])).cumsum()
    uv = np.stack(np.broadcast_arrays(around, path[:, None] / repeat_m), -1)
    return uv.reshape(-1, 2).astype(np.float32)


def _outward(side: Side) -> float:
    """Return the sign of x towards the forearm in the hand's own frame: a left hand is mirrored."""
    return 1.0 if side == "right" else -1.0


def _muscle(along: NDArray[np.float64], start: float, length: float) -> NDArray[np.float64]:
    t = np.clip((along - start) / max(length - start, 0.2), 0, 1)
    return 1 + (ELBOW_RATIO - 1) * t * t * (3 - 2 * t)


def _round_off(wrist: Wrist, rings: Rings) -> NDArray[np.float64]:
    """Half axes (N, 2): the wrist's ellipse widens and becomes a circle towards the elbow."""
    share = np.clip((rings.widen[:, None] - 1) / (ELBOW_RATIO - 1), 0, 1)
    half = wrist.half + share * 0.8 * (wrist.half.max() - wrist.half)
    return half * rings.widen[:, None] + rings.extra[:, None] * (rings.widen[:, None] > 0)
