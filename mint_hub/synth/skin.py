"""Where on a hand its nails, creases, knuckles and palm are: numbers for every vertex.

All are found on the resting template from its joints, so that any hand model will do. They change
linearly along the surface, so that the shader can draw edges finer than the mesh.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from mint_hub.conventions import JOINT_NAMES, Side
from mint_hub.geometry.hand_model import HandModel
from mint_hub.synth.hand_anatomy import REST_TURN, THUMB_PALMAR
from mint_hub.synth.raster import vertex_normals

NAIL_MIDDLE: Final = 0.70
"""Of a nail, along the last bone."""

NAIL_HALF: Final = (0.78, 0.30)
"""Half of a nail: across, over the finger's half width; along, over the last bone."""

NO_NAIL: Final = (9.0, 9.0)

SKIN_LAYOUT: Final = ("3f 2f 1f", "in_nail", "in_rest", "in_phase")
"""How `skin_attributes` is laid out: nail across and along (1 at its edge) and how far the surface
faces backwards, away from the palm; x and z of the straight right hand, metres; phase along the
finger: 1, 2, 3 at its joints, 4 at the tip, less than 1 in the palm."""


def skin_attributes(model: HandModel, side: Side) -> NDArray[np.float32]:
    """Numbers (V, 6) of a side's vertices, in the order of SKIN_LAYOUT."""
    asset = model.left if side == "left" else model.right
    straight = np.diag([-1.0 if side == "left" else 1.0, 1.0, 1.0]) @ REST_TURN
    vertices = np.asarray(asset.template, np.float64) @ straight
    normals = vertex_normals(np.asarray(asset.template, np.float64), asset.faces) @ straight
    joints = np.asarray(model.rest_joints(np.zeros(10), side)) @ straight
    tips = vertices[asset.tip_vertices]
    names = ("index", "middle", "pinky", "ring", "thumb")
    tip_of = dict(zip(("thumb", "index", "middle", "ring", "pinky"), tips, strict=True))
    belonging = [
        np.asarray(asset.skin_weights)[:, [JOINT_NAMES.index(f"{n}{i}") for i in (1, 2, 3)]].sum(1)
        for n in names
    ]
    finger_of = np.where(np.max(belonging, 0) > 0.05, np.argmax(belonging, 0), -1)
    nail = np.column_stack([np.tile(NO_NAIL, (len(vertices), 1)), normals[:, 1]])
    phase = np.full(len(vertices), 0.5)
    for f, name in enumerate(names):
        own = finger_of == f
        first = JOINT_NAMES.index(f"{name}1")
        line = np.concatenate([joints[first : first + 3], tip_of[name][None]])
        phase[own] = _phase(vertices[own], line)
        nail[own] = _nail(vertices[own], normals[own], line, name == "thumb")
    return np.column_stack([nail, vertices[:, [0, 2]], phase]).astype(np.float32)


def _phase(points: NDArray[np.float64], line: NDArray[np.float64]) -> NDArray[np.float64]:
    """1 to 4 along a finger's three joints and tip; less before them, at the same rate."""
    along = np.zeros(len(points))
    for i in range(3):
        bone = line[i + 1] - line[i]
        share = (points - line[i]) @ bone / (bone @ bone)
        along += np.clip(share, -1.0 if i == 0 else 0.0, 1.0)
    return np.maximum(1 + along, 0.3)


def _nail(
    points: NDArray[np.float64],
    normals: NDArray[np.float64],
    line: NDArray[np.float64],
    is_thumb: bool,
) -> NDArray[np.float64]:
    bone = line[3] - line[2]
    length = np.linalg.norm(bone)
    axis = bone / length
    back = -np.array(THUMB_PALMAR) if is_thumb else np.array([0.0, 1.0, 0.0])
    back = back - (back @ axis) * axis
    back /= np.linalg.norm(back)
    offset = points - line[2]
    across, along = offset @ np.cross(axis, back), offset @ axis
    beyond = along > 0.3 * length
    half = np.quantile(np.abs(across[beyond]), 0.95) if beyond.any() else 0.007
    x = across / (NAIL_HALF[0] * half)
    y = (along / length - NAIL_MIDDLE) / NAIL_HALF[1]
    return np.column_stack([x, y, normals @ back])


def forearm_attributes(uv: NDArray[np.floating], width: float, start: float) -> NDArray[np.float32]:
    """Make the same numbers for a tube of skin whose coordinates are ``uv`` (V, 2): around, metres.

    Args:
        uv: once around in 0 to 1; along, metres from its start.
        width: metres around it.
        start: x of the straight hand where it begins.

    """
    around, along = uv[:, 0], uv[:, 1]
    wrapped = np.abs(around * 2 - 1) * width / 2  # there and back again: no seam
    ones = np.ones(len(uv))
    return np.column_stack(
        [9 * ones, 9 * ones, 0.4 * ones, start + along, wrapped, 0.3 * ones]
    ).astype(np.float32)
