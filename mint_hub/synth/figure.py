"""The person as triangles: hands, forearms and sleeves of a stretch of frames, camera frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, cast

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from mint_hub.conventions import SIDES
from mint_hub.geometry.hand_model import HandModel
from mint_hub.geometry.hand_state import unpack
from mint_hub.geometry.rigid import rotation_of
from mint_hub.synth.arms import (
    SEGMENTS,
    Direction,
    Rings,
    Wrist,
    skin_rings,
    sleeve_rings,
    tube_faces,
    tube_points,
    tube_uv,
    wrist_of,
)
from mint_hub.synth.skin import forearm_attributes, skin_attributes
from mint_hub.synth.world import Texture, World

LEFT_HAND: Final = 1
RIGHT_HAND: Final = 2
SLEEVE: Final = 5
"""Segments of the person; a bare forearm counts as a sleeve."""

SHOULDER_M: Final = (0.20, 0.36, 0.16)
"""From the camera to a shoulder: sideways and down in the world, back along the camera's axis."""

SLEEVE_REPEAT_M: Final = 0.25


@dataclass(frozen=True, eq=False)
class Part:
    """A connected surface of one side of the person.

    Attributes:
        hand: 0 left, 1 right.
        label: its segment.
        faces: (F, 3).
        static: (V, 6) skin numbers, or (V, 2) texture coordinates of a sleeve.
        texture: of a sleeve; None: skin.

    """

    hand: int
    label: int
    faces: NDArray[np.int32]
    static: NDArray[np.float32]
    texture: Texture | None


class Figure:
    """Both arms of a world, moved frame by frame."""

    def __init__(self, world: World, model: HandModel) -> None:
        self.world, self.model = world, model
        self.parts: list[Part] = []
        self._rings: list[tuple[Wrist, Rings] | None] = []
        for hand in range(len(SIDES)):
            if np.any(world.hands.exists[:, hand]):
                self._add(hand)
        self._gatherers = [_gatherer(part) for part in self.parts]

    def _add(self, hand: int) -> None:
        world, side = self.world, SIDES[hand]
        hands = world.hands
        first = int(np.argmax(hands.exists[:, hand]))
        shape = np.asarray(unpack(hands.hand_state[first, hand]).shape_params)
        wrist = wrist_of(self.model, side, shape)
        elbow = hands.forearm_length_m
        label = (LEFT_HAND, RIGHT_HAND)[hand]
        faces = self.model.faces(side).astype(np.int32)
        self.parts.append(Part(hand, label, faces, skin_attributes(self.model, side), None))
        self._rings.append(None)
        there = np.flatnonzero(hands.exists[:, hand])
        end = elbow + float(np.max(self._arm_direction(there, hand).upper_arm_length()))
        bare = skin_rings(wrist, elbow, end if hands.sleeve is None else wrist.end + 0.09)
        width = np.pi * float(wrist.half.sum())
        skin = forearm_attributes(tube_uv(bare, 1.0), width, wrist.end - 0.014)
        faces = tube_faces(len(bare.along), side)
        self.parts.append(Part(hand, SLEEVE, faces, skin, None))
        self._rings.append((wrist, bare))
        if hands.sleeve is not None:
            cloth = sleeve_rings(wrist, elbow, end, hands.sleeve.seed)
            uv = tube_uv(cloth, SLEEVE_REPEAT_M)
            faces = tube_faces(len(cloth.along), side)
            self.parts.append(Part(hand, SLEEVE, faces, uv, hands.sleeve))
            self._rings.append((wrist, cloth))

    def points(self, frames: Sequence[int]) -> list[NDArray[np.float32]]:
        """Vertices (len(frames), V, 3) of every part, metres, each in its frame's camera."""
        hands = self.world.hands
        rows = np.asarray(frames, int)
        made: list[NDArray[np.float32]] = []
        for part, tube in zip(self.parts, self._rings, strict=True):
            state, side = hands.hand_state[rows, part.hand], SIDES[part.hand]
            if tube is None:
                made.append(np.asarray(self.model.vertices(state, side), np.float32))
            else:
                to = self._arm_direction(rows, part.hand)
                made.append(tube_points(state, to, side, *tube))
        return made

    def _arm_direction(self, rows: NDArray[np.integer], hand: int) -> Direction:
        """Find where an arm goes, camera frame: its shoulder hangs below and behind the camera."""
        hands = self.world.hands
        R = rotation_of(self.world.T_camera_from_world[rows])
        forearm = (R @ hands.forearm_direction[rows, hand][..., None])[..., 0]
        forearm = forearm / np.maximum(np.linalg.norm(forearm, axis=-1, keepdims=True), 1e-12)
        wrist = np.asarray(unpack(hands.hand_state[rows, hand]).translation, np.float64)
        up = R[..., :, 2]
        right = np.cross([0.0, 0.0, 1.0], up) + 1e-3 * np.array([1.0, 0.0, 0.0])
        right = right / np.linalg.norm(right, axis=-1, keepdims=True)
        sideways, down, back = SHOULDER_M
        aside = (-sideways, sideways)[hand] * right
        shoulder = aside - down * up - np.array([0.0, 0.0, back])
        elbow = wrist + hands.forearm_length_m * forearm
        return Direction(forearm, shoulder - elbow, hands.forearm_length_m)

    def normals(self, part: int, points: NDArray[np.float32]) -> NDArray[np.float32]:
        """Unit normals (V, 3) of a part whose vertices (V, 3) are given."""
        faces = self.parts[part].faces
        a, b, c = (points[faces[:, i]] for i in range(3))
        across = _cross(b - a, c - a)
        total = cast("NDArray[np.float32]", self._gatherers[part] @ across)
        length = np.sqrt(np.einsum("vi,vi->v", total, total))[:, None]
        return (total / np.maximum(length, 1e-12)).astype(np.float32)


def _cross(a: NDArray[np.float32], b: NDArray[np.float32]) -> NDArray[np.float32]:
    (ax, ay, az), (bx, by, bz) = a.T, b.T
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], -1)


def _gatherer(part: Part) -> csr_matrix:
    """Sum faces at their vertices, (V, F); the two ends of a tube's rings are one vertex."""
    rows, columns = part.faces.ravel(), np.repeat(np.arange(len(part.faces)), 3)
    if part.label == SLEEVE:
        last = rows % (SEGMENTS + 1) == SEGMENTS
        first = rows % (SEGMENTS + 1) == 0
        twins = np.concatenate([rows[last] - SEGMENTS, rows[first] + SEGMENTS])
        rows = np.concatenate([rows, twins])
        columns = np.concatenate([columns, columns[last], columns[first]])
    ones = np.ones(len(rows), np.float32)
    return csr_matrix((ones, (rows, columns)), shape=(len(part.static), len(part.faces)))
