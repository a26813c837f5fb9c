"""What people do at a table: each activity is a short plan in the verbs of ``tabletop``.

An activity takes the table, the arm that does it and a start time, and returns whether it could be
done; when it could not, nothing has changed. TRAIN is the table of train and bench
clips; ``activities_ood`` holds what only bench-ood does.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mint_hub.conventions import SIDES
from mint_hub.geometry.rigid import rigid
from mint_hub.geometry.rotations import rotvec_to_matrix
from mint_hub.synth.actors import Arm, Item
from mint_hub.synth.motion import PoseTrack
from mint_hub.synth.person import clamps, outward
from mint_hub.synth.tabletop import Tabletop

__all__ = ["TRAIN", "Activity", "choose", "take"]

Floats = NDArray[np.float64]
Activity = Callable[[Tabletop, Arm, float], bool]


def choose(
    table: Tabletop, arm: Arm, start: float, *roles: str, taller: float = 0.0
) -> Item | None:
    """A thing on this arm's side that is free, has a grip, and plays one of the roles."""
    out = outward(arm.side)
    low, high = table.reach_y
    good = [
        item
        for item in table.items
        if item.thing.grips
        and not item.buried
        and item.thing.height > taller
        and item.free_at <= start
        and (not roles or item.thing.roles & set(roles))
        and -0.12 < out * item.at[0] < 0.36
        and low - 0.06 < item.at[1] < high + 0.05
    ]
    if not good:
        return None
    weights = np.array([0.35**item.used for item in good])
    return good[int(table.rng.choice(len(good), p=weights / weights.sum()))]


def _near(table: Tabletop, arm: Arm, start: float, *roles: str, but: Item) -> Item | None:
    """Another thing on this arm's side, or in the middle, that plays one of the roles."""
    out = outward(arm.side)
    good = [
        item
        for item in table.items
        if item is not but
        and item.thing.roles & set(roles)
        and item.free_at <= start
        and not item.buried
        and -0.16 < out * item.at[0] < 0.3
        and item.at[1] < 0.5
    ]
    return good[int(table.rng.integers(len(good)))] if good else None


def take(table: Tabletop, arm: Arm, item: Item, start: float) -> float | None:
    """Reach for a thing by its best grasp: when it is held, or None where it cannot be."""
    grasp = table.best_grasp(arm, item)
    if grasp is None:
        return None
    item.used += 1
    return table.take(arm, item, start, grasp)


def _lift(table: Tabletop) -> float:
    return float(table.rng.uniform(0.05, 0.15))


# ------------------------------------------------------------------------ train


def move_thing(table: Tabletop, arm: Arm, start: float) -> bool:
    """Take a thing and put it somewhere else."""
    item = choose(table, arm, start)
    if item is None or item.thing.roles & {"wipe", "slide", "press"}:
        return False
    to = table.spot(item, arm)
    if to is None:
        return False
    held = take(table, arm, item, start)
    if held is None:
        return False
    table.say(f"{arm.side} hand reaches for the {item.thing.name}", arm.side, start, held)
    down = table.carry(item, to, held, _lift(table))
    free = table.let_go(arm, down + 0.06)
    table.say(f"{arm.side} hand lifts the {item.thing.name} and puts it down", arm.side, held, free)
    return True


def stack(table: Tabletop, arm: Arm, start: float) -> bool:
    """Put a thing on top of another, or into it."""
    item = choose(table, arm, start)
    if item is None or item.thing.roles & {"wipe", "slide", "press", "tool"}:
        return False
    base = _near(table, arm, start, "onto", "into", but=item)
    if base is None or not _goes_on(item, base):
        return False
    inside = "into" in base.thing.roles
    held = take(table, arm, item, start)
    if held is None:
        return False
    table.say(f"{arm.side} hand reaches for the {item.thing.name}", arm.side, start, held)
    to = table.turned_to(item, base.at.copy(), arm)
    to[2, 3] = base.at[2] + (base.thing.inside_z if inside else base.thing.height)
    word = "into" if inside else "on"
    if inside and base.thing.height > 0.03:
        above = np.array(to)
        above[2, 3] = base.at[2] + base.thing.height - 0.25 * item.thing.height
        over = table.carry(item, above, held, 0.06)
        free = table.let_go(arm, over + 0.02)
        drop = float(above[2, 3] - to[2, 3])
        item.track.to(to, over + 0.10, 0.06 + 1.3 * float(np.sqrt(2 * max(drop, 0.001) / 9.81)))
        item.aloft[-1] = (held, over)
    else:
        down = table.carry(item, to, held, 0.07, hurry=1.15)
        free = table.let_go(arm, down + 0.08)
    base.buried, item.buried = True, inside
    table.say(
        f"{arm.side} hand puts the {item.thing.name} {word} the {base.thing.name}",
        arm.side,
        held,
        free,
    )
    return True


def _goes_on(item: Item, base: Item) -> bool:
    if "into" in base.thing.roles:
        wide = base.thing.kind in ("bowl", "plate", "pan")
        return wide and item.thing.radius < 0.62 * base.thing.radius and item.thing.height < 0.16
    return item.thing.radius < 1.35 * base.thing.radius and "tool" not in item.thing.roles


def pour(table: Tabletop, arm: Arm, start: float) -> bool:
    """Pour from one thing into another."""
    item = choose(table, arm, start, "pour")
    if item is None:
        return False
    target = _near(table, arm, start, "into", but=item)
    out = outward(arm.side)
    if target is None or target.thing.kind == "plate":
        return False
    back = np.array(item.T)
    held = take(table, arm, item, start)
    if held is None:
        return False
    table.say(f"{arm.side} hand reaches for the {item.thing.name}", arm.side, start, held)
    mouth = target.at + np.array([0, 0, target.thing.height + table.rng.uniform(0.02, 0.05)])
    tilt = np.deg2rad(table.rng.uniform(68, 98))
    lean = np.asarray(rotvec_to_matrix(np.array([0, -out * tilt, 0])))
    poured = np.asarray(rigid(lean @ item.T[:3, :3], np.zeros(3)))
    poured[:3, 3] = (
        mouth - lean @ np.array([0, 0, item.thing.height]) + np.array([out * 0.012, 0, 0])
    )
    ready = np.array(item.T)
    ready[:3, 3] = poured[:3, 3] + np.array([out * 0.04, -0.01, 0.02])
    ready[2, 3] = max(ready[2, 3] - 0.03, 0.06)
    raised = np.array(item.T)
    raised[2, 3] = max(0.5 * ready[2, 3], 0.05)
    up = table.raise_to(item, raised, held)
    table.look(up - 0.2, target.at)
    over = table.raise_to(item, ready, held + 0.5 * (up - held), 1.2)
    tilted = table.raise_to(item, poured, over - 0.15, 1.25)
    wait = float(table.rng.uniform(0.35, 1.1))
    upright = table.raise_to(item, ready, tilted + wait, 1.1)
    table.say(
        f"{arm.side} hand pours from the {item.thing.name} into the {target.thing.name}",
        arm.side,
        up,
        upright,
    )
    down = table.carry(item, back, upright - 0.1, 0.02)
    item.aloft[-1] = (held, down)
    free = table.let_go(arm, down + 0.06)
    table.say(f"{arm.side} hand puts the {item.thing.name} back", arm.side, upright, free)
    return True


def inspect(table: Tabletop, arm: Arm, start: float) -> bool:
    """Lift a thing, turn it before the eyes, put it back."""
    item = choose(table, arm, start)
    if item is None or item.thing.roles & {"wipe", "slide", "press"}:
        return False
    back = np.array(item.T)
    held = take(table, arm, item, start)
    if held is None:
        return False
    out, rng = outward(arm.side), table.rng
    table.say(f"{arm.side} hand takes the {item.thing.name}", arm.side, start, held)
    shown = np.array(item.T)
    shown[:3, 3] = [out * rng.uniform(0.02, 0.12), rng.uniform(0.16, 0.26), rng.uniform(0.09, 0.18)]
    first = shown.copy()
    axis = np.array([rng.uniform(0.2, 0.7), -out * rng.uniform(-0.1, 0.7), rng.uniform(-0.4, 0.4)])
    first[:3, :3] = np.asarray(rotvec_to_matrix(axis)) @ shown[:3, :3]
    second = shown.copy()
    second[:3, 3] += rng.normal(0, 0.015, 3)
    turn = np.array([-0.2, out * rng.uniform(-0.1, 0.45), rng.uniform(-0.5, 0.5)])
    second[:3, :3] = np.asarray(rotvec_to_matrix(turn)) @ shown[:3, :3]
    raised = np.array(item.T)
    raised[2, 3] += 0.05
    up = table.raise_to(item, raised, held)
    there = table.raise_to(item, first, held + 0.5 * (up - held), 1.1)
    table.look(up, first[:3, 3])
    turned = table.raise_to(item, second, there + rng.uniform(0.0, 0.4), 1.5)
    table.say(f"{arm.side} hand lifts and turns the {item.thing.name}", arm.side, held, turned)
    down = table.carry(item, back, turned + rng.uniform(0, 0.3), 0.03)
    item.aloft[-1] = (held, down)
    free = table.let_go(arm, down + 0.06)
    table.say(f"{arm.side} hand puts the {item.thing.name} back", arm.side, turned, free)
    return True


def hand_over(table: Tabletop, arm: Arm, start: float) -> bool:
    """Give a thing from one hand to the other, which puts it down."""
    other = table.other(arm)
    item = choose(table, arm, max(start, other.free_at), taller=0.085)
    if item is None or other.held is not None:
        return False
    rng, out = table.rng, outward(arm.side)
    begin = max(start, other.free_at)
    first = table.best_grasp(arm, item)
    if first is None:
        return False
    meet = table.turned_to(item, np.array([out * 0.02, rng.uniform(0.2, 0.27), 0.11]), arm)
    probe = Item(item.thing, PoseTrack(meet))
    taken = meet @ first.T_thing_from_wrist
    ours = table.person.proxy.placed(taken[None], first.angles_deg[None], arm.side)[0]

    def depth(points: Floats) -> float:
        return 0.016 - float(np.linalg.norm(points[:, None] - ours[None], axis=-1).min())

    second = table.grasp_at(other, probe, depth)
    if second is None:
        return False
    to = table.spot(item, other)
    if to is None:
        return False
    held = table.take(arm, item, begin, first)
    item.used += 1
    table.say(f"{arm.side} hand takes the {item.thing.name}", arm.side, begin, held)
    raised = np.array(item.T)
    raised[2, 3] += 0.07
    up = table.raise_to(item, raised, held)
    there = table.raise_to(item, meet, held + 0.5 * (up - held), 1.1)
    table.look(up, meet[:3, 3])
    reach = max(there - 0.35, other.free_at)
    both = max(table.take(other, item, reach, second), there + 0.02)
    other.spans[-1].start = both
    free = table.let_go(arm, both + 0.05)
    table.say(
        f"{arm.side} hand gives the {item.thing.name} to the {other.side} hand", "both", there, free
    )
    to[:3, :3] = table.turned_to(item, to[:3, 3], other)[:3, :3]
    down = table.carry(item, to, free + 0.1, 0.05)
    item.aloft[-1] = (held, down)
    left = table.let_go(other, down + 0.06)
    table.say(f"{other.side} hand puts the {item.thing.name} down", other.side, free, left)
    table.go_idle(arm, free, "rest")
    other.idle = "working"
    return True


def wipe(table: Tabletop, arm: Arm, start: float) -> bool:
    """Wipe the table with a sponge or a cloth."""
    item = choose(table, arm, start, "wipe")
    if item is None:
        return False
    held = take(table, arm, item, start)
    if held is None:
        return False
    return _rub(table, arm, item, start, held, "wipes the table with", 0.09)


def slide(table: Tabletop, arm: Arm, start: float) -> bool:
    """Push a book over the table with the flat hand."""
    item = choose(table, arm, start, "slide")
    if item is None:
        return False
    to = table.spot(item, arm)
    if to is None or table.clearance_on_way(item, to) < 0.005:
        return False
    held = take(table, arm, item, start)
    if held is None:
        return False
    table.look(held, to[:3, 3])
    pushed = table.raise_to(item, to, held + 0.05, 1.5)
    free = table.let_go(arm, pushed + 0.05)
    table.say(f"{arm.side} hand slides the {item.thing.name} over the table", arm.side, start, free)
    return True


def _rub(
    table: Tabletop, arm: Arm, item: Item, start: float, held: float, words: str, size: float
) -> bool:
    rng = table.rng
    time, T = held, np.array(item.T)
    centre = T[:3, 3].copy()
    table.look(held, centre)
    for number in range(int(rng.integers(5, 10))):
        goal = np.array(T)
        sign = 1 if number % 2 else -1
        offset = np.array([sign * size * rng.uniform(0.5, 1.0), 0.02 * (number % 4 - 1.5), 0])
        goal[:3, 3] = centre + offset
        if table.clearance(item, goal[:3, 3]) < 0.0 or goal[1, 3] < 0.1:
            continue
        duration = 0.55 * table.pace(float(np.linalg.norm(goal[:3, 3] - item.at))) + 0.1
        end = item.track.to(goal, time, duration)
        time = end - 0.22 * duration
    end = max(item.track.end, held + 0.2)
    free = table.let_go(arm, end + 0.05)
    table.say(f"{arm.side} hand {words} the {item.thing.name}", arm.side, start, free)
    return end > held + 0.5


def press(table: Tabletop, arm: Arm, start: float) -> bool:
    """Press a switch, once or a few times."""
    item = choose(table, arm, start, "press")
    grasp = None if item is None else table.best_grasp(arm, item)
    if item is None or grasp is None:
        return False
    time = start
    for _ in range(int(table.rng.integers(1, 4))):
        held = table.take(arm, item, time, grasp)
        time = table.let_go(arm, held + 0.05)
        arm.angles.moves.pop()  # the finger stays stretched between taps
        arm.angles.target = grasp.angles_deg.copy()
    item.used += 1
    arm.angles.to(table.person.posture("relaxed", arm.side, time), time, 0.4)
    table.say(f"{arm.side} hand presses the {item.thing.name}", arm.side, start, time)
    return True


def carry_with_both(table: Tabletop, arm: Arm, start: float) -> bool:
    """Lift something large with both hands and put it down elsewhere."""
    begin = max(a.free_at for a in table.arms.values())
    if begin > start + 3.5 or any(a.held is not None for a in table.arms.values()):
        return False
    good = [
        i
        for i in table.items
        if "both" in i.thing.roles and not i.buried and i.free_at <= begin and abs(i.at[0]) < 0.13
    ]
    if not good:
        return False
    item = good[0]
    hold = clamps(table.person, item.thing, item.T)
    spots = [to for _ in range(4) if (to := table.spot(item, None)) is not None]
    to = next((t for t in spots if table.hands_room(item, t[:3, 3]) >= 0), None)
    if hold is None or to is None or table.hands_room(item, item.at) < 0:
        return False
    if begin > start + 0.8 and arm.idle == "working":
        begin = max(begin, table.go_idle(arm, start, "rest"))
    times = [table.take(table.arms[side], item, begin, hold[side]) for side in SIDES]
    held = max(times)
    table.say(f"both hands take hold of the {item.thing.name}", "both", begin, held)
    down = table.carry(item, to, held, _lift(table) * 0.8, hurry=1.3)
    free = max(table.let_go(table.arms[side], down + 0.08) for side in SIDES)
    item.used += 1
    table.other(arm).idle = "working"
    table.say(f"both hands lift the {item.thing.name} and put it down", "both", held, free)
    return True


TRAIN: Final[dict[str, tuple[Activity, float]]] = {
    "move": (move_thing, 3.0),
    "stack": (stack, 2.0),
    "pour": (pour, 2.2),
    "inspect": (inspect, 1.6),
    "hand over": (hand_over, 1.6),
    "wipe": (wipe, 1.3),
    "slide": (slide, 0.7),
    "press": (press, 0.7),
    "both": (carry_with_both, 2.6),
}
"""Activities of train and bench clips, and how often each is tried."""
