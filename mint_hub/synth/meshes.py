"""Things to find on a table, and the furniture they stand on.

Every thing stands on the origin (see ``primitives``); long things lie along x, their handle towards
-x. Sizes are metres. One texture covers all of a thing.
"""

from __future__ import annotations

from typing import Final

import numpy as np

from mint_hub.synth.primitives import (
    box,
    lathe,
    lifted,
    merged,
    moved,
    plane,
    prism,
    rounded_box,
    tube,
)
from mint_hub.synth.world import Floats, Mesh, Texture

__all__ = [
    "ball",
    "banana",
    "book",
    "bottle",
    "bowl",
    "box",
    "cone",
    "cup",
    "cylinder",
    "fruit",
    "hammer",
    "jar",
    "knife",
    "lathe",
    "lifted",
    "merged",
    "moved",
    "pan",
    "plane",
    "plate",
    "prism",
    "ring",
    "rounded_box",
    "screwdriver",
    "spoon",
    "star",
    "table",
    "tube",
]

WALL: Final = 0.0035
"""Thickness of cups, bowls and plates, metres."""


def cylinder(
    radius: float, height: float, texture: Texture, repeat_m: float | None = None, bevel: float = 0
) -> Mesh:
    """Make a closed cylinder whose edges are cut by ``bevel``."""
    r, b = radius, min(bevel, radius / 2, height / 2)
    profile = [(0, 0), (r - b, 0), (r, b), (r, height - b), (r - b, height), (0, height)]
    return lathe(profile, texture, repeat_m, "cylinder")


def cone(radius: float, height: float, texture: Texture, top_radius: float = 0.0) -> Mesh:
    """Make a closed cone, or a truncated one."""
    profile = [(0, 0), (radius, 0), (top_radius, height), (0, height)]
    return lathe(profile, texture, None, "cone")


def ball(radius: float, texture: Texture) -> Mesh:
    """Make a sphere that lies on the origin."""
    angle = np.linspace(-np.pi / 2, np.pi / 2, 19)
    profile = np.stack([np.cos(angle), 1 + np.sin(angle)], -1) * radius
    profile[[0, -1], 0] = 0.0
    return lathe(profile, texture, None, "ball")


def fruit(radius: float, texture: Texture, height: float = 0.9) -> Mesh:
    """Make an apple: a ball with dimples and a stalk; ``height`` over its width."""
    angle = np.linspace(-np.pi / 2, np.pi / 2, 21)
    r = np.cos(angle) ** 0.8
    z = np.sin(angle) - 0.28 * np.exp(-((r / 0.3) ** 2)) * np.sign(angle)
    profile = np.stack([r, (z - z.min()) * height], -1) * radius
    profile[[0, -1], 0] = 0.0
    top = float(profile[-1, 1])
    path = [
        (0.0, 0.0, top - 0.003),
        (0.001, 0.0, top + 0.2 * radius),
        (0.1 * radius, 0, 1.25 * top),
    ]
    stalk = tube(np.array(path), [0.0016, 0.0014, 0.0018], texture, None, segments=6)
    return merged("apple", lathe(profile, texture, None), stalk)


def cup(
    radius: float, height: float, texture: Texture, handle: bool = True, taper: float = 1.0
) -> Mesh:
    """Make a mug, its handle along -x; ``taper`` is the radius of the foot over that of the rim."""
    r, foot, w = radius, radius * taper, WALL
    outside = [(0, 0), (0.94 * foot, 0), (foot, 0.03 * height), (r, height - 0.001)]
    inside = [(r - 0.4 * w, height), (r - w, height - 0.001), (foot - w, 0.06 * height + w)]
    body = lathe([*outside, *inside, (0, 0.06 * height)], texture, None, "cup")
    if not handle:
        return body
    angle = np.linspace(0.5 * np.pi, 1.5 * np.pi, 13)
    reach, rise = 0.62 * radius, 0.29 * height
    middle = -(foot + r) / 2 + 0.3 * w
    path = np.stack([middle + reach * np.cos(angle), 0 * angle, height / 2 + rise * np.sin(angle)])
    grip = tube(path.T, 0.0048, texture, None, segments=10, flatness=1.6)
    return merged("cup", body, grip)


def bowl(radius: float, height: float, texture: Texture) -> Mesh:
    """Make a bowl that widens towards its rim."""
    angle = np.linspace(0.42, np.pi / 2, 8)
    r, z = radius * np.sin(angle), height * (1 - np.cos(angle) / np.cos(angle[0]))
    outside = np.stack([r, np.maximum(z, 0.0)], -1)
    inner = np.stack([np.maximum(r - WALL, 0), z + WALL], -1)[::-1]
    inner[0, 1] = height
    profile = [(0.0, 0.0), *map(tuple, outside), *map(tuple, inner), (0.0, WALL)]
    return lathe(profile, texture, None, "bowl")


def plate(radius: float, texture: Texture, height: float = 0.02) -> Mesh:
    """Make a plate with a flat middle and a rising rim."""
    flat, w = 0.62 * radius, WALL
    outside = [(0, 0), (flat, 0), (0.72 * radius, 0.35 * height), (radius, height)]
    inside = [(0.99 * radius, height + 0.6 * w), (0.72 * radius, 0.35 * height + w), (flat, w)]
    return lathe([*outside, *inside, (0, w)], texture, None, "plate", 40)


def bottle(
    radius: float, height: float, texture: Texture, neck: float = 0.38, shoulder: float = 0.62
) -> Mesh:
    """Make a bottle; ``neck`` is its radius over the body's, the shoulder begins at that height."""
    t = np.linspace(0, 1, 7)
    ease = t * t * (3 - 2 * t)
    r = radius * (1 + (neck - 1) * ease)
    z = height * (shoulder + 0.2 * t)
    cap, n = 1.15 * neck * radius, neck * radius
    profile = [(0, 0), (0.92 * radius, 0), (radius, 0.04 * height), *zip(r, z, strict=True)]
    profile += [(n, 0.9 * height), (cap, 0.9 * height), (cap, height), (0, height)]
    return lathe(profile, texture, None, "bottle")


def jar(radius: float, height: float, texture: Texture) -> Mesh:
    """Make a jar with a screwed lid."""
    r, lid = radius, 0.9 * radius
    profile = [
        (0, 0),
        (0.93 * r, 0),
        (r, 0.05 * height),
        (r, 0.7 * height),
        (0.86 * r, 0.8 * height),
    ]
    profile += [(lid, 0.8 * height), (lid, 0.98 * height), (0.95 * lid, height), (0, height)]
    return lathe(profile, texture, None, "jar")


def book(size: tuple[float, float, float], texture: Texture) -> Mesh:
    """Make a closed book lying flat, its spine towards -x: two covers, spine and pages.

    The pages show the texture's paper, which a "label" has in its last sixteenth (u > 15 / 16).
    """
    x, y, z = size
    cover = min(0.003, z / 5)
    lower = box((x, y, cover), texture)
    upper = lifted(lower, z=z - cover)
    spine = lifted(box((cover, y, z), texture), x=-(x - cover) / 2)
    pages = lifted(box((x - 2 * cover, y - 0.008, z - 2 * cover), texture), z=cover)
    pages.uv[:, 0] = 0.972
    return merged("book", lower, upper, spine, pages)


def knife(length: float, texture: Texture, blade: float = 0.58) -> Mesh:
    """Make a table knife lying flat; ``blade`` is the blade's share of its length."""
    start, end = length * (0.5 - blade), length / 2
    half = 0.011 * length / 0.22
    edge = [(start, -0.7 * half), (0.8 * end, -half), (0.97 * end, -0.3 * half)]
    back = [(end, 0.6 * half), (0.9 * end, 0.85 * half), (start, 0.7 * half)]
    flat = lifted(prism([*edge, *back], 0.0018, texture), z=0.004)
    grip = rounded_box((length * (1 - blade), 1.7 * half, 0.011), 0.004, texture)
    return merged("knife", flat, lifted(grip, x=-length * blade / 2))


def spoon(length: float, texture: Texture) -> Mesh:
    """Make a spoon lying on its bowl."""
    s = np.linspace(-0.5, 0.5, 24)
    middle = 0.34
    oval = np.sqrt(np.clip(1 - ((s - middle) / 0.165) ** 2, 0, None))
    width = length * np.maximum(0.022 + 0.02 * np.clip(-s, 0, 1), 0.125 * oval)
    width[[0, -1]] = 0.0
    lift = 0.004 + length * (
        0.09 * np.clip(0.2 - s, 0, 1) ** 2 + 0.25 * (s - middle) ** 2 * (s > 0.2)
    )
    path = np.stack([s * length, 0 * s, lift], -1)
    stem = tube(path, width, texture, None, segments=12, flatness=0.16, up=(0, 0, 1))
    return lifted(merged("spoon", stem), z=-float(stem.vertices[:, 2].min()))


def pan(radius: float, texture: Texture, height: float = 0.05) -> Mesh:
    """Make a frying pan, its handle along -x."""
    w = 0.004
    outside = [(0, 0), (0.82 * radius, 0), (radius, height)]
    body = lathe([*outside, (radius - w, height), (0.82 * radius - w, w), (0, w)], texture, None)
    s = np.linspace(0, 1, 9)
    path = np.stack([-radius * (0.97 + 1.2 * s), 0 * s, height * (0.8 + 0.5 * s)], -1)
    width = 0.012 * np.clip(0.75 + 0.5 * s, 0, 1)
    width[-1] = 0.0
    return merged("pan", body, tube(path, width, texture, None, flatness=0.6, up=(0, 0, 1)))


def banana(length: float, texture: Texture) -> Mesh:
    """Make a banana lying on its side, bent about z."""
    t = np.linspace(-1, 1, 21)
    bend = 0.8
    radius = length / (2 * bend)
    path = np.stack([radius * np.sin(bend * t), radius * (np.cos(bend * t) - 0.9), 0 * t], -1)
    thick = 0.105 * length * np.clip(1 - np.abs(t) ** 6, 0.12, 1) ** 0.5
    thick[[0, -1]] = 0.0
    made = tube(path, thick, texture, None, segments=9, up=(0, 0, 1))
    return lifted(merged("banana", made), z=-float(made.vertices[:, 2].min()))


def screwdriver(length: float, texture: Texture) -> Mesh:
    """Make a screwdriver lying flat."""
    r = 0.014 * length / 0.2
    profile = [
        (0, 0),
        (0.8 * r, 0),
        (r, 0.1 * length),
        (0.85 * r, 0.3 * length),
        (r, 0.42 * length),
    ]
    profile += [
        (0.45 * r, 0.48 * length),
        (0.26 * r, 0.48 * length),
        (0.26 * r, length),
        (0, length),
    ]
    return lifted(_lying(lathe(profile, texture, None, "screwdriver", 12), length), z=r)


def hammer(length: float, texture: Texture) -> Mesh:
    """Make a hammer lying flat, its head at +x."""
    r = 0.013
    shaft = _lying(cylinder(r, 0.92 * length, texture, None, 0.003), length)
    head = lathe(
        [(0, 0), (0.017, 0), (0.017, 0.03), (0.012, 0.04), (0.012, 0.1), (0, 0.1)], texture
    )
    T = np.eye(4)
    T[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    T[:3, 3] = 0.42 * length, 0.05, 0.0
    return lifted(merged("hammer", shaft, moved(head, T)), z=0.017)


def ring(radius: float, thickness: float, texture: Texture) -> Mesh:
    """Make a torus lying flat."""
    angle = np.linspace(0, 2 * np.pi, 37)
    path = np.stack([radius * np.cos(angle), radius * np.sin(angle), 0 * angle + thickness], -1)
    path[-1] = path[0]
    return tube(path, thickness, texture, None, "ring", 16, up=(0, 0, 1))


def star(radius: float, height: float, texture: Texture, points: int = 5) -> Mesh:
    """Make a star-shaped block."""
    angle = np.arange(2 * points) * np.pi / points
    r = np.where(np.arange(2 * points) % 2, 0.5, 1.0) * radius
    outline = np.stack([r * np.cos(angle), r * np.sin(angle)], -1)
    return prism(outline, height, texture, None, "star")


def table(
    size: tuple[float, float, float],
    texture: Texture,
    thickness: float = 0.03,
    leg: float = 0.06,
    repeat_m: float = 0.7,
) -> Mesh:
    """Make a table with four legs; its top is at z = ``size[2]``."""
    x, y, z = size
    top = lifted(rounded_box((x, y, thickness), 0.004, texture, repeat_m, steps=2), z=z - thickness)
    post = box((leg, leg, z - thickness), texture, repeat_m)
    at = [(sx * (x / 2 - leg), sy * (y / 2 - leg)) for sx in (-1, 1) for sy in (-1, 1)]
    return merged("table", top, *(lifted(post, *xy) for xy in at))


def _lying(mesh: Mesh, length: float) -> Mesh:
    """Lay down along +x, around the origin, what stands ``length`` high."""
    T: Floats = np.eye(4)
    T[:3, :3] = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]
    T[0, 3] = -length / 2
    return moved(mesh, T)
