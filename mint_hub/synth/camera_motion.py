"""How the head moves: it follows the work with its gaze, sways, bobs, and now and then turns away.

Workplace frame as in ``person``; the camera's axes are OpenCV's.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mint_hub.geometry.rigid import rigid
from mint_hub.geometry.rotations import geodesic_angle, rotvec_to_matrix
from mint_hub.synth.motion import minimum_jerk, smooth_noise

__all__ = ["HeadStyle", "camera_path", "draw_style", "median_steps"]

Floats = NDArray[np.float64]

TURN_RAD_S: Final = float(np.deg2rad(90))
"""Fastest turn of the head that follows the work: three degrees a frame."""

QUICK_TURN_RAD_S: Final = float(np.deg2rad(170))
"""Fastest turn of a quick look elsewhere and back."""


@dataclass(frozen=True, eq=False)
class HeadStyle:
    """One person's way of moving the head, in one clip.

    Attributes:
        eye: (3,) mean position.
        lift: radians that the camera looks above the point of gaze.
        follow: how much of a gaze shift the head makes, 0 to 1.
        lean: (3,) metres of slow sway.
        bob: metres of the bob of steps; 0: standing still.
        step_hz: steps a second.
        jitter: radians of small quick turns.
        away: times and (3,) points of quick looks elsewhere, with how long they last.
        seed: of all noise.

    """

    eye: Floats
    lift: float
    follow: float
    lean: Floats
    bob: float
    step_hz: float
    jitter: float
    away: tuple[tuple[float, Floats, float], ...]
    seed: int


def draw_style(
    rng: np.random.Generator, eye: Floats, sway: float, fov_v_rad: float, duration: float
) -> HeadStyle:
    """Draw a style; ``sway`` scales its movements."""
    away: list[tuple[float, Floats, float]] = []
    for _ in range(int(rng.choice([0, 1, 2], p=[0.55, 0.33, 0.12]))):
        point = np.array([rng.choice([-1, 1]) * rng.uniform(0.4, 0.9), rng.uniform(0.4, 0.9), 0.0])
        point[2] = rng.uniform(-0.2, 0.3)
        away.append(
            (float(rng.uniform(0.3, max(0.4, duration - 0.8))), point, float(rng.uniform(0.3, 0.9)))
        )
    return HeadStyle(
        eye=eye,
        lift=float(rng.uniform(-0.08, 0.10)) * fov_v_rad,
        follow=float(rng.uniform(0.5, 0.85)),
        lean=sway * np.array([rng.uniform(0.02, 0.06), rng.uniform(0.015, 0.04), 0.012]),
        bob=float(sway * rng.uniform(0.004, 0.014) * (rng.random() < 0.6)),
        step_hz=float(rng.uniform(1.4, 2.0)),
        jitter=float(np.deg2rad(sway * rng.uniform(0.3, 1.0))),
        away=tuple(sorted(away, key=lambda a: a[0])),
        seed=int(rng.integers(1 << 31)),
    )


def camera_path(
    style: HeadStyle, gaze: Sequence[tuple[float, Floats]], times: Floats, strength: float = 1.0
) -> Floats:
    """T_camera_from_work (T, 4, 4).

    Args:
        style: of the head.
        gaze: when the eyes go where, (3,) metres.
        times: (T,) seconds.
        strength: factor on sway, bob and jitter.

    """
    rng = np.random.default_rng(style.seed)
    t = np.asarray(times, float)
    eye = style.eye + strength * style.lean * smooth_noise(rng, t, 3, 0.75)
    phase = rng.uniform(0, 2 * np.pi)
    step = 2 * np.pi * style.step_hz * t + phase
    bob = np.stack([0.9 * np.sin(step / 2), 0.3 * np.cos(step), np.sin(step)], -1)
    eye = eye + strength * style.bob * bob
    target = _gaze_path(style, gaze, t, rng)
    target = target + strength * 0.012 * smooth_noise(rng, t, 3, 0.9)
    level = _level(target - eye)
    wobble = strength * style.jitter * smooth_noise(rng, t, 3, 2.2)
    roll = np.deg2rad(rng.uniform(-4, 4)) + np.deg2rad(2.0) * smooth_noise(rng, t, 1, 0.5)[:, 0]
    tilt = np.stack([-style.lift + 0 * t, 0 * t, roll], -1)
    rotation = np.asarray(rotvec_to_matrix(tilt)) @ np.asarray(rotvec_to_matrix(wobble)) @ level
    return np.asarray(rigid(rotation, -(rotation @ eye[..., None])[..., 0]))


def _gaze_path(
    style: HeadStyle, gaze: Sequence[tuple[float, Floats]], t: Floats, rng: np.random.Generator
) -> Floats:
    """Point that the head turns to, (T, 3): overlapping minimum-jerk shifts."""
    centre = np.array([0.0, 0.26, 0.03])
    events: list[tuple[float, Floats, float, float]] = []
    for time, point in sorted(gaze, key=lambda g: g[0]):
        goal = centre + style.follow * (point - centre)
        events.append((time, goal, float(rng.uniform(0.45, 0.75)), TURN_RAD_S))
    for start, point, stay in style.away:
        before = [e for e in events if e[0] <= start]
        back = before[-1][1] if before else centre
        there = _duration(style.eye, back, point, 0.34, QUICK_TURN_RAD_S)
        gone = start + there + stay
        events = [e for e in events if not start - 0.1 < e[0] < gone + 0.3]
        events += [(start, point, 0.34, QUICK_TURN_RAD_S), (gone, back, 0.40, QUICK_TURN_RAD_S)]
    events.sort(key=lambda e: e[0])
    past = [e for e in events if e[0] < float(t[0]) - 1.2]
    at = past[-1][1] if past else centre
    path = np.tile(at, (len(t), 1)).astype(float)
    free = -np.inf
    for time, goal, least, speed in events[len(past) :]:
        duration = _duration(style.eye, at, goal, least, speed)
        begin = max(time, free)  # the next shift waits for most of this one: speeds do not add
        path = path + minimum_jerk((t - begin) / duration)[:, None] * (goal - at)
        free, at = begin + 0.75 * duration, goal
    return path


def _duration(eye: Floats, start: Floats, stop: Floats, least: float, speed: float) -> float:
    """Seconds of a shift of gaze whose fastest turn is at most ``speed``, radians a second."""
    u = np.linspace(0, 1, 65)
    level = _level(start + minimum_jerk(u)[:, None] * (stop - start) - eye)
    fastest = float(np.max(geodesic_angle(level[1:], level[:-1]))) * (len(u) - 1)
    return max(least, fastest / speed)


def _level(ahead: Floats) -> Floats:
    """Rotations (T, 3, 3), camera from workplace, that look along (T, 3) with a level horizon."""
    ahead = ahead / np.linalg.norm(ahead, axis=-1, keepdims=True)
    right: Floats = np.cross(ahead, np.array([0.0, 0.0, 1.0]))
    right /= np.linalg.norm(right, axis=-1, keepdims=True)
    down: Floats = np.cross(ahead, right)
    return np.stack([right, down, ahead], -2)


def median_steps(T_camera_from_work: Floats) -> tuple[float, float]:
    """Median motion of a camera from frame to frame: metres, degrees."""
    R = T_camera_from_work[:, :3, :3]
    centre = -(np.swapaxes(R, 1, 2) @ T_camera_from_work[:, :3, 3:])[..., 0]
    metres = np.linalg.norm(np.diff(centre, axis=0), axis=-1)
    turned = np.rad2deg(geodesic_angle(R[1:], R[:-1]))
    return float(np.median(metres)), float(np.median(turned))
