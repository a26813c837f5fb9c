"""What happens on the table: arms and things with their movements, and the verbs that make them.

A verb begins when its arms are free, adds submovements, and says what it did. While a thing is
held, the thing's own movement is what is planned, and the hand follows rigidly: nothing slips.
Workplace frame as in ``person``; times in seconds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from mint_hub.conventions import SIDES, Side
from mint_hub.geometry.rotations import geodesic_angle, rotvec_to_matrix
from mint_hub.synth.actors import Arm, Item, Mark, Plan, Said, Span, depths, trembling
from mint_hub.synth.grasps import Grasp
from mint_hub.synth.motion import AngleTrack, PoseTrack, envelope, smooth_noise
from mint_hub.synth.person import Avoid, Person, grasp_of, outward

__all__ = ["Tabletop"]

Floats = NDArray[np.float64]


@dataclass(eq=False)
class Tabletop:
    """The table while its clip is planned."""

    person: Person
    rng: np.random.Generator
    items: list[Item]
    arms: dict[Side, Arm]
    said: list[Said] = field(default_factory=list[Said])
    gaze: list[tuple[float, Floats]] = field(default_factory=list[tuple[float, Floats]])
    reach_y: tuple[float, float] = (0.17, 0.44)

    @classmethod
    def begin(
        cls,
        person: Person,
        rng: np.random.Generator,
        items: list[Item],
        idle: dict[Side, str],
        time: float,
    ) -> Tabletop:
        """Set the table: arms where ``idle`` says ("rest", "loose_fist" or "lap")."""
        arms: dict[Side, Arm] = {}
        for side in SIDES:
            angles, T = _idle_pose(person, side, rng, idle[side], items, time)
            spans = [Span(-np.inf, PoseTrack(T))]
            arms[side] = Arm(side, spans, AngleTrack(angles), time, idle[side])
        return cls(person, rng, items, arms)

    # ---------------------------------------------------------------- small words

    def say(self, text: str, side: str, start: float, end: float) -> None:
        """Keep a sentence for the time it tells of."""
        self.said.append(Said(text, side, start, end))

    def look(self, time: float, at: Floats) -> None:
        """Let the eyes go to a point."""
        self.gaze.append((time, np.array(at, float)))

    def pace(self, metres: float, radians: float = 0.0) -> float:
        """Seconds that a movement of this size takes this person, now."""
        base = 0.26 + 0.80 * metres**0.75 + 0.13 * radians
        return float(base * self.person.tempo * self.rng.uniform(0.9, 1.15))

    def other(self, arm: Arm) -> Arm:
        """The other arm."""
        return self.arms["left" if arm.side == "right" else "right"]

    def mark(self) -> Mark:
        """Remember where planning is, for `back_to`."""
        return Mark(
            [(*i.track.mark(), len(i.aloft), i.free_at, i.used, i.buried) for i in self.items],
            {
                side: (
                    len(a.spans),
                    None if (t := a.spans[-1].track) is None else t.mark(),
                    (len(a.angles.moves), a.angles.target.copy()),
                    a.free_at,
                    a.idle,
                )
                for side, a in self.arms.items()
            },
            len(self.said),
            len(self.gaze),
        )

    def back_to(self, mark: Mark) -> None:
        """Forget everything planned since ``mark``."""
        for item, (moves, target, end, aloft, free_at, used, buried) in zip(
            self.items, mark.items, strict=True
        ):
            item.track.back_to(moves, target, end)
            del item.aloft[aloft:]
            item.free_at, item.used, item.buried = free_at, used, buried
        for side, (spans, track, (angle_moves, angles), free_at, idle) in mark.arms.items():
            arm = self.arms[side]
            del arm.spans[spans:], arm.angles.moves[angle_moves:]
            if track is not None and (own := arm.spans[-1].track) is not None:
                own.back_to(*track)
            arm.angles.target, arm.free_at, arm.idle = angles.copy(), free_at, idle
        del self.said[mark.said :], self.gaze[mark.gaze :]

    # ---------------------------------------------------------------------- hands

    def move(
        self,
        arm: Arm,
        T: Floats,
        start: float,
        angles: Floats | None = None,
        arc: float = 0.16,
        slower: float = 1.0,
    ) -> float:
        """Move a free hand; returns when it arrives."""
        track = arm.spans[-1].track
        assert track is not None
        metres = float(np.linalg.norm(T[:3, 3] - track.target[:3, 3]))
        turn = float(geodesic_angle(T[:3, :3], track.target[:3, :3]))
        duration = slower * self.pace(metres, turn)
        plans: list[Plan] = []
        for steep in (arc, arc + 0.3, arc + 0.7):
            up = np.array([0.0, 0.0, steep * max(0.0, metres - 0.05)])
            plans.append([(T, start, duration * (1 + 0.3 * (steep - arc)), up)])
        goal = arm.angles.target if angles is None else angles
        (step,) = self._safest(arm, track, plans, goal)
        end = track.to(*step)
        if angles is not None:
            arm.angles.to(angles, start, 0.8 * duration)
        return end

    def take(self, arm: Arm, item: Item, start: float, grasp: Grasp) -> float:
        """Reach for a thing and close the hand on it; returns when it is held."""
        T_work_from_wrist = item.T @ grasp.T_thing_from_wrist
        away = item.T[:3, :3] @ grasp.retreat
        self.look(start - 0.12, item.at + np.array([0, 0, 0.5 * item.thing.height]))
        track = arm.spans[-1].track
        assert track is not None
        last, blend = 0.34 * self.person.tempo, 0.14 * self.person.tempo
        plans: list[Plan] = []
        for back, arc in ((0.065, 0.16), (0.11, 0.16), (0.11, 0.5), (0.08, 0.9), (0.14, 0.4)):
            before = np.array(T_work_from_wrist)
            before[:3, 3] += back * away + np.array([0, 0, 0.012])
            metres = float(np.linalg.norm(before[:3, 3] - track.target[:3, 3]))
            turn = float(geodesic_angle(before[:3, :3], track.target[:3, :3]))
            up = np.array([0.0, 0.0, arc * max(0.0, metres - 0.05)])
            needed = self.pace(metres, turn) * (1 + 0.4 * max(0.0, arc - 0.16))
            slow = last * (1 + 3 * (back - 0.065))
            closing_in = (T_work_from_wrist, start + needed - blend, slow, np.zeros(3))
            plans.append([(before, start, needed, up), closing_in])
        plan = self._safest(arm, track, plans, grasp.opened_deg)
        for step in plan:
            track.to(*step)
        arrived = track.end
        arm.angles.to(grasp.opened_deg, start, 0.75 * plan[0][2])
        closing = 0.24 * self.person.tempo
        arm.angles.to(grasp.angles_deg, arrived - 0.55 * closing, closing)
        held = arrived + 0.45 * closing + 0.03
        arm.spans.append(Span(held, item=item, grasp=grasp))
        arm.free_at = item.free_at = held + 0.04
        return held + 0.04

    def _safest(self, arm: Arm, track: PoseTrack, plans: list[Plan], angles: Floats) -> Plan:
        """The first of the plans that touches nothing on its way, or the one that touches least."""
        best, least = plans[0], np.inf
        for plan in plans:
            way = PoseTrack(track.origin, list(track.moves))
            way.target = track.target
            for step in plan:
                way.to(*step)
            times = np.linspace(plan[0][1], plan[-1][1] + plan[-1][2], 14)
            share = np.clip((times - times[0]) / (0.75 * plan[0][2]), 0, 1)[:, None]
            fingers = arm.angles.target + share * (angles - arm.angles.target)
            hand = self.person.proxy.placed(way.at(times), fingers, arm.side)
            touched = np.maximum(0.0, 0.001 - hand[..., 2].min(1)) * (hand[..., 1].min(1) > 0)
            for item in self.items:
                touched = touched + depths(item.thing, item.track.at(times), hand)
            cost = float(np.maximum(0, touched - 0.004).sum())
            if cost < least:
                best, least = plan, cost
            if cost == 0:
                break
        return best

    def let_go(self, arm: Arm, start: float) -> float:
        """Open the hand and leave; returns when it may go on."""
        span = arm.spans[-1]
        assert span.item is not None
        assert span.grasp is not None
        T = arm.T
        away = span.item.T[:3, :3] @ span.grasp.retreat
        track = PoseTrack(T)
        arm.spans.append(Span(start, track))
        opening = 0.26 * self.person.tempo
        arm.angles.to(span.grasp.opened_deg, start, opening)
        plans: list[Plan] = []
        for back, up in ((0.075, 0.015), (0.12, 0.02), (0.09, 0.07)):
            clear = np.array(T)
            clear[:3, 3] += back * away + np.array([0, 0, up])
            quick = 0.42 * self.person.tempo * (1 + 3 * (back - 0.075))
            plans.append([(clear, start + 0.5 * opening, quick, np.zeros(3))])
        (step,) = self._safest(arm, track, plans, span.grasp.opened_deg)
        left = track.to(*step)
        loose = self.person.posture("relaxed", arm.side, left)
        arm.angles.to(loose, left - 0.2, 0.5)
        span.item.free_at = left - 0.1
        arm.free_at = left - 0.12
        return left - 0.12

    def go_idle(self, arm: Arm, start: float, where: str) -> float:
        """Bring a free hand to rest on the table, or out of sight ("lap")."""
        angles, T = _idle_pose(self.person, arm.side, self.rng, where, self.items, start)
        if where == "lap" and arm.T[1, 3] > 0:
            edge = np.array(T)
            edge[:3, 3] = [outward(arm.side) * 0.27, -0.07, 0.075]
            start = self.move(arm, edge, start, None, 0.05, slower=1.1) - 0.2
        arc = 0.22 if arm.idle == "lap" else 0.08
        end = self.move(arm, T, start, angles, arc, slower=1.15)
        arm.idle = where
        arm.free_at = end
        return end

    # --------------------------------------------------------------------- things

    def carry(self, item: Item, T: Floats, start: float, lift: float, hurry: float = 1.0) -> float:
        """Lift a held thing, bring it over ``T`` (4, 4) and set it down there."""
        here = np.array(item.T)
        top = max(float(here[2, 3]), float(T[2, 3])) + lift
        up, over = np.array(here), np.array(T)
        up[2, 3] = over[2, 3] = top
        rise, far = top - float(here[2, 3]), float(np.linalg.norm(over[:3, 3] - up[:3, 3]))
        turn = float(geodesic_angle(here[:3, :3], T[:3, :3]))
        lifted = item.track.to(up, start, hurry * 1.1 * self.pace(rise))
        self.look(lifted - 0.35, T[:3, 3])
        crossed = item.track.to(over, start + 0.55 * (lifted - start), hurry * self.pace(far, turn))
        sinking = hurry * 1.25 * self.pace(top - float(T[2, 3]))
        end = item.track.to(T, max(crossed - 0.3 * sinking, lifted), sinking)
        item.aloft.append((start, end))
        return end

    def raise_to(self, item: Item, T: Floats, start: float, slower: float = 1.0) -> float:
        """Move a held thing through the air to ``T`` in one movement."""
        metres = float(np.linalg.norm(T[:3, 3] - item.at))
        turn = float(geodesic_angle(T[:3, :3], item.T[:3, :3]))
        return item.track.to(T, start, slower * self.pace(metres, turn))

    # ------------------------------------------------------------------ placing

    def spot(self, item: Item, arm: Arm | None, tries: int = 24) -> Floats | None:
        """A pose (4, 4) on the table where a held thing can be put; None where it is too full."""
        best, most = None, 0.012
        for _ in range(tries):
            x = self.rng.uniform(-0.12, 0.12)
            if arm is not None:
                x = outward(arm.side) * self.rng.uniform(-0.08, 0.3)
            at = np.array([x, self.rng.uniform(*self.reach_y), 0.0])
            room = self.clearance(item, at)
            if np.linalg.norm(at - item.at) > 0.08 and room > most:
                best, most = at, min(room, 0.05)
        return None if best is None else self.turned_to(item, best, arm)

    def turned_to(self, item: Item, at: Floats, arm: Arm | None) -> Floats:
        """Pose at ``at``, turned about z as the forearm that carries it turns."""
        T = np.array(item.T)
        turn = 0.0
        if arm is not None:
            a, b = (p - self.person.elbow(arm.side, p) for p in (item.at, at))
            turn = float(np.arctan2(b[1], b[0]) - np.arctan2(a[1], a[0]))
            turn = 0.8 * float(np.arctan2(np.sin(turn), np.cos(turn)))
        T[:3, :3] = np.asarray(rotvec_to_matrix(np.array([0, 0, turn]))) @ item.T[:3, :3]
        T[:3, 3] = at
        return T

    def clearance(self, item: Item, at: Floats) -> float:
        """Metres between the footprint of a thing at ``at`` and those of all others."""
        gaps = [
            float(np.linalg.norm(at[:2] - o.at[:2])) - o.thing.radius - item.thing.radius
            for o in self.items
            if o is not item
        ]
        return min(gaps, default=1.0)

    def clearance_on_way(self, item: Item, T: Floats) -> float:
        """The smallest clearance of a thing pushed straight to ``T``."""
        steps = np.linspace(0, 1, 8)[1:, None]
        return min(self.clearance(item, p) for p in item.at + steps * (T[:3, 3] - item.at))

    def hands_room(self, item: Item, at: Floats) -> float:
        """Metres free at both sides of a thing at ``at``, for hands, beyond the 7 cm they need."""
        gaps: list[float] = []
        for other in self.items:
            if other is not item:
                x, y = np.abs(other.at[:2] - at[:2])
                beside = y < other.thing.radius + 0.10
                gaps.append(x - other.thing.radius - item.thing.radius - 0.07 if beside else 1.0)
        return float(min(gaps, default=1.0))

    def best_grasp(self, arm: Arm, item: Item) -> Grasp | None:
        """A grasp of an item that does not touch what stands around it, nor the other hand."""

        def depth(points: Floats) -> float:
            deepest = 0.0
            for other in self.items:
                if other is not item:
                    local = (points - other.at) @ other.T[:3, :3]
                    deepest = max(deepest, float(-other.thing.solid.distance(local).min()))
            opposite = self.other(arm)
            hand = self.person.proxy.placed(
                opposite.T[None], opposite.angles.target[None], opposite.side
            )[0]
            near = np.linalg.norm(points[:, None, :] - hand[None, ::3], axis=-1).min()
            return max(deepest, 0.012 - float(near))

        return self.grasp_at(arm, item, depth)

    def grasp_at(self, arm: Arm, item: Item, avoid: Avoid | None) -> Grasp | None:
        """A grasp of an item where its movements end; see ``person.grasp_of``."""
        return grasp_of(self.person, arm.side, item.thing, item.T, avoid)

    # ---------------------------------------------------------------- evaluation

    def item_poses(self, times: Floats, seed: int) -> list[Floats]:
        """T_work_from_thing (T, 4, 4) of every item, with the tremor of the hand that holds it."""
        rng = np.random.default_rng([seed, 1])
        return [trembling(i.track.at(times), times, i.aloft, rng, 0.0009) for i in self.items]

    def hands(
        self, times: Floats, item_poses: Sequence[Floats], seed: int
    ) -> tuple[dict[Side, Floats], dict[Side, Floats]]:
        """T_work_from_wrist (T, 4, 4) and angles (T, 21) of both hands."""
        rng = np.random.default_rng([seed, 2])
        wrists: dict[Side, Floats] = {}
        angles: dict[Side, Floats] = {}
        for side, arm in self.arms.items():
            wrist, loose = np.zeros((len(times), 4, 4)), np.zeros(len(times))
            ends = [*(span.start for span in arm.spans[1:]), np.inf]
            for span, stop in zip(arm.spans, ends, strict=True):
                now = (times >= span.start) & (times < stop)
                if span.track is not None:
                    free = (max(span.start, float(times[0]) - 9), min(stop, float(times[-1]) + 9))
                    loose = np.maximum(loose, envelope(times, *free, 0.5))
                    poses = trembling(span.track.at(times), times, [free], rng, 0.0011)
                else:
                    assert span.item is not None
                    assert span.grasp is not None
                    number = self.items.index(span.item)
                    poses = item_poses[number] @ span.grasp.T_thing_from_wrist
                wrist[now] = poses[now]
            play = smooth_noise(rng, times, arm.angles.target.size, 1.5) * loose[:, None]
            wrists[side], angles[side] = wrist, arm.angles.at(times) + 0.9 * play
        return wrists, angles


def _idle_pose(
    person: Person,
    side: Side,
    rng: np.random.Generator,
    where: str,
    items: Sequence[Item],
    time: float,
) -> tuple[Floats, Floats]:
    """Angles and T_work_from_wrist of a hand that does nothing, not on top of a thing."""
    loose = person.posture("relaxed", side, time, again=100)
    if where == "lap":
        return loose, person.lap(side, rng)
    angles = person.posture(where, side, time)
    soon = time + np.linspace(0.3, 4.0, 8)
    best, least = np.eye(4), np.inf
    for _ in range(12):
        T = person.resting(side, rng, where, angles)
        hand = person.proxy.placed(T[None], angles[None], side)
        hands = np.broadcast_to(hand, (len(soon), *hand.shape[1:]))
        depth = float(sum(depths(i.thing, i.track.at(soon), hands).max() for i in items))
        if depth < least:
            best, least = T, depth
    return (angles, best) if least < 0.006 else (loose, person.lap(side, rng))
