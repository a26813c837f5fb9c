"""A small z-buffered rasteriser in numpy, for the sheet of hands, and the normals of any mesh.

Everything is linear on the screen, which is right as it stands for an orthographic view.
"""

from __future__ import annotations

import numpy as np


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return unit outward normals (V, 3), faces weighted by area."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    across = np.cross(b - a, c - a)
    normals = np.zeros_like(vertices)
    for i in range(3):
        np.add.at(normals, faces[:, i], across)
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)


def fill(
    corners: np.ndarray, attributes: np.ndarray, depth: np.ndarray, buffer: np.ndarray
) -> None:
    """Draw one triangle into ``depth`` and ``buffer``, where it is nearer than what is there.

    Args:
        corners: (3, 3) column, row and depth; pixel (i, j) is sampled at column j, row i.
        attributes: (3, C) of the corners.
        depth: (H, W), smaller is nearer; changed in place.
        buffer: (H, W, C) interpolated attributes; changed in place.

    """
    low = np.maximum(np.ceil(corners[:, :2].min(0)).astype(int), 0)
    high = np.minimum(np.floor(corners[:, :2].max(0)).astype(int) + 1, depth.shape[::-1])
    if (high <= low).any():
        return
    (ax, ay), (bx, by), (cx, cy) = corners[:, :2]
    area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax)
    if abs(area) < 1e-12:
        return
    xs, ys = np.arange(low[0], high[0])[None, :], np.arange(low[1], high[1])[:, None]
    wb = ((xs - ax) * (cy - ay) - (ys - ay) * (cx - ax)) / area
    wc = ((bx - ax) * (ys - ay) - (by - ay) * (xs - ax)) / area
    wa = 1 - wb - wc
    inside = (wa >= -1e-9) & (wb >= -1e-9) & (wc >= -1e-9)
    z = wa * corners[0, 2] + wb * corners[1, 2] + wc * corners[2, 2]
    part = np.s_[low[1] : high[1], low[0] : high[0]]
    nearer = inside & (z < depth[part])
    depth[part][nearer] = z[nearer]
    weights = np.stack([wa[nearer], wb[nearer], wc[nearer]], -1)
    buffer[part][nearer] = weights @ attributes
