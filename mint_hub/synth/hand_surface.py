"""From a signed distance to a closed triangle mesh: surface nets, edge collapse, relaxation.

Everything is deterministic and needs numpy alone. Lengths are in the unit of the distance function.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

Distance = Callable[[np.ndarray], np.ndarray]
"""Points (N, 3) to signed distances (N,), negative inside; only near zero need it be a distance."""


def smooth_min(a: np.ndarray, b: np.ndarray, width: float) -> np.ndarray:
    """Union of two distances whose seam is rounded over ``width`` (quadratic polynomial blend)."""
    overlap = np.maximum(width - np.abs(a - b), 0.0) / width
    return np.minimum(a, b) - overlap * overlap * width / 4


def round_cone(
    points: np.ndarray,
    start: np.ndarray,
    end: np.ndarray,
    radii: tuple[float, float],
    dorsal: np.ndarray | None = None,
    flatness: float = 1.0,
) -> np.ndarray:
    """Approximate distance to a rod from ``start`` to ``end``, flattened along ``dorsal``."""
    bone = end - start
    along = np.clip((points - start) @ bone / (bone @ bone), 0.0, 1.0)
    offset = points - start - along[:, None] * bone
    squared = (offset * offset).sum(1)
    if dorsal is not None:
        squared = squared + (offset @ dorsal) ** 2 * (1 / flatness**2 - 1)
    return np.sqrt(squared) - (radii[0] + along * (radii[1] - radii[0]))


def surface_net(distance: Distance, low: np.ndarray, high: np.ndarray, cell: float) -> tuple:
    """Mesh the zero set of ``distance`` in a box: vertices (V, 3) and faces (F, 3), outward.

    One vertex in every cell that the surface crosses, one quad around every crossed grid edge
    (Gibson 1998, constrained elastic surface nets).
    """
    counts = np.ceil((high - low) / cell).astype(int) + 1
    axes = [low[i] + cell * np.arange(counts[i]) for i in range(3)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), -1)
    values = distance(grid.reshape(-1, 3)).reshape(counts)
    inside = values < 0
    total, crossings = np.zeros((*(counts - 1), 3)), np.zeros(counts - 1)
    shape = tuple(counts - 1)
    for axis in range(3):
        first = tuple(slice(None, -1) if i == axis else slice(None) for i in range(3))
        second = tuple(slice(1, None) if i == axis else slice(None) for i in range(3))
        crossed = inside[first] != inside[second]
        span = np.where(crossed, values[first] - values[second], 1.0)
        where = grid[first].copy()
        where[..., axis] += cell * np.where(crossed, values[first] / span, 0.0)
        for da in (0, 1):
            for db in (0, 1):
                offsets = np.insert([da, db], axis, 0)
                part = tuple(slice(o, o + n) for o, n in zip(offsets, shape, strict=True))
                total += np.where(crossed[part][..., None], where[part], 0.0)
                crossings += crossed[part]
    active = crossings > 0
    numbers = np.cumsum(active.ravel()).reshape(shape) - 1
    vertices = total[active] / crossings[active][:, None]
    quads = [_quads(inside, numbers, axis) for axis in range(3)]
    return vertices, _split(vertices, np.concatenate(quads))


def _quads(inside: np.ndarray, numbers: np.ndarray, axis: int) -> np.ndarray:
    """Quads around the grid edges along ``axis``, counter-clockwise seen from outside."""
    b, c = (axis + 1) % 3, (axis + 2) % 3
    lower = np.moveaxis(inside, (axis, b, c), (0, 1, 2))
    cells = np.moveaxis(numbers, (axis, b, c), (0, 1, 2))
    starts, ends = lower[:-1, 1:-1, 1:-1], lower[1:, 1:-1, 1:-1]
    crossed = starts != ends
    corners = [cells[:, :-1, :-1], cells[:, 1:, :-1], cells[:, 1:, 1:], cells[:, :-1, 1:]]
    quads = np.stack([corner[crossed] for corner in corners], -1)
    outward = starts[crossed]
    quads[~outward] = quads[~outward][:, ::-1]
    return quads


def _split(vertices: np.ndarray, quads: np.ndarray) -> np.ndarray:
    diagonal = np.linalg.norm(vertices[quads[:, 0]] - vertices[quads[:, 2]], axis=1)
    other = np.linalg.norm(vertices[quads[:, 1]] - vertices[quads[:, 3]], axis=1)
    turned = np.where((other < diagonal)[:, None], np.roll(quads, -1, axis=1), quads)
    return np.concatenate([turned[:, [0, 1, 2]], turned[:, [0, 2, 3]]])


def gradient(distance: Distance, points: np.ndarray, step: float = 0.05) -> np.ndarray:
    """Central differences of ``distance`` at (N, 3)."""
    moves = np.eye(3) * step
    return np.stack([(distance(points + m) - distance(points - m)) / (2 * step) for m in moves], -1)


def project(distance: Distance, points: np.ndarray, steps: int = 2) -> np.ndarray:
    """Move points onto the surface by Newton steps along the gradient."""
    for _ in range(steps):
        slope = gradient(distance, points)
        size = np.maximum((slope * slope).sum(1), 0.05)
        points = points - np.clip(distance(points) / size, -2, 2)[:, None] * slope
    return points


def relax(
    distance: Distance,
    vertices: np.ndarray,
    faces: np.ndarray,
    rounds: int,
    fixed: Sequence[int] = (),
) -> np.ndarray:
    """Even out the triangles: slide vertices along the surface to their neighbours' mean."""
    pairs = np.unique(np.sort(_edges(faces), axis=1), axis=0)
    ends = np.concatenate([pairs, pairs[:, ::-1]])
    degree = np.bincount(ends[:, 0], minlength=len(vertices))[:, None]
    for _ in range(rounds):
        pull = np.zeros_like(vertices)
        np.add.at(pull, ends[:, 0], vertices[ends[:, 1]])
        pull = pull / degree - vertices
        normal = gradient(distance, vertices)
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
        pull -= (pull * normal).sum(1, keepdims=True) * normal
        pull[list(fixed)] = 0.0
        vertices = project(distance, vertices + 0.6 * pull, steps=1)
    return project(distance, vertices, steps=2)


def collapse_edges(vertices: np.ndarray, faces: np.ndarray, target: int) -> tuple:
    """Merge the ends of the shortest edges until ``target`` vertices are left; stays a manifold.

    An edge is merged only when its ends share exactly two neighbours (the link condition) and no
    triangle turns over.
    """
    import heapq

    points = vertices.copy()
    triangles = {i: tuple(int(v) for v in f) for i, f in enumerate(faces)}
    around: list[set[int]] = [set() for _ in points]
    for i, triangle in triangles.items():
        for v in triangle:
            around[v].add(i)
    stamp = np.zeros(len(points), dtype=int)

    def neighbours(v: int) -> set[int]:
        return {w for i in around[v] for w in triangles[i]} - {v}

    def push(a: int, b: int) -> None:
        length = float(np.linalg.norm(points[a] - points[b]))
        heapq.heappush(heap, (length, min(a, b), max(a, b), int(stamp[a] + stamp[b])))

    heap: list[tuple[float, int, int, int]] = []
    for a, b in np.unique(np.sort(_edges(faces), axis=1), axis=0):
        push(int(a), int(b))
    left = len(points)
    while left > target and heap:
        _, a, b, when = heapq.heappop(heap)
        if when != stamp[a] + stamp[b] or not around[a] or not around[b]:
            continue
        if len(neighbours(a) & neighbours(b)) != 2:
            continue
        middle = (points[a] + points[b]) / 2
        if _turns_over(points, triangles, around[a] ^ around[b], (a, b), middle):
            continue
        for i in around[a] & around[b]:
            for v in triangles.pop(i):
                around[v].discard(i)
        for i in around[b]:
            triangles[i] = tuple(a if v == b else v for v in triangles[i])
        around[a] |= around[b]
        around[b] = set()
        points[a] = middle
        stamp[a] += 1
        left -= 1
        for w in sorted(neighbours(a)):
            push(a, w)
    kept = np.array(sorted({v for t in triangles.values() for v in t}))
    numbers = np.full(len(points), -1)
    numbers[kept] = np.arange(len(kept))
    return points[kept], numbers[np.array([triangles[i] for i in sorted(triangles)])]


def _turns_over(
    points: np.ndarray,
    triangles: dict[int, tuple[int, ...]],
    which: set[int],
    moved: tuple[int, int],
    to: np.ndarray,
) -> bool:
    for i in which:
        before = np.array([points[v] for v in triangles[i]])
        after = np.array([to if v in moved else points[v] for v in triangles[i]])
        old = np.cross(before[1] - before[0], before[2] - before[0])
        new = np.cross(after[1] - after[0], after[2] - after[0])
        if old @ new < 0.3 * np.linalg.norm(old) * np.linalg.norm(new):
            return True
    return False


def is_closed(faces: np.ndarray) -> bool:
    """Whether every edge lies in exactly two faces, once in each direction."""
    edges = {(int(a), int(b)) for a, b in _edges(faces)}
    return len(edges) == 3 * len(faces) and all((b, a) in edges for a, b in edges)


def _edges(faces: np.ndarray) -> np.ndarray:
    return np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
