"""Where shadow maps look from: an orthographic view along each light, around what throws one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mint_hub.geometry.hand_state import unpack
from mint_hub.geometry.rigid import inverse, transform_points
from mint_hub.synth.world import Body, Light, World

LARGEST_M: Final = 4.0
"""A closed thing that is longer is a wall or ceiling, which no light would pass."""

FLAT_M: Final = 1e-3
"""What is thinner is a sheet, seen from its front alone: light passes it from behind."""

REACH_M: Final = 1.3
"""Shadows are drawn up to this far from the middle of the hands and objects."""

HAND_M: Final = 0.35
BELOW_M: Final = 6.0
"""How far behind what throws them shadows still fall."""

SKY: Final = Light((0.0, 0.0, -1.0), (0.0, 0.0, 0.0))
"""The light from everywhere, for its shadows: straight down."""


@dataclass(frozen=True, eq=False)
class ShadowView:
    """A shadow map's view.

    Attributes:
        shadow_from_world: (4, 4), to 0 .. 1 in all three coordinates.
        span_m: metres across the map.
        depth_m: metres from the nearest depth it shows, 0, to the furthest, 1.

    """

    shadow_from_world: NDArray[np.float64]
    span_m: float
    depth_m: float


def in_shadow_maps(body: Body) -> bool:
    """Whether a body is drawn into shadow maps: all but walls and ceilings that are closed."""
    size = np.ptp(body.mesh.vertices, axis=0)
    return bool(size.max() <= LARGEST_M or size.min() <= FLAT_M)


def _throws_shadow(body: Body) -> bool:
    size = np.ptp(body.mesh.vertices, axis=0)
    return bool(size.max() <= LARGEST_M and size.min() > FLAT_M)


def focus_of(world: World) -> NDArray[np.float64]:
    """Find the middle (3,) of the hands' paths and the objects, world."""
    points = _hand_points(world)
    for body in world.bodies:
        if body.is_object():
            points.append(np.atleast_3d(body.T_world_from_body).reshape(-1, 4, 4)[::10, :3, 3])
    if not points:
        return world.T_camera_from_world[0, :3, :3].T @ (
            np.array([0, 0, 0.5]) - world.T_camera_from_world[0, :3, 3]
        )
    return np.median(np.concatenate(points), axis=0)


def shadow_view(world: World, light: Light, focus: NDArray[np.float64]) -> ShadowView:
    """Fit a view along ``light`` to all that throws shadows within REACH_M, in every frame."""
    forward = np.asarray(light.direction, np.float64)
    forward = forward / np.linalg.norm(forward)
    helper = np.array([1.0, 0, 0]) if abs(forward[0]) < 0.8 else np.array([0, 1.0, 0])
    right = np.cross(helper, forward)
    right /= np.linalg.norm(right)
    R = np.stack([right, np.cross(forward, right), forward])
    points = [(p - focus) @ R.T for p in _caster_points(world)]
    low = np.min([p.min(0) for p in points], 0) if points else -np.ones(3)
    high = np.max([p.max(0) for p in points], 0) if points else np.ones(3)
    low, high = np.clip(low, -REACH_M, REACH_M), np.clip(high, -REACH_M, REACH_M)
    middle, span = (low + high) / 2, float((high - low)[:2].max()) * 1.02 + 0.02
    depth = high[2] - low[2] + 0.1 + BELOW_M
    T = np.eye(4)
    T[:3, :3] = R / np.array([span, span, depth])[:, None]
    shift = -R @ focus - [middle[0], middle[1], low[2] - 0.1]
    T[:3, 3] = shift / [span, span, depth] + [0.5, 0.5, 0.0]
    return ShadowView(T, span, depth)


def _hand_points(world: World) -> list[NDArray[np.float64]]:
    T_world_from_camera = inverse(world.T_camera_from_world)
    wrists = np.asarray(unpack(world.hands.hand_state).translation, np.float64)
    placed = transform_points(T_world_from_camera, wrists)
    there = placed[np.asarray(world.hands.exists, bool)]
    return [there] if len(there) else []


def _caster_points(world: World) -> list[NDArray[np.float64]]:
    """Corners of all that throws shadows, world, at every fifth pose."""
    points: list[NDArray[np.float64]] = []
    for body in filter(_throws_shadow, world.bodies):
        low, high = body.mesh.vertices.min(0), body.mesh.vertices.max(0)
        corners = np.array([[(low, high)[i >> a & 1][a] for a in range(3)] for i in range(8)])
        poses = body.T_world_from_body.reshape(-1, 4, 4)
        for T in poses[:: 5 if len(poses) > 1 else 1]:
            points.append(transform_points(T, corners.astype(np.float64)))
    for wrists in _hand_points(world):
        points += [wrists - HAND_M, wrists + HAND_M]
    return points
