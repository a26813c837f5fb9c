"""A window seen by another camera: mirrored, or through a narrower lens, pictures and labels alike.

The labels stay exact. A mirrored scene has the left hand where the right one was; a crop about the
middle is the picture of a camera with a smaller field of view at the same place.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from mint_hub.geometry import hand_state as hands
from mint_hub.geometry.camera import fov_vh_to_K, on_screen, project
from mint_hub.geometry.hand_model import HandModel
from mint_hub.geometry.hand_state import HandState, mirror_rotations
from mint_hub.geometry.rotations import matrix_to_rot6d_rows, rot6d_rows_to_matrix
from mint_hub.loaders.schema import Episode

__all__ = ["OVERSIZE", "View", "ViewAugmentation"]

OVERSIZE: Final = 1.5
"""Pictures are kept this much larger than the network's, so that a crop of them is still sharp."""

_MIRROR: Final = np.diag([-1.0, 1.0, 1.0])


@dataclass(frozen=True)
class View:
    """Another camera at the same place.

    Attributes:
        mirror: left and right are exchanged, in the world as in the picture.
        zoom: share of the tangents of the half field of view that is kept, in (0, 1].

    """

    mirror: bool = False
    zoom: float = 1.0

    def __post_init__(self) -> None:
        if not 0 < self.zoom <= 1:
            raise ValueError(f"zoom: expected more than 0, at most 1, got {self.zoom}")

    def images(
        self, images: NDArray[np.uint8], image_size_hw: tuple[int, int]
    ) -> NDArray[np.uint8]:
        """Take pictures (T, H, W, 3) with this camera: (T, h, w, 3)."""
        height, width = images.shape[1:3]
        h, w = image_size_hw
        # Continuous coordinates: 0 at the left border, the size at the right one.
        sx, sy = self.zoom * width / w, self.zoom * height / h
        x0, y0 = (1 - self.zoom) * width / 2, (1 - self.zoom) * height / 2
        if self.mirror:
            sx, x0 = -sx, width - x0
        source = np.array([[sx, 0, x0 + (sx - 1) / 2], [0, sy, y0 + (sy - 1) / 2]])
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        made = [
            cv2.warpAffine(image, source, (w, h), flags=flags, borderMode=cv2.BORDER_REPLICATE)
            for image in images
        ]
        return np.stack(made).astype(np.uint8, copy=False)

    def episode(self, episode: Episode) -> Episode:
        """Change labels alike; hands that a crop leaves outside the picture are not present."""
        poses, state = episode.T_camera_from_world, episode.hand_state
        presence, score, filled = episode.presence, episode.presence_score, episode.filled
        if self.mirror:
            mirror = np.eye(4)
            mirror[:3, :3] = _MIRROR
            poses = mirror @ poses @ mirror
            state, presence = _mirrored(state), presence[:, ::-1]
            score = None if score is None else score[:, ::-1]
            filled = None if filled is None else filled[:, ::-1]
        fov = 2 * np.arctan(self.zoom * np.tan(np.asarray(episode.fov_vh_rad, float) / 2))
        if self.zoom < 1:
            presence = presence & _inside(state, fov, episode.image_size_hw)
            state = np.where(presence[..., None], state, hands.absent(presence.shape))
            score = None if score is None else score * presence
            filled = None if filled is None else filled & presence
        return replace(
            episode,
            T_camera_from_world=poses,
            fov_vh_rad=fov.astype(np.float32),
            hand_state=np.ascontiguousarray(state, np.float32),
            presence=np.ascontiguousarray(presence),
            presence_score=None if score is None else np.ascontiguousarray(score, np.float32),
            filled=None if filled is None else np.ascontiguousarray(filled),
        )


@dataclass(frozen=True)
class ViewAugmentation:
    """Draws a view for every window.

    Attributes:
        mirror: share of windows that are mirrored.
        zoom: smallest share of the picture that is kept; half of the windows keep all of it.

    """

    mirror: float = 0.5
    zoom: float = 0.72

    def __call__(self, rng: np.random.Generator) -> View:
        """Draw one."""
        mirrored, narrowed = rng.random(2)
        zoom = float(rng.uniform(self.zoom, 1.0))
        return View(bool(mirrored < self.mirror), zoom if narrowed < 0.5 else 1.0)


def _mirrored(state: NDArray[np.float32]) -> NDArray[np.float32]:
    """Exchange the hands (..., 2, 109) across x; joint rotations of a left hand already are."""
    hand = hands.unpack(np.asarray(state, np.float64)[..., ::-1, :])
    turned = mirror_rotations(rot6d_rows_to_matrix(hand.orientation_rot6d_rows))
    made = HandState(
        hand.translation @ _MIRROR,
        matrix_to_rot6d_rows(turned),
        hand.joint_rot6d_rows,
        hand.shape_params,
    )
    return np.asarray(made.pack(), np.float32)


def _inside(
    state: NDArray[np.float32], fov_vh_rad: NDArray[np.float64], image_size_hw: tuple[int, int]
) -> NDArray[np.bool_]:
    """Whether any joint of a hand lies in the picture: (T, 2)."""
    joints = np.asarray(HandModel.template().keypoints(state.astype(np.float64)))
    uv, z = project(joints, np.asarray(fov_vh_to_K(fov_vh_rad, image_size_hw)))
    seen: NDArray[np.bool_] = np.asarray(on_screen(uv, z, image_size_hw))
    return np.any(seen, axis=-1)
