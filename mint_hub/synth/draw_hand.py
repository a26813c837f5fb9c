"""Draw the sheet of poses and shapes: ``python -m mint_hub.synth.draw_hand``.

A z-buffered rasteriser with smooth shading, in numpy; OpenCV only writes letters and the file.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

import cv2
import numpy as np

from mint_hub.assets import asset_path
from mint_hub.conventions import JOINT_NAMES, Side
from mint_hub.geometry.hand_model import HandModel
from mint_hub.geometry.hand_state import HandState
from mint_hub.geometry.rotations import rotvec_to_matrix
from mint_hub.synth.hand_anatomy import REST_TURN, SPLAY_DEG, THUMB_DIRECTIONS, THUMB_PALMAR
from mint_hub.synth.raster import fill, vertex_normals

PANEL: Final = 210
OVERSAMPLING: Final = 2
SKIN: Final = np.array([224.0, 178.0, 150.0])
PAPER: Final = np.array([247.0, 247.0, 249.0])

BACK: Final = np.array([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Image axes (right, down, away) from the hand's, looking at the back of a right hand."""


def pose(
    curl: dict[str, Sequence[float]] | None = None,
    spread: dict[str, float] | None = None,
    thumb: tuple[Sequence[float], float, float] = ((0, 0, 0), 0, 0),
) -> np.ndarray:
    """Joint rotations (15, 3, 3) of a right hand from angles in degrees, about its straight axes.

    Args:
        curl: flexion of a finger's three joints, towards the palm.
        spread: of a finger in the palm's plane, positive towards the thumb.
        thumb: rotation vector of its base (x opposes it to the fingers, -y closes it to the palm),
            then flexion of its other two joints.

    """
    rotations = np.tile(np.eye(3), (len(JOINT_NAMES), 1, 1))
    for finger, angles in (curl or {}).items():
        sideways = np.deg2rad((spread or {}).get(finger, 0.0))
        rest = np.deg2rad(SPLAY_DEG[finger])
        across = np.array([np.sin(rest), 0.0, np.cos(rest)])
        for i, angle in enumerate(angles, 1):
            joint = JOINT_NAMES.index(f"{finger}{i}")
            rotations[joint] = rotvec_to_matrix(np.deg2rad(angle) * across)
            if i == 1:
                turn = rotvec_to_matrix(np.array([0.0, sideways, 0.0]))
                rotations[joint] = turn @ rotations[joint]
    bend = np.cross(THUMB_DIRECTIONS[1], THUMB_PALMAR)
    bend /= np.linalg.norm(bend)
    rotations[JOINT_NAMES.index("thumb1")] = rotvec_to_matrix(np.deg2rad(thumb[0]))
    for joint, flexion in zip(("thumb2", "thumb3"), thumb[1:], strict=True):
        rotations[JOINT_NAMES.index(joint)] = rotvec_to_matrix(np.deg2rad(flexion) * bend)
    return REST_TURN @ rotations[1:] @ REST_TURN.T


def _all(*angles: float) -> dict[str, Sequence[float]]:
    return dict.fromkeys(("index", "middle", "ring", "pinky"), angles)


CLOSED: Final = {"index": -8.0, "middle": -1.0, "ring": 6.0, "pinky": 14.0}
THUMB_OVER: Final = ((33, -6, 6), 28, 54)

POSES: Final[dict[str, Callable[[], np.ndarray]]] = {
    "flat": lambda: pose(),
    "relaxed": lambda: pose(
        {
            "index": (18, 25, 12),
            "middle": (24, 30, 14),
            "ring": (28, 34, 16),
            "pinky": (30, 34, 18),
        },
        {"index": -5, "ring": 3, "pinky": 8},
        ((14, -8, 4), 10, 14),
    ),
    "spread": lambda: pose(
        _all(-4, -2, 0),
        {"index": 8, "middle": 1, "ring": -5, "pinky": -9},
        ((-6, 8, 0), -4, -8),
    ),
    "fist": lambda: pose(_all(82, 104, 66), CLOSED, THUMB_OVER),
    "point": lambda: pose({**_all(80, 102, 64), "index": (2, 3, 2)}, CLOSED, THUMB_OVER),
    "pinch": lambda: pose(
        {
            "index": (32, 63, 36),
            "middle": (28, 32, 14),
            "ring": (22, 26, 12),
            "pinky": (16, 22, 12),
        },
        {"index": -3, "pinky": 6},
        ((29, 2, 0), 20, 10),
    ),
}


def draw(
    vertices: np.ndarray,
    faces: np.ndarray,
    image_from_hand: np.ndarray,
    size: int = PANEL,
    extent: float = 0.25,
    centre: np.ndarray | None = None,
) -> np.ndarray:
    """One panel (size, size, 3) uint8: an orthographic view, light from the upper left.

    Args:
        vertices: (V, 3) metres.
        faces: (F, 3), counter-clockwise from outside.
        image_from_hand: (3, 3) rotation to right, down, away.
        size: pixels.
        extent: metres across the panel.
        centre: (3,) point drawn in the middle; the mesh's own middle without it.

    """
    resolution = size * OVERSAMPLING
    turned = vertices @ image_from_hand.T
    middle = (turned.max(0) + turned.min(0)) / 2 if centre is None else image_from_hand @ centre
    pixels = (turned - middle) * (resolution / extent) + [resolution / 2, resolution / 2, 0]
    normals = vertex_normals(turned, faces)
    depth = np.full((resolution, resolution), np.inf)
    shading = np.zeros((resolution, resolution, 3))
    for face in faces:
        fill(pixels[face], normals[face], depth, shading)
    image = np.broadcast_to(PAPER, shading.shape).copy()
    seen = np.isfinite(depth)
    image[seen] = _colour(shading[seen])
    small = image.reshape(size, OVERSAMPLING, size, OVERSAMPLING, 3).mean((1, 3))
    return (np.clip(small, 0, 255) / 5).round().astype(np.uint8) * 5  # fewer colours, smaller file


def _colour(normals: np.ndarray) -> np.ndarray:
    unit = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    key, fill = np.array([-0.55, -0.62, -0.56]), np.array([0.75, 0.1, -0.65])
    diffuse = np.clip(unit @ key / np.linalg.norm(key), 0, 1)
    soft = np.clip(unit @ fill / np.linalg.norm(fill), 0, 1)
    rim = np.clip(1 + unit[:, 2], 0, 1) ** 2
    light = 0.34 + 0.62 * diffuse + 0.16 * soft - 0.22 * rim
    return SKIN * light[:, None] + 18 * diffuse[:, None] ** 12


PALM: Final = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""Looking at the palm of a right hand."""


def _turned(view: np.ndarray, yaw: float, pitch: float = 0.0) -> np.ndarray:
    return rotvec_to_matrix(np.deg2rad([pitch, 0.0, 0.0])) @ (
        rotvec_to_matrix(np.deg2rad([0.0, yaw, 0.0])) @ view
    )


def hand_mesh(
    model: HandModel, side: Side, rotations: np.ndarray, shape: dict[int, float] | None = None
) -> np.ndarray:
    """Vertices (V, 3) of one posed hand, the wrist at the origin."""
    shape_params = np.zeros(10)
    for number, value in (shape or {}).items():
        shape_params[number] = value
    state = HandState.from_matrices(np.zeros(3), np.eye(3), rotations, shape_params)
    return np.asarray(model.vertices(state.pack(), side))


def sheet(model: HandModel) -> np.ndarray:
    """All poses from three sides, both hands, and eight shapes: one image, RGB uint8."""
    mirror = np.diag([-1.0, 1.0, 1.0])
    rows: list[list[tuple[str, np.ndarray, np.ndarray, np.ndarray]]] = []
    views = {"": BACK, ", palm": PALM, ", oblique": _turned(BACK, -55.0, -20.0)}
    right, left = model.faces("right"), model.faces("left")
    for label, view in views.items():
        rows.append(
            [(n + label, hand_mesh(model, "right", p()), right, view) for n, p in POSES.items()]
        )
    rows.append(
        [
            ("left, " + name, hand_mesh(model, "left", p()), left, mirror @ BACK @ mirror)
            for name, p in POSES.items()
        ]
    )
    shapes: dict[str, dict[int, float]] = {
        "small": {0: -2.0},
        "large": {0: 2.0},
        "slender": {1: -1.5, 2: -1.5, 4: -2.0, 6: -2.0, 3: 1.0},
        "thick": {1: 1.5, 2: 1.5, 4: 2.0, 6: 2.0, 3: -1.0},
        "long fingers": {3: 2.0, 8: 1.0, 5: 1.0},
        "short fingers": {3: -2.0, 8: -1.0, 5: -1.0},
    }
    rows.append(
        [
            (name, hand_mesh(model, "right", POSES["flat"](), shape), right, BACK)
            for name, shape in shapes.items()
        ]
    )
    lines = [np.hstack([_panel(*cell) for cell in row]) for row in rows]
    return np.vstack(lines)


def _panel(label: str, vertices: np.ndarray, faces: np.ndarray, view: np.ndarray) -> np.ndarray:
    image = np.ascontiguousarray(draw(vertices, faces, view))
    font = cv2.FONT_HERSHEY_SIMPLEX
    cv2.putText(image, label, (8, PANEL - 9), font, 0.45, (70, 70, 80), 1, cv2.LINE_AA)
    return image


def main() -> None:
    """Write the sheet beside this script, or to ``--out``."""
    parser = argparse.ArgumentParser(description="Draw the licence-free hand.")
    default = asset_path("hand_template.png")
    parser.add_argument("--out", type=Path, default=default)
    image = sheet(HandModel.template())
    out: Path = parser.parse_args().out
    cv2.imwrite(str(out), image[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 9])


if __name__ == "__main__":
    main()
