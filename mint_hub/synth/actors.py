"""Who takes part in a plan: arms and things with their movements, and what is said of them.

Workplace frame as in ``person``; times in seconds.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mint_hub.conventions import Side
from mint_hub.geometry.rotations import rotvec_to_matrix
from mint_hub.synth.grasps import Grasp
from mint_hub.synth.motion import AngleTrack, PoseTrack, envelope, smooth_noise
from mint_hub.synth.things import Thing

__all__ = ["Arm", "Item", "Mark", "Plan", "Said", "Span", "depths", "trembling"]

Floats = NDArray[np.float64]
Plan = list[tuple[Floats, float, float, Floats]]
"""Submovements in a row: target, start, duration, detour."""


@dataclass(frozen=True)
class Said:
    """A sentence about a stretch of time."""

    text: str
    side: str
    start: float
    end: float


@dataclass(eq=False)
class Item:
    """A thing in play: its movement, when it is in the air, when it is free again."""

    thing: Thing
    track: PoseTrack
    aloft: list[tuple[float, float]] = field(default_factory=list[tuple[float, float]])
    free_at: float = -np.inf
    used: int = 0
    buried: bool = False

    @property
    def T(self) -> Floats:  # noqa: N802
        """T_work_from_thing (4, 4) where its movements end."""
        return self.track.target

    @property
    def at(self) -> Floats:
        """Where it will stand, (3,)."""
        return self.T[:3, 3]


@dataclass(eq=False)
class Span:
    """A stretch of an arm's time: moving freely along ``track``, or holding ``item``."""

    start: float
    track: PoseTrack | None = None
    item: Item | None = None
    grasp: Grasp | None = None


@dataclass(eq=False)
class Arm:
    """One arm: stretches of free movement and of holding, and its fingers."""

    side: Side
    spans: list[Span]
    angles: AngleTrack
    free_at: float
    idle: str = "rest"

    @property
    def T(self) -> Floats:  # noqa: N802
        """T_work_from_wrist (4, 4) where its movements end."""
        last = self.spans[-1]
        if last.track is not None:
            return last.track.target
        assert last.item is not None
        assert last.grasp is not None
        return last.item.T @ last.grasp.T_thing_from_wrist

    @property
    def held(self) -> Item | None:
        """What it holds in the end."""
        return self.spans[-1].item


@dataclass(frozen=True, eq=False)
class Mark:
    """A state of the plan."""

    items: list[Any]
    arms: dict[Side, Any]
    said: int
    gaze: int


def depths(thing: Thing, T: Floats, points: Floats, radius: float = 0.0) -> Floats:
    """How deep points (T, P, 3), or balls around them, are in a thing at ``T`` (T, 4, 4): (T,)."""
    local = (points - T[:, None, :3, 3]) @ T[:, :3, :3]
    reach = np.hypot(thing.radius, thing.height / 2) + 0.01 + radius
    near = np.linalg.norm(local - [0, 0, thing.height / 2], axis=-1) < reach
    depth = np.zeros(points.shape[:2])
    if near.any():
        depth[near] = radius - thing.solid.distance(local[near])
    return np.maximum(depth.max(1), 0.0)


def trembling(
    poses: Floats,
    times: Floats,
    spans: list[tuple[float, float]],
    rng: np.random.Generator,
    size_m: float,
) -> Floats:
    """Add band-limited noise to poses (T, 4, 4) inside the given times."""
    strength = np.zeros(len(times))
    for start, stop in spans:
        strength = np.maximum(strength, envelope(times, start, stop, 0.4))
    noise = smooth_noise(rng, times, 6, 4.0) * strength[:, None]
    out = np.array(poses)
    out[:, :3, 3] += size_m * noise[:, :3]
    turns = np.asarray(rotvec_to_matrix(np.deg2rad(0.4) * noise[:, 3:]))
    out[:, :3, :3] = turns @ out[:, :3, :3]
    return out
