"""Surfaces from which things are built: boxes, turned and extruded shapes, tubes.

Metres. A shape stands on the origin: its lowest point is z = 0, its middle lies on the z axis,
unless said otherwise. Triangles are counter-clockwise from outside. Texture coordinates are
repeats: ``repeat_m`` is the length of one; None shows the texture once on every side.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mint_hub.synth.raster import vertex_normals
from mint_hub.synth.world import Floats, Mesh, Texture

SEGMENTS: Final = 28
"""Steps around a round thing."""

CREASE_COS: Final = 0.75
"""A profile that turns by more than this (cosine) has an edge; less is smooth."""


def made(
    name: str, vertices: Floats, faces: NDArray[np.integer], uv: Floats, texture: Texture
) -> Mesh:
    """Return a mesh with the normals of its faces, smooth wherever vertices are shared."""
    points = np.asarray(vertices, np.float64)
    triangles = np.asarray(faces, np.int32).reshape(-1, 3)
    normals = vertex_normals(points, triangles).astype(np.float32)
    return Mesh(
        name, points.astype(np.float32), triangles, normals, np.asarray(uv, np.float32), texture
    )


def merged(name: str, *parts: Mesh) -> Mesh:
    """Join meshes of one texture, the first one's."""
    offsets = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
    return Mesh(
        name,
        np.concatenate([part.vertices for part in parts]),
        np.concatenate([p.faces + o for p, o in zip(parts, offsets, strict=True)]).astype(np.int32),
        np.concatenate([normals_of(part) for part in parts]),
        np.concatenate([part.uv for part in parts]),
        parts[0].texture,
    )


def normals_of(mesh: Mesh) -> NDArray[np.float32]:
    """Unit normals (V, 3): the mesh's own, else smooth ones."""
    if mesh.normals is not None:
        return mesh.normals
    return vertex_normals(mesh.vertices.astype(np.float64), mesh.faces).astype(np.float32)


def moved(mesh: Mesh, T: Floats) -> Mesh:
    """Move the mesh within its body by a rigid transform (4, 4)."""
    R, t = np.asarray(T)[:3, :3], np.asarray(T)[:3, 3]
    return replace(
        mesh,
        vertices=(mesh.vertices @ R.T + t).astype(np.float32),
        normals=(normals_of(mesh) @ R.T).astype(np.float32),
    )


def lifted(mesh: Mesh, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Mesh:
    """Shift the mesh within its body."""
    T = np.eye(4)
    T[:3, 3] = x, y, z
    return moved(mesh, T)


def plane(
    size: tuple[float, float], texture: Texture, repeat_m: float | None = 1.0, name: str = "plane"
) -> Mesh:
    """Lay a rectangle at z = 0 around the origin, seen from above; u along x, v along y."""
    corners = np.array([(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)])
    vertices = np.concatenate([corners * size, np.zeros((4, 1))], -1)
    uv = corners + 0.5 if repeat_m is None else (corners + 0.5) * size / repeat_m
    return made(name, vertices, np.array([[0, 1, 2], [0, 2, 3]]), uv, texture)


def box(
    size: tuple[float, float, float],
    texture: Texture,
    repeat_m: float | None = None,
    name: str = "box",
) -> Mesh:
    """Make a box with sharp edges; on its sides v runs up."""
    vertices, faces, uv = [], [], []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            across, up = (0, 1) if axis == 2 else (1 - axis, 2)
            quad = np.full((4, 3), 0.5 * sign)
            quad[:, across], quad[:, up] = (-0.5, 0.5, 0.5, -0.5), (-0.5, -0.5, 0.5, 0.5)
            flat = quad[:, [across, up]] + 0.5
            normal = np.cross(quad[1] - quad[0], quad[2] - quad[0])
            order = [0, 1, 2, 3] if normal[axis] * sign > 0 else [1, 0, 3, 2]
            if order[0] == 1:
                flat[:, 0] = 1 - flat[:, 0]  # seen from outside, u runs to the right
            scale = 1.0 if repeat_m is None else np.array([size[across], size[up]]) / repeat_m
            base = 4 * len(vertices)
            faces += [[base + order[i] for i in (0, 1, 2)], [base + order[i] for i in (0, 2, 3)]]
            vertices.append((quad + np.array([0, 0, 0.5])) * size)
            uv.append(flat * scale)
    return made(name, np.concatenate(vertices), np.array(faces), np.concatenate(uv), texture)


def rounded_box(
    size: tuple[float, float, float],
    radius: float,
    texture: Texture,
    repeat_m: float | None = None,
    name: str = "rounded box",
    steps: int = 3,
) -> Mesh:
    """Make a box whose edges and corners are rounded by ``radius``, ``steps`` facets to each."""
    half = np.array(size) / 2
    radius = min(radius, float(half.min()) * 0.999)
    vertices, faces, normals, uv = [], [], [], []
    angles = np.linspace(0, np.pi / 4, steps + 1)
    outer = np.tan(angles)  # of a cube's side, evenly spread in angle
    line = np.concatenate([-outer[::-1], outer])
    pins = np.concatenate([-np.ones(steps + 1), np.ones(steps + 1)])
    n = len(line)
    j, i = (g.ravel() for g in np.mgrid[:n, :n])
    for axis in range(3):
        for sign in (-1.0, 1.0):
            a, b = ((axis + 1) % 3, (axis + 2) % 3)[:: int(sign)]
            direction = np.empty((n * n, 3))
            direction[:, axis], direction[:, a], direction[:, b] = sign, line[i], line[j]
            direction /= np.linalg.norm(direction, axis=1, keepdims=True)
            core = np.empty((n * n, 3))
            core[:, axis], core[:, a], core[:, b] = sign, pins[i], pins[j]
            points = core * (half - radius) + radius * direction
            k = np.arange(n * n).reshape(n, n) + sum(map(len, vertices))
            p, q, r, s = k[:-1, :-1], k[:-1, 1:], k[1:, 1:], k[1:, :-1]
            faces += [np.stack([p, q, r], -1), np.stack([p, r, s], -1)]
            across, up = (a, b) if axis == 2 else (1 - axis, 2)
            flat = np.stack([points[:, across], points[:, up]], -1)
            span = 2 * half[[across, up]]
            uv.append(flat / span + 0.5 if repeat_m is None else flat / repeat_m)
            vertices.append(points + half[2] * np.array([0, 0, 1]))
            normals.append(direction)
    flat_faces = np.concatenate([f.reshape(-1, 3) for f in faces])
    mesh = made(name, np.concatenate(vertices), flat_faces, np.concatenate(uv), texture)
    return replace(mesh, normals=np.concatenate(normals).astype(np.float32))


def lathe(
    profile: Sequence[tuple[float, float]] | Floats,
    texture: Texture,
    repeat_m: float | None = None,
    name: str = "turned",
    segments: int = SEGMENTS,
) -> Mesh:
    """Turn a profile of (radius, height) about the z axis.

    The profile goes up on the outside (and may come down on the inside). It turns sharply where it
    bends by more than about 40 degrees. u goes once around, or a whole number of times; v follows
    the profile upwards.
    """
    line = np.asarray(profile, np.float64)
    line = line[np.concatenate([[True], np.linalg.norm(np.diff(line, axis=0), axis=1) > 1e-9])]
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    step = np.diff(line, axis=0) / np.diff(along)[:, None]
    outward = np.stack([step[:, 1], -step[:, 0]], -1)
    rings, ring_normals = [], []
    for i in range(len(line)):
        before, after = outward[max(i - 1, 0)], outward[min(i, len(step) - 1)]
        sharp = before @ after < CREASE_COS
        for normal in (before, after) if sharp else ((before + after) / 2,):
            rings.append((*line[i], along[i]))
            ring_normals.append(normal / np.linalg.norm(normal))
    ring, normal = np.array(rings), np.array(ring_normals)
    angle = np.linspace(0, 2 * np.pi, segments + 1)
    c, s = np.cos(angle), np.sin(angle)
    vertices = np.stack(np.broadcast_arrays(ring[:, :1] * c, ring[:, :1] * s, ring[:, 1:2]), -1)
    normals = np.stack(
        np.broadcast_arrays(normal[:, :1] * c, normal[:, :1] * s, normal[:, 1:2]), -1
    )
    around = 1.0 if repeat_m is None else max(1, round(2 * np.pi * line[:, 0].max() / repeat_m))
    v = ring[:, 2] / (along[-1] if repeat_m is None else repeat_m)
    uv = np.stack(np.broadcast_arrays(around * angle / (2 * np.pi), v[:, None]), -1)
    faces = _grid_faces(len(ring), segments + 1)
    mesh = made(name, vertices.reshape(-1, 3), faces, uv.reshape(-1, 2), texture)
    solid = _with_area(mesh)
    return replace(solid, normals=normals.reshape(-1, 3).astype(np.float32))


def tube(
    path: Floats,
    radius: Floats | Sequence[float] | float,
    texture: Texture,
    repeat_m: float | None = None,
    name: str = "tube",
    segments: int = 14,
    flatness: float = 1.0,
    up: tuple[float, float, float] = (0.0, 1.0, 0.0),
) -> Mesh:
    """Sweep an ellipse along a path (N, 3) that does not run along ``up``; rounded ends stay open.

    Args:
        path: its middle, anywhere.
        radius: one, or one for each point of the path; 0 closes an end.
        texture: of its surface; u once around, v along.
        repeat_m: length of one repeat along v.
        name: of the mesh.
        segments: steps around.
        flatness: the radius along ``up`` over the one across it.
        up: direction that keeps the ellipse from turning.

    """
    line = np.asarray(path, np.float64)
    radii = np.broadcast_to(np.asarray(radius, np.float64), len(line))[:, None, None]
    tangent = np.gradient(line, axis=0)
    closed = np.allclose(line[0], line[-1])
    if closed:
        tangent[[0, -1]] = (line[1] - line[-2]) / 2
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    across = np.cross(tangent, up)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    over = np.cross(across, tangent)
    angle = np.linspace(0, 2 * np.pi, segments + 1)[:, None]
    circle = np.cos(angle) * across[:, None] + flatness * np.sin(angle) * over[:, None]
    vertices = line[:, None] + radii * circle
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    v = along / (along[-1] if repeat_m is None else repeat_m)
    uv = np.stack(np.broadcast_arrays(angle[:, 0] / (2 * np.pi), v[:, None]), -1)
    faces = _grid_faces(len(line), segments + 1)[:, ::-1]
    mesh = made(name, vertices.reshape(-1, 3), faces, uv.reshape(-1, 2), texture)
    return _with_area(replace(mesh, normals=_seamless(mesh, segments + 1, closed)))


def prism(
    outline: Sequence[tuple[float, float]] | Floats,
    height: float,
    texture: Texture,
    repeat_m: float | None = None,
    name: str = "prism",
) -> Mesh:
    """Raise a counter-clockwise outline (N, 2) from z = 0 to ``height``, sharp edged.

    Raises:
        ValueError: some of the outline cannot be seen from its middle.

    """
    line = np.asarray(outline, np.float64)
    middle, n = line.mean(0), len(line)
    a, b = line - middle, np.roll(line, -1, 0) - middle
    if (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0] <= 0).any():
        raise ValueError("outline: expected counter-clockwise and star-shaped about its mean")
    length = float(np.ptp(line, axis=0).max())
    scale = 1 / length if repeat_m is None else 1 / repeat_m
    caps, faces, uv = [], [], []
    for z, turn in ((0.0, -1), (height, 1)):
        flat = np.concatenate([[middle], line])
        base = sum(map(len, caps))
        i = np.arange(n)
        ring = np.stack([np.zeros(n, int), 1 + i, 1 + (i + 1) % n], -1)
        faces.append(base + (ring if turn > 0 else ring[:, ::-1]))
        caps.append(np.column_stack([flat, np.full(n + 1, z)]))
        uv.append((flat - line.min(0)) * scale)
    base = sum(map(len, caps))
    ends = np.stack([line, np.roll(line, -1, 0)], 1).reshape(-1, 2)
    steps = np.linalg.norm(np.diff(ends, axis=0), axis=1)
    around = np.concatenate([[0.0], np.cumsum(steps)]) * scale
    caps.append(np.column_stack([np.tile(ends, (2, 1)), np.repeat([0.0, height], 2 * n)]))
    uv.append(np.column_stack([np.tile(around, 2), np.repeat([0.0, height * scale], 2 * n)]))
    p = base + 2 * np.arange(n)
    q, r, s = p + 1, p + 1 + 2 * n, p + 2 * n
    faces += [np.stack([p, q, r], -1), np.stack([p, r, s], -1)]
    return made(name, np.concatenate(caps), np.concatenate(faces), np.concatenate(uv), texture)


def _grid_faces(rows: int, columns: int) -> NDArray[np.integer]:
    """Triangles of a grid of vertices, outward where row x column leads inwards."""
    k = np.arange(rows * columns).reshape(rows, columns)
    p, q, r, s = k[:-1, :-1], k[:-1, 1:], k[1:, 1:], k[1:, :-1]
    pairs = [np.stack([p, q, r], -1), np.stack([p, r, s], -1)]
    return np.concatenate([f.reshape(-1, 3) for f in pairs])


def _seamless(mesh: Mesh, columns: int, closed: bool) -> NDArray[np.float32]:
    """Normals of a tube whose first and last column, and rows if closed, are the same points."""
    grid = normals_of(mesh).reshape(-1, columns, 3).astype(np.float64)
    grid[:, [0, -1]] = (grid[:, :1] + grid[:, -1:]) / 2
    if closed:
        grid[[0, -1]] = (grid[:1] + grid[-1:]) / 2
    grid /= np.maximum(np.linalg.norm(grid, axis=-1, keepdims=True), 1e-9)
    return grid.reshape(-1, 3).astype(np.float32)


def _with_area(mesh: Mesh) -> Mesh:
    """Drop triangles without area: at the poles of turned things and between doubled rings."""
    a, b, c = (mesh.vertices[mesh.faces[:, i]].astype(np.float64) for i in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    return replace(mesh, faces=mesh.faces[area > 1e-12])
