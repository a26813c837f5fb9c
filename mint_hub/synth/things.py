"""Things to take: each with its mesh, its exact solid, its name and where a hand can hold it.

Two disjoint tables: KINDS_TRAIN and KINDS_OOD. No kind of the second can come into a train clip.
Metres; a thing stands on its origin, long ones lie along x.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mint_hub.synth import meshes
from mint_hub.synth.solids import Block, Raised, Rod, Solid, Union, turned
from mint_hub.synth.world import Mesh, Texture

__all__ = ["KINDS_OOD", "KINDS_TRAIN", "Grip", "Thing", "make_thing"]

Floats = NDArray[np.float64]
Maker = Callable[[np.random.Generator, Texture], "Thing"]


@dataclass(frozen=True)
class Grip:
    """A place where a thing can be held.

    Attributes:
        style: key of ``grasps.CONTACTS``.
        at: (3,) point between thumb and fingers.
        width: metres between them.
        yaws_deg: horizontal directions from thumb to fingers that will do, in the thing's frame;
            None: any (round things).

    """

    style: str
    at: tuple[float, float, float]
    width: float
    yaws_deg: tuple[float, ...] | None = None


@dataclass(frozen=True, eq=False)
class Thing:
    """One thing before it is put anywhere.

    Attributes:
        kind: what it is, a word.
        mesh: how it looks.
        solid: where it is.
        grips: how one hand can hold it, best first; empty: it is not for taking.
        radius: of a circle around the origin that holds its footprint.
        height: of its highest point.
        roles: what can be done with it: "pour", "into" (things go in), "onto" (flat top), "wipe",
            "both" (both hands), "press", "tool", "slide".
        name: how a sentence calls it.
        inside_z: height of the floor inside, of a hollow thing.

    """

    kind: str
    mesh: Mesh
    solid: Solid
    grips: tuple[Grip, ...]
    radius: float
    height: float
    roles: frozenset[str] = frozenset()
    name: str = ""
    inside_z: float = 0.0


def make_thing(kind: str, rng: np.random.Generator, texture: Texture, colour: str = "") -> Thing:
    """Make a thing of a kind of either table, its sizes drawn."""
    makers = {**KINDS_TRAIN, **KINDS_OOD}
    made = makers[kind](rng, texture)
    return replace(made, name=f"{colour} {kind.replace('_', ' ')}".strip())


def _top(height: float, width: float, dip: float, style: str = "claw") -> Grip:
    return Grip(style, (0.0, 0.0, height - min(dip, 0.6 * height)), width)


def _round(
    kind: str, mesh: Mesh, profile: list[tuple[float, float]], grips: tuple[Grip, ...], *roles: str
) -> Thing:
    r, z = np.array(profile).T
    return Thing(
        kind, mesh, turned(profile), grips, float(r.max()), float(z.max()), frozenset(roles)
    )


# ------------------------------------------------------------------------ train


def _mug(rng: np.random.Generator, texture: Texture) -> Thing:
    r, h, taper = rng.uniform(0.034, 0.043), rng.uniform(0.080, 0.110), rng.uniform(0.85, 1.0)
    profile = [(taper * r, 0.0), (r, h)]
    made = _round("mug", meshes.cup(r, h, texture, True, taper), profile, (), "pour", "into")
    handle = Block((0.7 * r, 0.012, 0.62 * h), 0.004, (-1.3 * r, 0.0, 0.19 * h))
    solid = Union((made.solid, handle))
    away = tuple(float(a) for a in range(-90, 91, 30))
    grips = (
        Grip("wrap", (0, 0, 0.62 * h), 2 * r, away),
        Grip("claw", (0, 0, h - 0.02), 2 * r, away),
    )
    return replace(made, solid=solid, grips=grips, radius=1.75 * r, inside_z=0.01)


def _cup(rng: np.random.Generator, texture: Texture) -> Thing:
    r, h, taper = rng.uniform(0.032, 0.041), rng.uniform(0.090, 0.13), rng.uniform(0.72, 0.9)
    profile = [(taper * r, 0.0), (r, h)]
    mesh = meshes.cup(r, h, texture, False, taper)
    grips = (Grip("wrap", (0, 0, 0.6 * h), 1.9 * r), _top(h, 2 * r, 0.022))
    return replace(_round("cup", mesh, profile, grips, "pour", "into"), inside_z=0.01)


def _can(rng: np.random.Generator, texture: Texture) -> Thing:
    r, h = rng.uniform(0.026, 0.040), rng.uniform(0.085, 0.14)
    mesh = meshes.cylinder(r, h, texture, None, 0.003)
    grips = (Grip("wrap", (0, 0, max(0.055, 0.55 * h)), 2 * r), _top(h, 2 * r, 0.03))
    return _round("can", mesh, [(r, 0.0), (r, h)], grips, "onto", "pour")


def _bottle(rng: np.random.Generator, texture: Texture) -> Thing:
    r, h = rng.uniform(0.026, 0.038), rng.uniform(0.17, 0.25)
    mesh = meshes.bottle(r, h, texture)
    profile = [(r, 0.0), (r, 0.62 * h), (0.72 * r, 0.71 * h), (0.44 * r, 0.82 * h), (0.44 * r, h)]
    grips = (Grip("wrap", (0, 0, 0.42 * h), 2 * r), _top(h, 0.88 * r, 0.02))
    return _round("bottle", mesh, profile, grips, "pour")


def _jar(rng: np.random.Generator, texture: Texture) -> Thing:
    r, h = rng.uniform(0.030, 0.042), rng.uniform(0.07, 0.12)
    profile = [(r, 0.0), (r, 0.7 * h), (0.9 * r, 0.8 * h), (0.9 * r, h)]
    grips = (_top(h, 1.8 * r, 0.025), Grip("wrap", (0, 0, max(0.05, 0.5 * h)), 2 * r))
    return _round("jar", meshes.jar(r, h, texture), profile, grips, "onto")


def _carton(rng: np.random.Generator, texture: Texture) -> Thing:
    size = (rng.uniform(0.05, 0.11), rng.uniform(0.035, 0.065), rng.uniform(0.05, 0.15))
    x, y, z = size
    grips = [Grip("claw", (0, 0, z - min(0.03, 0.5 * z)), y, (90.0, -90.0))]
    if z > 0.095:
        grips.insert(0, Grip("wrap", (0, 0, max(0.055, 0.55 * z)), y, (90.0, -90.0)))
    mesh = meshes.rounded_box(size, 0.002, texture, steps=2)
    return Thing(
        "carton",
        mesh,
        Block(size, 0.002),
        tuple(grips),
        float(np.hypot(x, y) / 2),
        z,
        frozenset({"onto"}),
    )


def _block(rng: np.random.Generator, texture: Texture) -> Thing:
    a = rng.uniform(0.025, 0.055)
    size = (a, a, a * rng.uniform(0.8, 1.3))
    four = (0.0, 90.0, 180.0, -90.0)
    grip = Grip("pinch", (0, 0, 0.6 * size[2]), a, four)
    mesh = meshes.rounded_box(size, 0.002, texture, steps=2)
    return Thing("block", mesh, Block(size, 0.002), (grip,), 0.71 * a, size[2], frozenset({"onto"}))


def _ball(rng: np.random.Generator, texture: Texture) -> Thing:
    r = rng.uniform(0.022, 0.040)
    angle = np.linspace(0, np.pi, 17)
    profile = [(float(r * np.sin(a)), float(r - r * np.cos(a))) for a in angle]
    return _round("ball", meshes.ball(r, texture), profile, (Grip("claw", (0, 0, r), 2 * r),))


def _apple(rng: np.random.Generator, texture: Texture) -> Thing:
    r = rng.uniform(0.030, 0.042)
    made = _ball(rng, texture)
    angle = np.linspace(0, np.pi, 17)
    around = np.sin(angle) ** 0.8
    up = -np.cos(angle) * (1 - 0.28 * np.exp(-((around / 0.3) ** 2)) / np.abs(np.cos(angle) + 1e-9))
    profile = [
        (float(r * a), float(0.9 * r * (b - up.min()))) for a, b in zip(around, up, strict=True)
    ]
    mesh = meshes.fruit(r, texture)
    grip = Grip("claw", (0, 0, 0.8 * r), 2 * r)
    return replace(
        made,
        kind="apple",
        mesh=mesh,
        solid=turned(profile),
        grips=(grip,),
        radius=r,
        height=float(mesh.vertices[:, 2].max()),
    )


def _bowl(rng: np.random.Generator, texture: Texture) -> Thing:
    r, h = rng.uniform(0.065, 0.10), rng.uniform(0.05, 0.075)
    angle = np.linspace(0.42, np.pi / 2, 7)
    z = h * (1 - np.cos(angle) / np.cos(angle[0]))
    profile = [(float(r * np.sin(a)), float(max(b, 0.0))) for a, b in zip(angle, z, strict=True)]
    made = _round("bowl", meshes.bowl(r, h, texture), profile, (), "into", "both")
    return replace(made, inside_z=0.004)


def _plate(rng: np.random.Generator, texture: Texture) -> Thing:
    r = rng.uniform(0.085, 0.13)
    profile = [(0.62 * r, 0.0), (0.72 * r, 0.007), (r, 0.02), (r, 0.0225), (0.62 * r, 0.0035)]
    made = _round("plate", meshes.plate(r, texture), profile, (), "into")
    return replace(made, inside_z=0.0035)


def _sponge(rng: np.random.Generator, texture: Texture) -> Thing:
    size = (rng.uniform(0.085, 0.12), rng.uniform(0.06, 0.08), rng.uniform(0.022, 0.035))
    grips = (Grip("flat", (0, 0, size[2]), size[1]),)
    mesh = meshes.rounded_box(size, 0.007, texture)
    return Thing("sponge", mesh, Block(size, 0.007), grips, 0.07, size[2], frozenset({"wipe"}))


def _cloth(rng: np.random.Generator, texture: Texture) -> Thing:
    size = (rng.uniform(0.12, 0.18), rng.uniform(0.10, 0.14), 0.008)
    grips = (Grip("flat", (0, 0, size[2]), size[1]),)
    mesh = meshes.rounded_box(size, 0.004, texture)
    return Thing("cloth", mesh, Block(size, 0.004), grips, 0.10, size[2], frozenset({"wipe"}))


def _book(rng: np.random.Generator, texture: Texture) -> Thing:
    size = (rng.uniform(0.12, 0.17), rng.uniform(0.17, 0.24), rng.uniform(0.012, 0.035))
    grips = (Grip("flat", (0, 0, size[2]), size[1]),)
    roles = frozenset({"slide", "onto"})
    radius = float(np.hypot(*size[:2]) / 2)
    return Thing("book", meshes.book(size, texture), Block(size), grips, radius, size[2], roles)


def _parcel(rng: np.random.Generator, texture: Texture) -> Thing:
    size = (rng.uniform(0.15, 0.25), rng.uniform(0.12, 0.2), rng.uniform(0.09, 0.16))
    mesh = meshes.rounded_box(size, 0.003, texture, steps=2)
    radius = float(np.hypot(*size[:2]) / 2)
    roles = frozenset({"both", "onto"})
    return Thing("parcel", mesh, Block(size, 0.003), (), radius, size[2], roles)


def _spoon(rng: np.random.Generator, texture: Texture) -> Thing:
    length = rng.uniform(0.15, 0.22)
    mesh = meshes.spoon(length, texture)
    solid = Union(
        (
            Rod((-0.5 * length, 0, 0.052 * length), (0.15 * length, 0, 0.004), 0.0035),
            Block((0.3 * length, 0.2 * length, 0.011), 0.004, (0.34 * length, 0, 0)),
        )
    )
    grip = Grip("pinch", (-0.2 * length, 0, 0.012), 0.008, (90.0, -90.0))
    return Thing("spoon", mesh, solid, (grip,), length / 2, 0.014, frozenset({"tool"}))


def _marker(rng: np.random.Generator, texture: Texture) -> Thing:
    length, r = rng.uniform(0.11, 0.15), rng.uniform(0.006, 0.010)
    mesh = meshes.cylinder(r, length, texture, None, 0.0015)
    T = np.array([[0, 0, 1, -length / 2], [0, 1, 0, 0], [-1, 0, 0, r], [0, 0, 0, 1.0]])
    solid = Rod((-length / 2 + r, 0, r), (length / 2 - r, 0, r), r)
    grip = Grip("pinch", (0, 0, r + 0.004), 2 * r, (90.0, -90.0))
    return Thing("marker", meshes.moved(mesh, T), solid, (grip,), length / 2, 2 * r)


def _switch(rng: np.random.Generator, texture: Texture) -> Thing:
    size = (rng.uniform(0.07, 0.10), rng.uniform(0.06, 0.09), rng.uniform(0.02, 0.04))
    mesh = meshes.rounded_box(size, 0.006, texture)
    grips = (Grip("point", (0, 0, size[2]), 0.0),)
    return Thing("switch", mesh, Block(size, 0.006), grips, 0.065, size[2], frozenset({"press"}))


KINDS_TRAIN: Final[dict[str, Maker]] = {
    "mug": _mug,
    "cup": _cup,
    "can": _can,
    "bottle": _bottle,
    "jar": _jar,
    "carton": _carton,
    "block": _block,
    "ball": _ball,
    "apple": _apple,
    "bowl": _bowl,
    "plate": _plate,
    "sponge": _sponge,
    "cloth": _cloth,
    "book": _book,
    "parcel": _parcel,
    "spoon": _spoon,
    "marker": _marker,
    "switch": _switch,
}

# -------------------------------------------------------------- out of distribution


def _raised(outline: Floats, height: float) -> Raised:
    return Raised(tuple((float(x), float(y)) for x, y in outline), height)


def _lathed(kind: str, texture: Texture, profile: list[tuple[float, float]], *roles: str) -> Thing:
    r, z = np.array(profile).T
    grip_z = max(0.05, 0.5 * float(z.max()))
    width = 2 * float(np.interp(grip_z, z, r))
    grips = (Grip("wrap", (0, 0, grip_z), width),)
    mesh = meshes.lathe([(0, 0), *profile, (0, float(z.max()))], texture, None, kind)
    return _round(kind, mesh, profile, grips, *roles)


def _vase(rng: np.random.Generator, texture: Texture) -> Thing:
    h, r = rng.uniform(0.14, 0.2), rng.uniform(0.034, 0.044)
    z = np.linspace(0, 1, 9)
    wave = 0.76 + 0.24 * np.cos(2 * np.pi * (z - rng.uniform(0.15, 0.35)))
    profile = [(float(r * w), float(h * s)) for w, s in zip(wave, z, strict=True)]
    return _lathed("vase", texture, profile, "pour")


def _goblet(rng: np.random.Generator, texture: Texture) -> Thing:
    h, r = rng.uniform(0.13, 0.17), rng.uniform(0.032, 0.04)
    shape = [(0.95, 0), (0.3, 0.06), (0.16, 0.12), (0.16, 0.38), (0.7, 0.5), (1, 0.68), (0.9, 1)]
    made = _lathed("goblet", texture, [(r * a, h * b) for a, b in shape], "pour")
    return replace(made, grips=(Grip("wrap", (0, 0, 0.7 * h), 2 * r),))


def _cone(rng: np.random.Generator, texture: Texture) -> Thing:
    r, h = rng.uniform(0.032, 0.045), rng.uniform(0.09, 0.14)
    mesh = meshes.cone(r, h, texture, 0.3 * r)
    grip = Grip("claw", (0, 0, 0.6 * h), 1.2 * r)
    return _round("cone", mesh, [(r, 0.0), (0.3 * r, h)], (grip,))


def _hexagon(rng: np.random.Generator, texture: Texture) -> Thing:
    r, h = rng.uniform(0.024, 0.038), rng.uniform(0.05, 0.10)
    angle = np.arange(6) * np.pi / 3
    outline = r * np.stack([np.cos(angle), np.sin(angle)], -1)
    mesh = meshes.prism(outline, h, texture, None, "prism")
    flat = r * np.cos(np.pi / 6)
    grip = Grip("claw", (0, 0, h - 0.025), 2 * flat, (30.0, 90.0, 150.0, -30.0, -90.0, -150.0))
    solid = _raised(outline, h)
    return Thing("hexagon", mesh, solid, (grip,), r, h, frozenset({"onto"}))


def _star(rng: np.random.Generator, texture: Texture) -> Thing:
    r, h = rng.uniform(0.035, 0.055), rng.uniform(0.03, 0.05)
    angle = np.arange(10) * np.pi / 5
    size = np.where(np.arange(10) % 2, 0.5, 1.0) * r
    solid = _raised(np.stack([size * np.cos(angle), size * np.sin(angle)], -1), h)
    grip = Grip("claw", (0, 0, 0.6 * h), 1.3 * r)
    mesh = meshes.star(r, h, texture)
    return Thing("star", mesh, solid, (grip,), r, h, frozenset({"onto"}))


def _ring(rng: np.random.Generator, texture: Texture) -> Thing:
    r, thick = rng.uniform(0.035, 0.06), rng.uniform(0.008, 0.012)
    arcs = np.linspace(0, 2 * np.pi, 17)
    rods = tuple(
        Rod(
            (float(r * np.cos(a)), float(r * np.sin(a)), thick),
            (float(r * np.cos(b)), float(r * np.sin(b)), thick),
            thick,
        )
        for a, b in pairwise(arcs)
    )
    grips = tuple(
        Grip(
            "pinch",
            (float(r * np.cos(np.deg2rad(a))), float(r * np.sin(np.deg2rad(a))), thick + 0.004),
            2 * thick,
            (a, a + 180.0),
        )
        for a in range(-150, 181, 30)
    )
    mesh = meshes.ring(r, thick, texture)
    return Thing("ring", mesh, Union(rods), grips, r + thick, 2 * thick)


def _stick(
    kind: str, mesh: Mesh, length: float, radius: float, at_x: float, *roles: str, head: Any = ()
) -> Thing:
    handle = Rod((-length / 2 + radius, 0, radius), (0.1 * length, 0, radius), radius)
    rest = Rod((0.1 * length, 0, 0.006), (length / 2, 0, 0.006), 0.005)
    grip = Grip("pinch", (at_x, 0, radius + 0.006), 2 * radius, (90.0, -90.0))
    solid = Union((handle, rest, *head))
    return Thing(kind, mesh, solid, (grip,), length / 2, 2.5 * radius, frozenset(roles))


def _knife(rng: np.random.Generator, texture: Texture) -> Thing:
    length = rng.uniform(0.18, 0.25)
    half = 0.05 * length
    handle = Block((0.42 * length, 1.7 * half, 0.011), 0.004, (-0.29 * length, 0, 0))
    blade = Block((0.58 * length, 2 * half, 0.002), 0.0, (0.21 * length, 0, 0.004))
    grip = Grip("pinch", (-0.27 * length, 0, 0.012), 1.7 * half, (90.0, -90.0))
    mesh = meshes.knife(length, texture)
    roles = frozenset({"tool", "cut"})
    return Thing("knife", mesh, Union((handle, blade)), (grip,), length / 2, 0.012, roles)


def _screwdriver(rng: np.random.Generator, texture: Texture) -> Thing:
    length = rng.uniform(0.16, 0.23)
    mesh = meshes.screwdriver(length, texture)
    r = 0.014 * length / 0.2
    return _stick("screwdriver", mesh, length, r, -0.28 * length, "tool")


def _hammer(rng: np.random.Generator, texture: Texture) -> Thing:
    length = rng.uniform(0.22, 0.29)
    head = Block((0.04, 0.11, 0.034), 0.004, (0.42 * length, 0.0, 0.0))
    mesh = meshes.hammer(length, texture)
    made = _stick("hammer", mesh, length, 0.015, -0.2 * length, "tool", "beat", head=(head,))
    return replace(made, height=0.034)


def _banana(rng: np.random.Generator, texture: Texture) -> Thing:
    length = rng.uniform(0.15, 0.2)
    mesh = meshes.banana(length, texture)
    t = np.linspace(-1, 1, 8)
    radius, thick = length / 1.6, 0.1 * length
    path = np.stack([radius * np.sin(0.8 * t), radius * (np.cos(0.8 * t) - 0.9), 0 * t + thick], -1)
    ends = [(float(p[0]), float(p[1]), float(p[2])) for p in path]
    rods = tuple(Rod(a, b, 0.95 * thick) for a, b in pairwise(ends))
    at = (0.0, 0.1 * radius, 1.1 * thick)
    grip = Grip("pinch", at, 2 * thick, (90.0, -90.0))
    return Thing("banana", mesh, Union(rods), (grip,), length / 2, 2 * thick)


def _pan(rng: np.random.Generator, texture: Texture) -> Thing:
    r, h = rng.uniform(0.085, 0.11), rng.uniform(0.035, 0.05)
    made = _round("pan", meshes.pan(r, texture, h), [(0.82 * r, 0.0), (r, h)], (), "into")
    handle = Rod((-0.97 * r, 0, 0.8 * h), (-2.1 * r, 0, 1.25 * h), 0.010)
    return replace(made, solid=Union((made.solid, handle)), radius=1.9 * r, inside_z=0.004)


KINDS_OOD: Final[dict[str, Maker]] = {
    "vase": _vase,
    "goblet": _goblet,
    "cone": _cone,
    "hexagon": _hexagon,
    "star": _star,
    "ring": _ring,
    "knife": _knife,
    "screwdriver": _screwdriver,
    "hammer": _hammer,
    "banana": _banana,
    "pan": _pan,
}
