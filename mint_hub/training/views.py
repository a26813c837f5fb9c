"""A window seen by another camera, or at another tempo: pictures and labels alike.

The labels stay exact. A mirrored scene has the left hand where the right one was; a crop about the
middle is the picture of a camera with a smaller field of view at the same place; what a camera
sees that is turned about its centre follows from the picture alone, by a homography.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from mint_hub.geometry import hand_state as hands
from mint_hub.geometry.camera import fov_vh_to_K, on_screen, project
from mint_hub.geometry.hand_model import HandModel, ShapeSpace
from mint_hub.geometry.hand_state import HandState, mirror_rotations
from mint_hub.geometry.rotations import (
    matrix_to_rot6d_rows,
    rot6d_rows_to_matrix,
    rotvec_to_matrix,
)
from mint_hub.loaders.fields import PER_FRAME_META
from mint_hub.loaders.schema import Episode

__all__ = ["OVERSIZE", "Tempo", "View", "ViewAugmentation"]

OVERSIZE: Final = 1.5
"""Pictures are kept this much larger than the network's, so that a crop of them is still sharp."""

_MIRROR: Final = np.diag([-1.0, 1.0, 1.0])
_SHIFT: Final = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])
_SHIFT_BACK: Final = np.linalg.inv(_SHIFT)


@dataclass(frozen=True)
class View:
    """Another camera at the same place.

    Attributes:
        mirror: left and right are exchanged, in the world as in the picture.
        zoom: share of the tangents of the half field of view that is kept, in (0, 1].
        turn_rad: rotation vector from the camera's axes, mirrored ones if it is, to the new one's.

    """

    mirror: bool = False
    zoom: float = 1.0
    turn_rad: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        if not 0 < self.zoom <= 1:
            raise ValueError(f"zoom: expected more than 0, at most 1, got {self.zoom}")

    @property
    def turn(self) -> NDArray[np.float64]:
        """The rotation of ``turn_rad``, (3, 3)."""
        return np.asarray(rotvec_to_matrix(np.array(self.turn_rad, np.float64)))

    def fov_vh_rad(self, fov_vh_rad: NDArray[Any]) -> NDArray[np.float64]:
        """Field of view of the new camera, of the old one's, radians."""
        return 2 * np.arctan(self.zoom * np.tan(np.asarray(fov_vh_rad, np.float64) / 2))

    def images(
        self,
        images: NDArray[np.uint8],
        fov_vh_rad: NDArray[Any],
        image_size_hw: tuple[int, int],
    ) -> NDArray[np.uint8]:
        """Take pictures (T, H, W, 3) of a field of view (T, 2) with this camera: (T, h, w, 3).

        What the old camera did not see is filled with the nearest pixel it saw.
        """
        height, width = images.shape[1:3]
        h, w = image_size_hw
        old = np.asarray(fov_vh_to_K(np.asarray(fov_vh_rad, np.float64), (height, width)))
        new = np.asarray(fov_vh_to_K(self.fov_vh_rad(fov_vh_rad), (h, w)))
        mirror = _MIRROR if self.mirror else np.eye(3)
        old_from_new = old @ mirror @ self.turn.T @ np.linalg.inv(new)
        # K counts from the border of a pixel, OpenCV from its middle.
        maps = _SHIFT_BACK @ old_from_new @ _SHIFT
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        made = [
            cv2.warpPerspective(image, H, (w, h), flags=flags, borderMode=cv2.BORDER_REPLICATE)
            for image, H in zip(images, maps, strict=True)
        ]
        return np.stack(made).astype(np.uint8, copy=False)

    def episode(self, episode: Episode) -> Episode:
        """Change labels alike; hands that are outside the new picture are not present."""
        poses, state = episode.T_camera_from_world, episode.hand_state
        presence, score, filled = episode.presence, episode.presence_score, episode.filled
        if self.mirror:
            mirror = np.eye(4)
            mirror[:3, :3] = _MIRROR
            poses = mirror @ poses @ mirror
            state, presence = _mirrored(state), presence[:, ::-1]
            score = None if score is None else score[:, ::-1]
            filled = None if filled is None else filled[:, ::-1]
        if any(self.turn_rad):
            turn = np.eye(4)
            turn[:3, :3] = self.turn
            poses, state = turn @ poses, _turned(state, self.turn)
        fov = self.fov_vh_rad(episode.fov_vh_rad)
        if self.zoom < 1 or any(self.turn_rad):
            space = episode.meta.get("shape_space")
            presence = presence & _inside(state, fov, episode.image_size_hw, space)
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
class Tempo:
    """Which frames of a stretch make a window: every ``step``-th one, forwards or backwards."""

    step: int = 1
    backward: bool = False

    def __post_init__(self) -> None:
        if self.step < 1:
            raise ValueError(f"step: expected at least 1, got {self.step}")

    def span(self, length: int) -> int:
        """Frames of the stretch that a window of ``length`` needs."""
        return (length - 1) * self.step + 1

    def frames(self, stretch: NDArray[Any]) -> NDArray[Any]:
        """Choose along the first axis."""
        return stretch[:: self.step][:: -1 if self.backward else 1]

    def episode(self, stretch: Episode) -> Episode:
        """Choose labels alike, timed as if filmed so; what is done has no text any more."""
        chosen = {
            name: None if (array := getattr(stretch, name)) is None else self.frames(array)
            for name in _PER_FRAME
        }
        times = stretch.timestamps_s[:: self.step]
        meta = {k: v for k, v in stretch.meta.items() if k not in ("fps", *PER_FRAME_META)}
        return replace(stretch, timestamps_s=times, text=(), meta=meta, **chosen)


_PER_FRAME: Final = (
    "T_camera_from_world",
    "fov_vh_rad",
    "hand_state",
    "presence",
    "presence_score",
    "filled",
)


@dataclass(frozen=True)
class ViewAugmentation:
    """Draws a view and a tempo for every window.

    Attributes:
        mirror: share of windows that are mirrored.
        zoom: smallest share of the picture that is kept; half of the windows keep all of it.
        turn_deg: standard deviations of turns to the side and up or down, and of roll; no more than
            twice that.
        steps: largest step of frames; 1 as often as all others together.
        backward: share of windows that run backwards.

    """

    mirror: float = 0.5
    zoom: float = 0.72
    turn_deg: tuple[float, float] = (4.0, 6.0)
    steps: int = 3
    backward: float = 0.5

    def __call__(self, rng: np.random.Generator) -> View:
        """Draw a view."""
        mirrored, narrowed = rng.random(2)
        zoom = float(rng.uniform(self.zoom, 1.0))
        aside, roll = self.turn_deg
        turn = np.radians(np.clip(rng.normal(size=3), -2, 2) * (aside, aside, roll))
        x, y, z = (float(angle) for angle in turn)
        return View(bool(mirrored < self.mirror), zoom if narrowed < 0.5 else 1.0, (x, y, z))

    def tempo(self, rng: np.random.Generator) -> Tempo:
        """Draw a tempo."""
        slow, back = rng.random(2)
        step = int(rng.integers(2, self.steps + 1)) if self.steps > 1 and slow < 0.5 else 1
        return Tempo(step, bool(back < self.backward))


def _mirrored(state: NDArray[np.float32]) -> NDArray[np.float32]:
    """Exchange the hands (..., 2, 109) across x; joint rotations of a left hand already are."""
    hand = hands.unpack(np.asarray(state, np.float64)[..., ::-1, :])
    turned = np.asarray(mirror_rotations(rot6d_rows_to_matrix(hand.orientation_rot6d_rows)))
    return _placed(hand, hand.translation @ _MIRROR, turned)


def _turned(state: NDArray[Any], turn: NDArray[np.float64]) -> NDArray[np.float32]:
    """Hands (..., 2, 109) in the axes of a turned camera."""
    hand = hands.unpack(np.asarray(state, np.float64))
    turned = turn @ np.asarray(rot6d_rows_to_matrix(hand.orientation_rot6d_rows))
    return _placed(hand, hand.translation @ turn.T, turned)


def _placed(
    hand: HandState, translation: NDArray[np.float64], orientation: NDArray[np.float64]
) -> NDArray[np.float32]:
    """A hand's posture and shape at another place, as a state."""
    rot6d = matrix_to_rot6d_rows(orientation)
    made = HandState(translation, rot6d, hand.joint_rot6d_rows, hand.shape_params)
    return np.asarray(made.pack(), np.float32)


def _inside(
    state: NDArray[np.float32],
    fov_vh_rad: NDArray[np.float64],
    image_size_hw: tuple[int, int],
    shape_space: ShapeSpace | None,
) -> NDArray[np.bool_]:
    """Whether any joint of a hand lies in the picture, (T, 2); joints of shapes that are not the
    template's are those of the mean shape.
    """
    model = HandModel.template()
    joints = np.asarray(model.keypoints(state.astype(np.float64), shape_space=shape_space))
    uv, z = project(joints, np.asarray(fov_vh_to_K(fov_vh_rad, image_size_hw)))
    seen: NDArray[np.bool_] = np.asarray(on_screen(uv, z, image_size_hw))
    return np.any(seen, axis=-1)
