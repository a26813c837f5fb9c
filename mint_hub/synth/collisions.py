"""How often hands go through things: what a plan is judged by before it is filmed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mint_hub.conventions import SIDES, Side
from mint_hub.synth.actors import depths
from mint_hub.synth.tabletop import Tabletop

__all__ = ["Collisions", "collisions"]

Floats = NDArray[np.float64]

TOLERATED_M: Final = 0.006
"""Flesh gives way: less than this is no collision."""


FOREARM_M: Final = 0.032
"""Radius with which forearms count."""


@dataclass(frozen=True)
class Collisions:
    """How much of a clip is not possible.

    Attributes:
        share: of the frames in which a hand is more than 6 mm inside a thing, the table or the
            other hand, or a forearm through a thing or the other forearm.
        deepest: metres.

    """

    share: float
    deepest: float


def collisions(table: Tabletop, times: Floats, exists: tuple[bool, bool], seed: int) -> Collisions:
    """Count collisions at ``times`` (T,) of the hands that exist."""
    poses = table.item_poses(times, seed)
    wrists, angles = table.hands(times, poses, seed)
    proxy = table.person.proxy
    points = [proxy.placed(wrists[side], angles[side], side) for side in SIDES]
    deepest = np.zeros(len(times))
    for there, side, hand in zip(exists, SIDES, points, strict=True):
        if not there:
            continue
        over = hand[..., 1].min(1) > 0.0  # nearer than the table's edge, below is free
        deepest = np.maximum(deepest, np.where(over, -hand[..., 2].min(1), 0.0))
        forearm = _forearm(table, side, wrists[side])
        for item, T in zip(table.items, poses, strict=True):
            deepest = np.maximum(deepest, depths(item.thing, T, hand))
            near = depths(item.thing, T, forearm, FOREARM_M)
            deepest = np.maximum(deepest, near - 0.006)
    if all(exists):
        left, right = (p[:, ::4] for p in points)
        for k in np.flatnonzero(np.linalg.norm(left.mean(1) - right.mean(1), axis=-1) < 0.25):
            gap = np.linalg.norm(left[k, :, None] - right[k, None], axis=-1).min()
            deepest[k] = max(deepest[k], 0.010 - gap)
        a, b = (_forearm(table, side, wrists[side]) for side in SIDES)
        gaps = np.linalg.norm(a[:, :, None] - b[:, None], axis=-1).min((1, 2))
        deepest = np.maximum(deepest, 2 * FOREARM_M - 0.005 - gaps)
    return Collisions(float((deepest > TOLERATED_M).mean()), float(deepest.max(initial=0.0)))


def _forearm(table: Tabletop, side: Side, wrists: Floats) -> Floats:
    """Points (T, 8, 3) along a forearm, from behind the wrist (T, 4, 4) on."""
    at = wrists[:, :3, 3]
    way = table.person.elbow(side, at) - at
    way = way / np.linalg.norm(way, axis=-1, keepdims=True)
    return at[:, None] + np.linspace(0.05, 0.32, 8)[:, None] * way[:, None]
