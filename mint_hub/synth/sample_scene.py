"""What stands on the table of the sample clip: surfaces as triangles, textures as arithmetic.

Room frame: x right, y away from the person, z up, metres; the table top is z = 0. A texture is a
float32 RGB image (H, W, 3), 0..255; texture coordinates are its pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np

TABLE, WALL, FLOOR, SKIN, SLEEVE, MUG, BOX, BALL = range(8)
"""Labels of what a pixel shows; also the number of its texture."""

PLANES: Final = (
    (TABLE, (-0.75, 0.55, 0.0), (1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (1.5, 0.85), 1000.0),
    (WALL, (-3.0, 2.5, 1.6), (1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (6.0, 2.35), 200.0),
    (FLOOR, (-3.0, 2.5, -0.75), (1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (6.0, 3.0), 200.0),
)
"""Label, corner, axis of the texture's columns, of its rows, size (m), texture pixels a metre."""


@dataclass(frozen=True)
class Mesh:
    """Triangles of one texture: vertices (V, 3) metres, faces (F, 3), uv (V, 2)."""

    label: int
    vertices: np.ndarray
    faces: np.ndarray
    uv: np.ndarray


def tube(label: int, centers: np.ndarray, u: np.ndarray, v: np.ndarray, uv_scale: float) -> Mesh:
    """Rings ``centers + cos u + sin v`` (N, 3) joined to a surface, outwards where u x v leads on.

    A ring given twice makes a crease. Texture: once around; along, ``uv_scale`` pixels a metre.
    """
    segments = 36
    angle = np.linspace(0, 2 * np.pi, segments + 1)[:, None]
    rings = centers[:, None] + np.cos(angle) * u[:, None] + np.sin(angle) * v[:, None]
    steps = np.linalg.norm(np.diff(rings, axis=0), axis=-1).mean(1)
    along = np.concatenate([[0.0], np.cumsum(steps)]) * uv_scale
    uv = np.stack(np.broadcast_arrays(angle[:, 0] * (255 / (2 * np.pi)), along[:, None]), -1)
    a = (np.arange(len(centers) - 1)[:, None] * (segments + 1) + np.arange(segments)).ravel()
    b, c, d = a + 1, a + segments + 1, a + segments + 2
    faces = np.concatenate([np.stack([a, b, d], -1), np.stack([a, d, c], -1)])
    return Mesh(label, rings.reshape(-1, 3), faces, uv.reshape(-1, 2))


def turned(label: int, profile: Sequence[tuple[float, float]], uv_scale: float) -> Mesh:
    """Turn a profile of (radius, height) about the z axis."""
    radius, height = np.array(profile).T
    zero = np.zeros_like(radius)
    return tube(
        label,
        np.stack([zero, zero, height], -1),
        np.stack([radius, zero, zero], -1),
        np.stack([zero, radius, zero], -1),
        uv_scale,
    )


def mug() -> list[Mesh]:
    """Make a mug of 78 mm across and 98 mm high, its handle along -x, standing on the origin."""
    r, h, wall = 0.039, 0.098, 0.004
    outside = [(0.0, 0.0), (r, 0.0), (r, 0.0), *((r, h * i / 6) for i in range(7))]
    inside = [(r - wall, h), (r - wall, h), (r - wall, 0.01), (r - wall, 0.01), (0.0, 0.01)]
    angle = np.linspace(0.5 * np.pi, 1.5 * np.pi, 13)[:, None]
    radial = np.concatenate([np.cos(angle), 0 * angle, np.sin(angle)], -1)
    middle = np.array([-r + 0.003, 0.0, h / 2])
    across = np.broadcast_to([0.0, 0.008, 0.0], radial.shape)
    handle = tube(MUG, middle + radial * [0.026, 0, 0.029], across, 0.0045 * radial, 400.0)
    return [turned(MUG, outside + inside, 1000.0), handle]


def ball(radius: float) -> Mesh:
    """Make a sphere that lies on the origin."""
    angles = np.linspace(-np.pi / 2, np.pi / 2, 25)
    profile = [(radius * float(np.cos(a)), radius * (1 + float(np.sin(a)))) for a in angles]
    return turned(BALL, profile, 1000.0)


def box(size: tuple[float, float, float]) -> Mesh:
    """Make a box that stands on the origin; every side shows its own part of the texture."""
    corners, faces, uv = [], [], []
    for axis in range(3):
        for sign in (-1, 1):
            step = 1 if sign > 0 else 2
            a, b = (axis + step) % 3, (axis + 2 * step) % 3
            quad = np.full((4, 3), 0.5 * sign)
            quad[:, a], quad[:, b] = (-0.5, 0.5, 0.5, -0.5), (-0.5, -0.5, 0.5, 0.5)
            faces += [[len(corners) + i for i in t] for t in ((0, 1, 2), (0, 2, 3))]
            corners += list((quad + np.array([0, 0, 0.5])) * size)
            side, up = (0, 1) if axis == 2 else (1 - axis, 2)
            uv += [(256 * axis + 250 * (q[side] + 0.5), 250 * (0.5 - q[up])) for q in quad]
    return Mesh(BOX, np.array(corners), np.array(faces), np.array(uv))


def placed(mesh: Mesh, T_room_from_mesh: np.ndarray) -> Mesh:
    """Move a mesh by a rigid transform (4, 4)."""
    vertices = mesh.vertices @ T_room_from_mesh[:3, :3].T + T_room_from_mesh[:3, 3]
    return Mesh(mesh.label, vertices, mesh.faces, mesh.uv)


# ---------------------------------------------------------------- textures


def textures(seed: int) -> list[np.ndarray]:
    """One texture for each label, in the order of the labels."""
    rng = np.random.default_rng(seed)
    makers = (_table, _wall, _floor, _skin, _sleeve, _mug, _box, _ball)
    return [np.ascontiguousarray(make(rng), np.float32) for make in makers]


def _noise(rng: np.random.Generator, size_hw: tuple[int, int], sx: float, sy: float) -> np.ndarray:
    """Smooth noise (H, W), mean 0, deviation 1, as wide as ``sx`` by ``sy`` pixels."""
    grid = rng.normal(size=(round(size_hw[0] / sy) + 3, round(size_hw[1] / sx) + 3))
    smooth = cv2.resize(grid.astype(np.float32), size_hw[::-1], interpolation=cv2.INTER_CUBIC)
    return (smooth - smooth.mean()) / smooth.std()


def _between(a: Sequence[float], b: Sequence[float], share: np.ndarray) -> np.ndarray:
    return np.array(a) + np.clip(share, 0, 1)[..., None] * (np.array(b) - np.array(a))


def _wood(rng: np.random.Generator, size_hw: tuple[int, int], plank: int) -> np.ndarray:
    rows = np.arange(size_hw[0])[:, None]
    warp = 34 * _noise(rng, size_hw, 160, 40) + 3 * _noise(rng, size_hw, 40, 3)
    rings = 0.5 + 0.5 * np.sin((rows + warp) * (2 * np.pi / 26) + 9 * (rows // plank))
    pores = _noise(rng, size_hw, 22, 0.9)
    tone = rng.uniform(-0.12, 0.12, size_hw[0] // plank + 1)[rows // plank]
    wood = _between((104, 66, 38), (168, 118, 74), 0.3 + 0.45 * rings + 0.09 * pores + tone)
    wood[(rows % plank > plank - 3)[:, 0]] *= 0.5
    return wood


def _table(rng: np.random.Generator) -> np.ndarray:
    """Planks under a woven place mat."""
    wood = _wood(rng, (850, 1500), 143)
    h, w = 420, 800
    y, x = np.mgrid[:h, :w]
    diamond = np.abs((x + y) % 80 - 40) + np.abs((x - y) % 80 - 40)
    mat = _between((52, 82, 104), (196, 204, 196), np.clip((diamond - 50) / 6, 0, 1))
    mat[diamond < 12] = (206, 160, 70)
    edge = np.minimum(np.minimum(x, w - 1 - x), np.minimum(y, h - 1 - y))
    mat[edge < 26] = (40, 62, 84)
    mat[(edge > 10) & (edge < 15)] = (206, 204, 190)
    weave = 1 + 0.07 * np.sin(x * 1.6) * np.sin(y * 1.6) + 0.03 * _noise(rng, (h, w), 3, 3)
    top, left = 165, 350
    shadow = np.zeros(wood.shape[:2], np.float32)
    shadow[top + 4 : top + h + 6, left + 4 : left + w + 6] = 0.5
    wood *= 1 - cv2.GaussianBlur(shadow, (0, 0), 5)[..., None]
    wood[top : top + h, left : left + w] = mat * weave[..., None]
    return wood


def _wall(rng: np.random.Generator) -> np.ndarray:
    h, w = 470, 1200
    y, x = np.mgrid[:h, :w]
    wall = _between((222, 214, 194), (246, 238, 220), 0.5 + 0.5 * np.sign(np.sin(x * 0.16)))
    wall[y > h - 26] = (232, 230, 222)
    wall[y > h - 3] = (120, 116, 108)
    wall += 3 * _noise(rng, (h, w), 6, 6)[..., None]
    return wall


def _floor(rng: np.random.Generator) -> np.ndarray:
    h, w = 600, 1200
    y, x = np.mgrid[:h, :w]
    tiles = ((x // 66) + (y // 66)) % 2
    floor = _between((92, 94, 98), (126, 126, 126), tiles + 0.12 * _noise(rng, (h, w), 4, 4))
    floor[(x % 66 < 2) | (y % 66 < 2)] = (70, 70, 72)
    return floor


def _skin(rng: np.random.Generator) -> np.ndarray:
    size = (256, 512)
    mottled = 0.5 + 0.16 * _noise(rng, size, 14, 14) + 0.10 * _noise(rng, size, 2, 3)
    return _between((206, 146, 118), (236, 188, 158), mottled)


def _sleeve(rng: np.random.Generator) -> np.ndarray:
    y, x = np.mgrid[:512, :256]
    knit = 0.5 + 0.3 * np.sin(x * (2 * np.pi * 30 / 255)) * np.where(y < 70, 1.4, 0.4)
    knit += 0.10 * np.sin(y * 0.9) + 0.07 * _noise(rng, (512, 256), 2, 2)
    sleeve = _between((44, 58, 50), (92, 112, 92), knit)
    sleeve[(y > 66) & (y < 72)] *= 0.6
    return sleeve


def _mug(rng: np.random.Generator) -> np.ndarray:
    glaze = np.full((512, 256, 3), (226.0, 222.0, 210.0))
    y, x = np.mgrid[:512, :256]
    glaze[(y > 60) & (y < 112)] = (186, 58, 48)
    dots = np.hypot((x + 8) % 16 - 8, y - 86) < 4.5
    glaze[dots] = (240, 226, 196)
    glaze[(y > 118) & (y < 122)] = (60, 70, 110)
    return glaze + 2 * _noise(rng, (512, 256), 3, 3)[..., None]


def _box(rng: np.random.Generator) -> np.ndarray:
    card = np.full((256, 768, 3), (206, 176, 60), np.uint8)
    for left in (0, 256, 512):
        cv2.rectangle(card, (left + 14, 16), (left + 236, 234), (46, 92, 84), -1)
        cv2.rectangle(card, (left + 26, 150), (left + 224, 220), (226, 214, 180), -1)
        cv2.putText(
            card, "MINT", (left + 40, 122), cv2.FONT_HERSHEY_DUPLEX, 2.3, (240, 236, 220), 7
        )
    return card + 2 * _noise(rng, (256, 768), 3, 3)[..., None]


def _ball(rng: np.random.Generator) -> np.ndarray:
    y, x = np.mgrid[:256, :256]
    panels = (x // 43 + (y > 55)) % 2
    paint = _between((62, 120, 186), (232, 232, 226), panels.astype(float))
    paint[np.abs(y - 55) < 4] = (228, 180, 60)
    return paint + 2 * _noise(rng, (256, 256), 3, 3)[..., None]
