"""Smooth motion: minimum-jerk submovements that overlap, and the tremor of a living hand.

A movement is a sum of submovements, each of which goes from the previous target to its own with the
minimum-jerk time course (Flash and Hogan 1985); one may begin before the last has ended, which
rounds the path the way a hand rounds it (Flash and Henis 1991). Where all have ended, the pose is
the last target exactly: what is grasped there is grasped exactly.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from mint_hub.geometry.rigid import rigid
from mint_hub.geometry.rotations import matrix_to_rotvec, rotvec_to_matrix

__all__ = ["AngleTrack", "PoseTrack", "envelope", "minimum_jerk", "smooth_noise"]

Floats = NDArray[np.float64]


def minimum_jerk(share: Floats) -> Floats:
    """Position from 0 to 1 over the time from 0 to 1; flat outside."""
    s = np.clip(share, 0.0, 1.0)
    return s**3 * (10 - 15 * s + 6 * s * s)


def _bump(share: Floats) -> Floats:
    s = np.clip(share, 0.0, 1.0)
    return 64 * (s * (1 - s)) ** 3


@dataclass(frozen=True, eq=False)
class _Move:
    start: float
    duration: float
    shift: Floats  # of position, or of angles
    turn: Floats  # rotation vector, in the frame of the pose before
    arc: Floats  # detour at half way


@dataclass(eq=False)
class PoseTrack:
    """A pose over time: where it begins, and its submovements."""

    origin: Floats
    moves: list[_Move] = field(default_factory=list[_Move])
    target: Floats = field(init=False)
    end: float = field(init=False, default=-np.inf)

    def __post_init__(self) -> None:
        self.target = np.array(self.origin, float)

    def to(self, T: Floats, start: float, duration: float, arc: Floats | None = None) -> float:
        """Go to ``T`` (4, 4) by a submovement; returns when it ends."""
        turn = matrix_to_rotvec(self.target[:3, :3].T @ T[:3, :3])
        shift = T[:3, 3] - self.target[:3, 3]
        detour = np.zeros(3) if arc is None else np.asarray(arc, float)
        self.moves.append(_Move(start, duration, shift, turn, detour))
        self.target = np.array(T, float)
        self.end = max(self.end, start + duration)
        return start + duration

    def mark(self) -> tuple[int, Floats, float]:
        """State for `back_to`."""
        return len(self.moves), self.target.copy(), self.end

    def back_to(self, moves: int, target: Floats, end: float) -> None:
        """Forget all submovements since `mark`."""
        del self.moves[moves:]
        self.target, self.end = target.copy(), end

    def at(self, times: Floats) -> Floats:
        """Poses (T, 4, 4) at ``times`` (T,)."""
        times = np.asarray(times, float)
        position = np.tile(np.asarray(self.origin[:3, 3], float), (len(times), 1))
        rotation = np.tile(np.asarray(self.origin[:3, :3], float), (len(times), 1, 1))
        for move in self.moves:
            share = (times - move.start) / move.duration
            done = minimum_jerk(share)[:, None]
            position = position + done * move.shift + _bump(share)[:, None] * move.arc
            if np.abs(move.turn).max() > 1e-9:
                rotation = rotation @ rotvec_to_matrix(done * move.turn)
        return np.asarray(rigid(rotation, position))


@dataclass(eq=False)
class AngleTrack:
    """Joint angles over time, the same way."""

    origin: Floats
    moves: list[tuple[float, float, Floats]] = field(
        default_factory=list[tuple[float, float, Floats]]
    )
    target: Floats = field(init=False)

    def __post_init__(self) -> None:
        self.target = np.array(self.origin, float)

    def to(self, angles: Floats, start: float, duration: float) -> None:
        """Go to ``angles`` by a submovement."""
        self.moves.append((start, duration, angles - self.target))
        self.target = np.array(angles, float)

    def at(self, times: Floats) -> Floats:
        """Angles (T, N) at ``times`` (T,)."""
        out = np.tile(self.origin, (len(times), 1)).astype(float)
        for start, duration, shift in self.moves:
            out = out + minimum_jerk((np.asarray(times) - start) / duration)[:, None] * shift
        return out


def smooth_noise(rng: np.random.Generator, times: Floats, size: int, cutoff_hz: float) -> Floats:
    """Band-limited noise (T, size) of deviation 1: a sum of twelve sines below ``cutoff_hz``."""
    count = 12
    frequency = cutoff_hz * np.sqrt(rng.uniform(0.01, 1.0, (count, size)))
    phase = rng.uniform(0, 2 * np.pi, (count, size))
    waves = np.sin(2 * np.pi * frequency * np.asarray(times)[:, None, None] + phase)
    return waves.sum(1) * np.sqrt(2 / count)


def envelope(times: Floats, start: float, stop: float, ramp: float = 0.25) -> Floats:
    """1 between ``start`` and ``stop``, 0 at both and beyond, with smooth ramps inside, (T,)."""
    t = np.asarray(times, float)
    ramp = max(min(ramp, (stop - start) / 2), 1e-6)
    return minimum_jerk((t - start) / ramp) * minimum_jerk((stop - t) / ramp)
