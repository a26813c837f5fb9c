"""What is done at a table in the bench-ood clips only; see ``activities`` for how and for train.

No activity of this table, OOD, is in ``activities.TRAIN``.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from mint_hub.geometry.rigid import rigid
from mint_hub.geometry.rotations import rotvec_to_matrix
from mint_hub.synth.activities import Activity, choose, take
from mint_hub.synth.actors import Arm, Item
from mint_hub.synth.grasps import hand_axes
from mint_hub.synth.hand_pose import POSTURES
from mint_hub.synth.person import outward
from mint_hub.synth.tabletop import Tabletop

__all__ = ["OOD"]

Floats = NDArray[np.float64]


def _swing(
    table: Tabletop,
    arm: Arm,
    item: Item,
    start: float,
    poses: list[Floats],
    words: str,
    strokes: int,
    period: float,
) -> bool:
    """Take, go through ``poses`` again and again, put back."""
    back = np.array(item.T)
    held = take(table, arm, item, start)
    if held is None:
        return False
    table.say(f"{arm.side} hand picks up the {item.thing.name}", arm.side, start, held)
    raised = np.array(item.T)
    raised[2, 3] += 0.05
    up = table.raise_to(item, raised, held)
    time = table.raise_to(item, poses[0], held + 0.5 * (up - held), 1.1)
    table.look(up, poses[0][:3, 3])
    for number in range(1, strokes):
        time = item.track.to(poses[number % len(poses)], time - 0.06, period)
    table.say(f"{arm.side} hand {words}", arm.side, up, time)
    down = table.carry(item, back, time, 0.03)
    item.aloft.append((held, down))
    table.let_go(arm, down + 0.06)
    return True


def shake(table: Tabletop, arm: Arm, start: float) -> bool:
    """Shake a thing beside the head."""
    item = choose(table, arm, start)
    if item is None or item.thing.roles & {"tool"}:
        return False
    rng, out = table.rng, outward(arm.side)
    low = np.array(item.T)
    low[:3, 3] = [out * rng.uniform(0.08, 0.2), rng.uniform(0.18, 0.3), rng.uniform(0.1, 0.2)]
    high = low.copy()
    high[:3, 3] += [0.02 * out, 0.01, rng.uniform(0.05, 0.09)]
    turn = np.array([rng.uniform(-0.4, -0.1), -0.25 * out, 0])
    high[:3, :3] = np.asarray(rotvec_to_matrix(turn)) @ low[:3, :3]
    strokes = int(rng.integers(6, 13))
    words = f"shakes the {item.thing.name}"
    return _swing(table, arm, item, start, [low, high], words, strokes, rng.uniform(0.2, 0.32))


def cut(table: Tabletop, arm: Arm, start: float) -> bool:
    """Saw to and fro with a knife just above the table."""
    item = choose(table, arm, start, "cut")
    if item is None:
        return False
    rng = table.rng
    near = table.spot(item, arm)
    if near is None:
        return False
    near[2, 3] = 0.028
    far = near.copy()
    far[:3, 3] += near[:3, :3] @ [rng.uniform(0.04, 0.07), 0, 0] - [0, 0, 0.016]
    strokes = int(rng.integers(6, 14))
    words = f"saws with the {item.thing.name}"
    return _swing(table, arm, item, start, [near, far], words, strokes, rng.uniform(0.26, 0.4))


def beat(table: Tabletop, arm: Arm, start: float) -> bool:
    """Beat with a hammer, or with the end of a screwdriver."""
    item = choose(table, arm, start, "tool")
    if item is None:
        return False
    rng = table.rng
    low = table.spot(item, arm)
    if low is None:
        return False
    low[2, 3] = 0.03
    high = low.copy()
    high[2, 3] += 0.05
    turn = np.array([0, -rng.uniform(0.5, 0.8), 0])
    high[:3, :3] = low[:3, :3] @ np.asarray(rotvec_to_matrix(turn))
    strokes = 2 * int(rng.integers(2, 5)) + 1
    words = f"beats with the {item.thing.name}"
    return _swing(table, arm, item, start, [high, low], words, strokes, rng.uniform(0.25, 0.4))


def twist(table: Tabletop, arm: Arm, start: float) -> bool:
    """Turn a standing thing to and fro about its axis, as a tap is turned."""
    item = choose(table, arm, start)
    if item is None or item.thing.roles & {"tool"} or item.thing.height < 0.025:
        return False
    rest = np.array(item.T)
    held = take(table, arm, item, start)
    if held is None:
        return False
    out, time = outward(arm.side), held
    for number in range(int(table.rng.integers(3, 8))):
        goal = np.array(rest)
        angle = out * (0.55 if number % 2 else -0.45) * table.rng.uniform(0.6, 1.0)
        goal[:3, :3] = np.asarray(rotvec_to_matrix(np.array([0, 0, angle]))) @ rest[:3, :3]
        time = item.track.to(goal, time, table.rng.uniform(0.35, 0.6)) - 0.05
    free = table.let_go(arm, item.track.end + 0.06)
    table.say(f"{arm.side} hand twists the {item.thing.name}", arm.side, start, free)
    return True


def gesture(table: Tabletop, arm: Arm, start: float) -> bool:
    """Talk with an empty hand in the air: spread, fist, point, turn."""
    rng, out, time = table.rng, outward(arm.side), start
    names = ("spread", "loose_fist", "point", "flat", "hook")
    centre = np.array(
        [out * rng.uniform(0.08, 0.2), rng.uniform(0.18, 0.32), rng.uniform(0.1, 0.2)]
    )
    table.look(start, centre)
    for _ in range(int(rng.integers(4, 8))):
        ahead = np.array([-out * rng.uniform(0.1, 0.8), 1.0, rng.uniform(-0.2, 0.6)])
        palm = np.array([-out * rng.uniform(0.2, 1.0), -0.2, rng.uniform(-1.0, 0.5)])
        T = np.asarray(rigid(hand_axes(arm.side, ahead, palm), centre + rng.normal(0, 0.03, 3)))
        end = table.move(arm, T, time, POSTURES[names[int(rng.integers(len(names)))]], 0.05, 1.1)
        time = end - 0.1
    arm.free_at = time
    table.say(f"{arm.side} hand gestures in the air", arm.side, start, time)
    return True


OOD: Final[dict[str, tuple[Activity, float]]] = {
    "shake": (shake, 2.0),
    "cut": (cut, 2.0),
    "beat": (beat, 2.0),
    "twist": (twist, 2.0),
    "gesture": (gesture, 1.5),
}
"""Activities of bench-ood clips; none of them is in TRAIN."""
