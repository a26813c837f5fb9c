"""How far a point is from a thing: exact signed distances of turned, boxed and rod-like bodies.

Metres, the thing's own frame (it stands on the origin, as the meshes of ``meshes`` do); negative
inside. Distances are what grasps are closed on and what collisions are counted with.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

__all__ = ["Block", "Raised", "Rod", "Solid", "Turned", "Union", "gradient", "turned"]

Floats = NDArray[np.float64]


class Solid(Protocol):
    """Anything that knows its signed distance."""

    def distance(self, points: Floats) -> Floats:
        """Signed distance: (..., 3) -> (...)."""
        ...


@dataclass(frozen=True)
class Turned:
    """A closed profile of (radius, height) turned about z.

    Attributes:
        profile: corners of the polygon, on the axis (radius 0) at both ends; its last side, along
            the axis, is implied.

    """

    profile: tuple[tuple[float, float], ...]

    def distance(self, points: Floats) -> Floats:
        """Signed distance: (..., 3) -> (...)."""
        flat = np.stack([np.hypot(points[..., 0], points[..., 1]), points[..., 2]], -1)
        return _polygon_distance(flat, np.asarray(self.profile, float))


@dataclass(frozen=True)
class Raised:
    """A closed outline in x and y raised from z = 0 to ``height``."""

    outline: tuple[tuple[float, float], ...]
    height: float

    def distance(self, points: Floats) -> Floats:
        """Signed distance: (..., 3) -> (...)."""
        corners = np.asarray((*self.outline, self.outline[0]), float)
        across = _polygon_distance(points[..., :2], corners)
        over = np.abs(points[..., 2] - self.height / 2) - self.height / 2
        outside = np.hypot(np.maximum(across, 0), np.maximum(over, 0))
        return outside + np.minimum(np.maximum(across, over), 0)


@dataclass(frozen=True)
class Block:
    """A box standing on the origin, shifted by ``at``, its edges rounded by ``radius``."""

    size: tuple[float, float, float]
    radius: float = 0.0
    at: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def distance(self, points: Floats) -> Floats:
        """Signed distance: (..., 3) -> (...)."""
        half = np.asarray(self.size, float) / 2
        centre = np.asarray(self.at, float) + half * (0, 0, 1)
        beyond = np.abs(points - centre) - (half - self.radius)
        outside = np.linalg.norm(np.maximum(beyond, 0), axis=-1)
        return outside + np.minimum(beyond.max(-1), 0) - self.radius


@dataclass(frozen=True)
class Rod:
    """All points within ``radius`` of the line from ``start`` to ``end``."""

    start: tuple[float, float, float]
    end: tuple[float, float, float]
    radius: float

    def distance(self, points: Floats) -> Floats:
        """Signed distance: (..., 3) -> (...)."""
        a, along = np.asarray(self.start, float), np.subtract(self.end, self.start)
        offset = points - a
        share = np.clip(offset @ along / max(float(along @ along), 1e-18), 0, 1)
        return np.linalg.norm(offset - share[..., None] * along, axis=-1) - self.radius


@dataclass(frozen=True)
class Union:
    """Several solids as one."""

    parts: tuple[Solid, ...]

    def distance(self, points: Floats) -> Floats:
        """Signed distance: (..., 3) -> (...)."""
        return np.min([part.distance(points) for part in self.parts], axis=0)


def turned(profile: Sequence[tuple[float, float]]) -> Turned:
    """Make a `Turned` of a profile that may begin and end off the axis."""
    line = [(float(r), float(z)) for r, z in profile]
    if line[0][0] > 0:
        line.insert(0, (0.0, line[0][1]))
    if line[-1][0] > 0:
        line.append((0.0, line[-1][1]))
    return Turned(tuple(line))


def _polygon_distance(flat: Floats, corners: Floats) -> Floats:
    """Signed distance (...) of (..., 2) to the sides of a polygon (N, 2), the last not implied.

    Inside is told by counting the sides to the right of a point.
    """
    ax, ay = corners[:-1].T
    dx, dy = np.diff(corners, axis=0).T
    u, v = flat[..., 0, None] - ax, flat[..., 1, None] - ay
    share = np.clip((u * dx + v * dy) / np.maximum(dx * dx + dy * dy, 1e-18), 0.0, 1.0)
    away_u, away_v = u - share * dx, v - share * dy
    near = np.sqrt((away_u * away_u + away_v * away_v).min(-1))
    spans = ((v >= 0) & (v < dy)) | ((v < 0) & (v >= dy))
    beyond = v * dx / np.where(np.abs(dy) < 1e-12, 1.0, dy) > u
    return np.where((spans & beyond).sum(-1) % 2 == 1, -near, near)


def gradient(solid: Solid, points: Floats, step: float = 1e-4) -> Floats:
    """Direction away from the surface, (..., 3) unit, by central differences."""
    shifts = step * np.eye(3)
    slope = np.stack(
        [solid.distance(points + s) - solid.distance(points - s) for s in shifts], axis=-1
    )
    return slope / np.maximum(np.linalg.norm(slope, axis=-1, keepdims=True), 1e-12)
