"""What is known of hands before they are fitted: sight lines and bone directions.

Letters in shapes: N hands, 21 landmarks in OpenPose order, B bones. Left hands are mirrored across
the camera's x, and so are right hands from here on; `hand_states` mirrors them back.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mint_hub.conventions import KEYPOINT_BONES, LEFT, SIDES
from mint_hub.geometry.hand_model import HandModel
from mint_hub.geometry.hand_state import HandState, mirror_rotations
from mint_hub.geometry.rotations import rotvec_to_matrix
from mint_hub.labelling.stages.hand_skeleton import pose as bend
from mint_hub.labelling.stages.hand_skeleton import rest_points
from mint_hub.synth.hand_pose import MIRROR

Floats = NDArray[np.float64]

BONES: Final = np.array([*KEYPOINT_BONES, (5, 17), (5, 13), (9, 17)])
"""Whose directions are compared: those of the skeleton, and three across the palm."""


@dataclass(frozen=True, eq=False)
class Pose:
    """N hands in the camera frame.

    Attributes:
        rotation: (N, 3, 3) camera from wrist.
        translation: (N, 3) wrist, metres.
        angles: (N, 21) radians.

    """

    rotation: Floats
    translation: Floats
    angles: Floats

    def __getitem__(self, which: Any) -> Pose:
        return Pose(self.rotation[which], self.translation[which], self.angles[which])

    def updated(self, which: Any, other: Pose) -> Pose:
        """Return a copy with the hands ``which`` taken from ``other``."""
        mine = Pose(self.rotation.copy(), self.translation.copy(), self.angles.copy())
        mine.rotation[which] = other.rotation
        mine.translation[which] = other.translation
        mine.angles[which] = other.angles
        return mine

    def moved(self, step: Floats) -> Pose:
        """Turn (in the wrist's frame), shift and bend by a step (N, 27)."""
        turned = self.rotation @ rotvec_to_matrix(step[:, :3])
        return Pose(turned, self.translation + step[:, 3:6], self.angles + step[:, 6:])


@dataclass(frozen=True, eq=False)
class Evidence:
    """What is known of N hands.

    Attributes:
        seen: (N, 21, 2) landmarks on the plane at depth 1; 0 where there is none.
        weight: (N, 21) of each landmark; 0 where there is none.
        seen_noise: (N,) standard deviation of ``seen``.
        directions: (N, B, 3) unit bone directions in the camera frame; 0 where there is none.
        direction_noise: (N,) standard deviation of ``directions``.
        rest: (N, 21, 3) joints and tips of the flat hand.
        near: what neighbouring frames say, if they are asked.
        near_noise: (N, 3) standard deviations of its turn, logarithm of depth, and angles.

    """

    seen: Floats
    weight: Floats
    seen_noise: Floats
    directions: Floats
    direction_noise: Floats
    rest: Floats
    near: Pose | None = None
    near_noise: Floats | None = None

    def __getitem__(self, which: Any) -> Evidence:
        cut: dict[str, Any] = {k: None if v is None else v[which] for k, v in vars(self).items()}
        return Evidence(**cut)

    def with_depth_reversed(self) -> Evidence:
        """Return the same with bone directions mirrored along the sight line of each hand."""
        known = self.weight > 0
        centre = (self.seen * known[..., None]).sum(1) / known.sum(1)[:, None]
        sight = np.concatenate([centre, np.ones((len(centre), 1))], -1)
        sight /= np.linalg.norm(sight, axis=-1, keepdims=True)
        along = self.directions @ sight[..., None]  # (N, B, 1)
        return replace(self, directions=self.directions - 2 * along * sight[:, None])

    @property
    def bone_weight(self) -> Floats:
        """(N, B), 0 where a bone has no direction."""
        return np.any(self.directions != 0, axis=-1).astype(np.float64)


@dataclass(frozen=True)
class NoiseSettings:
    """What is believed of a detector's landmarks.

    Attributes:
        pixel_noise: standard deviation of a landmark, as a share of the hand's size in the image.
        direction_noise_deg: standard deviation of a bone's direction.
        outside_weight: weight of a landmark outside the image, which can only be guessed.

    """

    pixel_noise: float = 0.02
    direction_noise_deg: float = 15.0
    outside_weight: float = 0.2


@dataclass(frozen=True, eq=False)
class Seen:
    """Landmarks of N hands, as detected.

    Attributes:
        uv: (N, 21, 2) pixels, NaN where there is none.
        metres: (N, 21, 3) as `Detections.landmarks_m`.
        hand: (N,) LEFT or RIGHT.

    """

    uv: Floats
    metres: Floats
    hand: NDArray[np.int64]

    @property
    def size_px(self) -> Floats:
        """(N,) diagonal of the landmarks' bounds; NaN without landmarks."""
        known = np.asarray(np.isfinite(self.uv).all(-1))
        high = np.where(known[..., None], self.uv, -np.inf).max(1)
        low = np.where(known[..., None], self.uv, np.inf).min(1)
        some = known.sum(1) > 0
        extent = np.where(some[:, None], high, np.nan) - np.where(some[:, None], low, np.nan)
        return np.linalg.norm(extent, axis=-1)


def evidence_of(
    seen: Seen,
    K: Floats,
    image_size_hw: tuple[int, int],
    rest: Floats,
    settings: NoiseSettings | None = None,
) -> Evidence:
    """Turn landmarks into sight lines and bone directions in the camera frame.

    A detector's 3-D landmarks are as if the hand were seen on the optical axis; they are turned by
    the rotation that takes the axis to the sight line of the hand's centre.

    Args:
        seen: N hands, each with some landmarks.
        K: (3, 3) pinhole.
        image_size_hw: of the frames.
        rest: (2, 21, 3) flat hands, left and right, as `hand_skeleton.rest_points`.
        settings: noise.

    """
    settings = settings or NoiseSettings()
    focal, middle = np.array([K[0, 0], K[1, 1]]), K[:2, 2]
    mirror = np.where((seen.hand == LEFT)[:, None], MIRROR["left"], MIRROR["right"])[:, None]
    known = np.asarray(np.isfinite(seen.uv).all(-1))
    on_plane = np.where(known[..., None], (seen.uv - middle) / focal * mirror[..., :2], 0.0)
    height, width = image_size_hw
    inside = known & (seen.uv >= 0).all(-1) & (seen.uv < (width, height)).all(-1)
    weight = np.where(inside, 1.0, np.where(known, settings.outside_weight, 0.0))
    size = np.maximum(seen.size_px, 1.0) / focal.mean()
    bones = (seen.metres[:, BONES[:, 1]] - seen.metres[:, BONES[:, 0]]) * mirror
    length = np.linalg.norm(bones, axis=-1, keepdims=True)
    directions = np.where(length > 0, bones / np.where(length > 0, length, 1), 0.0)
    centre = (on_plane * known[..., None]).sum(1) / np.maximum(known.sum(1), 1)[:, None]
    turned = np.nan_to_num(directions) @ np.swapaxes(turn_from_axis(centre), 1, 2)
    return Evidence(
        seen=on_plane,
        weight=weight,
        seen_noise=settings.pixel_noise * size,
        directions=turned,
        direction_noise=np.full(len(size), np.deg2rad(settings.direction_noise_deg)),
        rest=rest[seen.hand],
    )


def turn_from_axis(on_plane: Floats) -> Floats:
    """Least rotation from the optical axis to the sight line of (N, 2) at depth 1: (N, 3, 3)."""
    x, y = on_plane.T
    axis = np.stack([-y, x, np.zeros_like(x)], -1)
    sine = np.linalg.norm(axis, axis=-1, keepdims=True)
    return rotvec_to_matrix(axis / np.maximum(sine, 1e-12) * np.arctan(sine))


def rest_of(model: HandModel, shape_params: Floats) -> Floats:
    """Flat hands of a model with shape numbers (10,): (2, 21, 3)."""
    return np.stack([rest_points(model, side, shape_params) for side in SIDES])


def hand_states(found: Pose, hand: NDArray[np.int64], shape_params: Floats) -> Floats:
    """Make hand states of fitted poses, left hands mirrored back: (N, 109)."""
    left = hand == LEFT
    mirror = np.where(left[:, None], MIRROR["left"], MIRROR["right"])
    # mirror_rotations is what mirroring across x does to a rotation, whichever way round.
    orientation = np.where(left[:, None, None], mirror_rotations(found.rotation), found.rotation)
    rotations = bend(found.angles, np.zeros((21, 3)), with_jacobian=False).rotations
    shape = np.broadcast_to(shape_params, (len(hand), len(shape_params)))
    state = HandState.from_matrices(found.translation * mirror, orientation, rotations, shape)
    return np.asarray(state.pack())
