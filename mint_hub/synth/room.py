"""The room around the table: floor, walls, furniture, clutter, light; drawn anew for every clip.

Everything is made in the workplace frame (see ``person``), the floor at z = -table height. Sizes of
table, room and things are drawn independently: no length of the picture tells another.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mint_hub.geometry.rigid import rigid
from mint_hub.geometry.rotations import rotvec_to_matrix
from mint_hub.synth import meshes
from mint_hub.synth.presets import Preset
from mint_hub.synth.things import Thing, make_thing
from mint_hub.synth.world import Body, Colour, Light, Mesh, Texture, TextureKind

__all__ = ["Painter", "Room", "draw_room", "lights", "standing"]

Floats = NDArray[np.float64]

_COLOURS: Final[dict[str, Colour]] = {
    "red": (0.50, 0.05, 0.04),
    "orange": (0.72, 0.24, 0.04),
    "yellow": (0.76, 0.56, 0.08),
    "green": (0.10, 0.33, 0.10),
    "blue": (0.06, 0.15, 0.48),
    "purple": (0.24, 0.08, 0.33),
    "pink": (0.70, 0.28, 0.33),
    "turquoise": (0.07, 0.38, 0.38),
    "brown": (0.22, 0.11, 0.05),
    "white": (0.74, 0.73, 0.70),
    "grey": (0.30, 0.30, 0.31),
    "black": (0.035, 0.035, 0.04),
}
_WALLS: Final[tuple[Colour, ...]] = (
    (0.72, 0.70, 0.65),
    (0.62, 0.66, 0.68),
    (0.66, 0.58, 0.46),
    (0.50, 0.58, 0.50),
    (0.42, 0.48, 0.58),
    (0.68, 0.52, 0.46),
    (0.35, 0.36, 0.38),
)
_FLOORS: Final[tuple[Colour, ...]] = (
    (0.34, 0.20, 0.11),
    (0.20, 0.12, 0.07),
    (0.40, 0.38, 0.35),
    (0.24, 0.25, 0.27),
    (0.46, 0.36, 0.25),
    (0.15, 0.19, 0.24),
)
_TABLES: Final[tuple[Colour, ...]] = (
    (0.42, 0.25, 0.13),
    (0.26, 0.14, 0.07),
    (0.56, 0.42, 0.27),
    (0.66, 0.65, 0.62),
    (0.20, 0.21, 0.23),
    (0.12, 0.16, 0.20),
    (0.50, 0.30, 0.22),
    (0.30, 0.36, 0.32),
)


@dataclass(frozen=True, eq=False)
class Painter:
    """Draws textures of a preset."""

    rng: np.random.Generator
    preset: Preset

    def surface(self, base: Colour, frequency: tuple[float, float] = (3, 9)) -> Texture:
        """A texture for something large, near to a colour."""
        return self._made(self.preset.surfaces, base, 0.62, frequency, (0.55, 0.95))

    def paint(self) -> tuple[str, Texture]:
        """A texture for a thing, and the word for its colour."""
        name = str(self.rng.choice(list(_COLOURS)))
        return name, self._made(self.preset.paints, _COLOURS[name], None, (2, 9), (0.25, 0.9))

    def cloth(self) -> Texture:
        """A texture for a sleeve."""
        base = _COLOURS[str(self.rng.choice(list(_COLOURS)))]
        kinds: tuple[TextureKind, ...] = (
            ("fabric", "stripes") if "fabric" in self.preset.surfaces else ("checker", "speckle")
        )
        return self._made(kinds, base, 0.6, (4, 16), (0.85, 1.0))

    def _made(
        self,
        kinds: Sequence[TextureKind],
        base: Colour,
        second: float | None,
        frequency: tuple[float, float],
        roughness: tuple[float, float],
    ) -> Texture:
        rng = self.rng
        a = np.clip(np.array(base) * rng.uniform(0.75, 1.25, 3) * rng.uniform(0.7, 1.2), 0.01, 0.85)
        if second is None:
            other = np.array(_COLOURS[str(rng.choice(list(_COLOURS)))])
            b = np.clip(other * rng.uniform(0.6, 1.2), 0.01, 0.85)
            b = a + rng.uniform(0.25, 0.9) * (b - a)
        else:
            b = np.clip(a * rng.uniform(second - 0.15, second + 0.25), 0.01, 0.85)
        kind = kinds[int(rng.integers(len(kinds)))]
        return Texture(
            kind,
            _colour(a),
            _colour(b),
            float(rng.uniform(*frequency)),
            int(rng.integers(1 << 16)),
            float(rng.uniform(*roughness)),
        )


def _colour(values: Floats) -> Colour:
    return float(values[0]), float(values[1]), float(values[2])


def standing(x: float, y: float, z: float = 0.0, yaw: float = 0.0) -> Floats:
    """T (4, 4) of something that stands at a place, turned about z."""
    turn = np.asarray(rotvec_to_matrix(np.array([0.0, 0.0, yaw])))
    return np.asarray(rigid(turn, np.array([x, y, z])))


@dataclass(frozen=True, eq=False)
class Room:
    """What stands still, in the workplace frame, and the size of the table.

    ``clutter`` are the things on the table that nobody touches, with their poses.
    """

    bodies: tuple[Body, ...]
    clutter: tuple[tuple[Thing, Floats], ...]
    table_size: tuple[float, float]
    table_height: float


def draw_room(rng: np.random.Generator, preset: Preset) -> Room:
    """Draw a room with a table and clutter on its far parts."""
    painter = Painter(rng, preset)
    width, depth = rng.uniform(0.95, 1.9), rng.uniform(0.58, 0.95)
    height = rng.uniform(0.66, 1.02)
    bodies = [*_shell(rng, painter, depth, height), *_furniture(rng, painter, depth, height)]
    base = _TABLES[int(rng.integers(len(_TABLES)))]
    top = meshes.table(
        (width, depth, height), painter.surface(base, (3, 8)), rng.uniform(0.02, 0.05)
    )
    bodies.append(Body(top, standing(0, depth / 2, -height)))
    if rng.random() < 0.35:  # a place mat or a tablecloth, thin enough to lie under everything
        size = (rng.uniform(0.45, 0.9) * width, rng.uniform(0.4, 0.85) * depth)
        _, texture = painter.paint()
        mat = meshes.plane(size, texture, rng.uniform(0.15, 0.4), "mat")
        bodies.append(Body(mat, standing(rng.uniform(-0.1, 0.1), depth / 2, 0.0006)))
    clutter = _clutter(rng, painter, preset, width, depth)
    return Room(tuple(bodies), tuple(clutter), (width, depth), height)


def _shell(rng: np.random.Generator, painter: Painter, depth: float, height: float) -> list[Body]:
    """Floor, ceiling and four walls, seen from inside."""
    back = depth + (rng.uniform(0.02, 0.3) if rng.random() < 0.4 else rng.uniform(0.6, 3.0))
    front, left, right = -rng.uniform(1.0, 3.0), -rng.uniform(1.2, 3.5), rng.uniform(1.2, 3.5)
    tall = rng.uniform(2.3, 3.2)
    wall_base = _WALLS[int(rng.integers(len(_WALLS)))]
    floor = painter.surface(_FLOORS[int(rng.integers(len(_FLOORS)))], (4, 10))
    wide, deep = right - left, back - front
    x, y = (left + right) / 2, (front + back) / 2
    repeat = rng.uniform(0.7, 1.6)
    bodies = [
        Body(meshes.plane((wide, deep), floor, repeat, "floor"), standing(x, y, -height)),
    ]
    ceiling = Texture("plaster", (0.75, 0.75, 0.73), (0.7, 0.7, 0.68), 6.0, 1, 1.0)
    over = np.diag([1.0, -1.0, -1.0, 1.0])
    over[:3, 3] = x, y, tall - height
    if "plaster" in painter.preset.surfaces:
        bodies.append(Body(meshes.plane((wide, deep), ceiling, 2.0, "ceiling"), over))
    else:
        bodies.append(Body(meshes.plane((wide, deep), floor, 2.0, "ceiling"), over))
    walls = (
        ((x, back), (0.0, -1.0), wide),
        ((x, front), (0.0, 1.0), wide),
        ((left, y), (1.0, 0.0), deep),
        ((right, y), (-1.0, 0.0), deep),
    )
    for (px, py), (nx, ny), length in walls:
        texture = painter.surface(wall_base, (3, 9))
        mesh = meshes.plane((length, tall), texture, rng.uniform(0.6, 1.6), "wall")
        normal, up = np.array([nx, ny, 0.0]), np.array([0.0, 0.0, 1.0])
        R = np.stack([np.cross(up, normal), up, normal], -1)
        at = np.array([px, py, tall / 2 - height])
        bodies.append(Body(mesh, np.asarray(rigid(R, at))))
        for _ in range(int(rng.integers(0, 4))):
            bodies.append(_picture(rng, painter, R, at, length))
    return bodies


def _picture(
    rng: np.random.Generator, painter: Painter, R: Floats, at: Floats, length: float
) -> Body:
    size = (rng.uniform(0.25, 0.9), rng.uniform(0.25, 0.8), rng.uniform(0.012, 0.04))
    _, texture = painter.paint()
    offset = R @ np.array([rng.uniform(-0.4, 0.4) * length, rng.uniform(-0.35, 0.6), 0.0])
    return Body(meshes.box(size, texture, None, "picture"), np.asarray(rigid(R, at + offset)))


def _furniture(
    rng: np.random.Generator, painter: Painter, depth: float, height: float
) -> list[Body]:
    """Cupboards, boxes and a second table on the floor around."""
    bodies: list[Body] = []
    for _ in range(int(rng.integers(2, 7))):
        size = (rng.uniform(0.3, 1.1), rng.uniform(0.3, 0.6), rng.uniform(0.3, 1.7))
        base = _TABLES[int(rng.integers(len(_TABLES)))]
        mesh = meshes.rounded_box(size, 0.01, painter.surface(base), 0.8, "cupboard", 2)
        side = rng.choice([-1, 1])
        if rng.random() < 0.5:
            place = (side * rng.uniform(1.4, 2.4), rng.uniform(-0.4, 2.2))
        else:
            place = (rng.uniform(-1.8, 1.8), depth + rng.uniform(0.5, 2.0))
        turn = float(rng.choice([0, np.pi / 2])) + rng.normal(0, 0.1)
        bodies.append(Body(mesh, standing(*place, -height, turn)))
    return bodies


def _clutter(
    rng: np.random.Generator, painter: Painter, preset: Preset, width: float, depth: float
) -> list[tuple[Thing, Floats]]:
    """Things on the table out of the way: beside and behind where hands work."""
    placed: list[tuple[Thing, Floats]] = []
    for _ in range(int(rng.integers(3, 15))):
        kind = preset.kinds[int(rng.integers(len(preset.kinds)))]
        colour, texture = painter.paint()
        thing = make_thing(kind, rng, texture, colour)
        r = thing.radius
        for _ in range(12):
            x = rng.uniform(-width / 2 + r, width / 2 - r)
            y = rng.uniform(min(0.1, depth / 4) + r, max(depth - r, r + 0.2))
            beside = abs(x) > 0.46 + r
            behind = y > 0.56 + r and y < depth - r
            gaps = [np.hypot(x - T[0, 3], y - T[1, 3]) - t.radius - r for t, T in placed]
            if (beside or behind) and min(gaps, default=1.0) > 0.01:
                placed.append((thing, standing(x, y, 0.0, rng.uniform(0, 2 * np.pi))))
                break
    return placed


def lights(rng: np.random.Generator) -> tuple[Light, ...]:
    """One or two distant lights from above, warm or cold, and what the room gives back."""
    warm = rng.uniform(-0.12, 0.16)
    tint = np.array([1 + warm, 1.0, 1 - 1.2 * warm])
    ambient = rng.uniform(0.30, 0.55)
    azimuth = rng.uniform(0, 2 * np.pi)
    slant = rng.uniform(0.25, 1.1)
    direction = (slant * np.cos(azimuth), slant * np.sin(azimuth), -1.0)
    main = Light(
        (float(direction[0]), float(direction[1]), -1.0),
        _colour(tint * rng.uniform(0.55, 1.0)),
        _colour(ambient * (0.6 * tint + 0.4)),
    )
    if rng.random() < 0.5:
        return (main,)
    azimuth += rng.uniform(1.5, 4.5)
    fill = Light(
        (float(0.9 * np.cos(azimuth)), float(0.9 * np.sin(azimuth)), -1.0),
        _colour((2 - tint) * rng.uniform(0.12, 0.4)),
        (0.0, 0.0, 0.0),
        bool(rng.random() < 0.6),
    )
    return main, fill


def posed(mesh: Mesh, poses: Floats, movable: bool) -> Body:
    """A body whose pose is constant when ``poses`` (T, 4, 4) do not change."""
    if (poses == poses[0]).all():
        return Body(mesh, poses[0], movable)
    return Body(mesh, poses, movable)
