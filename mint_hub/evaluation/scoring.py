"""One clip against its truth: statistics that add, whole and by strata.

Hands are scored under three readings of the camera, because a network that mistakes the focal
length mistakes depth with it:

- ``published``: as predicted, projected with the true K. This is what the paper's tables do.
- ``predicted``: as predicted, projected with the predicted K: nothing is known.
- ``known``: wrists moved to where they are under the true focal length, projected with the true K:
  the camera is known (`inference.known_camera`).
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import nan
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from mint_hub.evaluation.clips import Clip
from mint_hub.evaluation.strata import strata_of
from mint_hub.geometry.camera import K_to_fov_vh
from mint_hub.geometry.hand_model import HandModel, ShapeSpace
from mint_hub.geometry.hand_state import unpack
from mint_hub.geometry.metrics import (
    Hands,
    HandStatistics,
    TrajectoryErrors,
    WorldHands,
    WorldStatistics,
    canonical_joints,
    hand_statistics,
    none_for_nan,
    present_hands,
    trajectory_errors,
    world_hand_statistics,
)
from mint_hub.inference.known_camera import correct_translation
from mint_hub.loaders.schema import Episode

Reading = Literal["published", "predicted", "known"]
READINGS: Final[tuple[Reading, ...]] = ("published", "predicted", "known")
ALIGNMENTS: Final = ("SE(3)", "Sim(3)", "SE(3), known intrinsics")
NO_CAMERA: Final = ("always present", "mean hand")
"""Rows whose camera is not asked for: they say nothing that ``zero camera motion`` does not."""
NO_HANDS: Final = ("zero camera motion",)
"""Rows whose camera-frame hands are those of another row."""


@dataclass(frozen=True)
class Score:
    """One prediction of one clip.

    Attributes:
        hands: by reading; empty where the truth has no hands.
        camera: the path's errors, or None where the row has no camera.
        world: world hands by ALIGNMENTS; empty without hands or camera.
        strata: hands as published by "name: bin"; only bins with frames.
        fov_error_deg: mean error of the horizontal field of view, degrees, without sign.

    """

    hands: dict[str, HandStatistics] = field(default_factory=dict[str, HandStatistics])
    camera: TrajectoryErrors | None = None
    world: dict[str, WorldStatistics] = field(default_factory=dict[str, WorldStatistics])
    strata: dict[str, HandStatistics] = field(default_factory=dict[str, HandStatistics])
    fov_error_deg: float = nan

    def to_dict(self) -> dict[str, Any]:
        """Return what JSON holds of it."""
        return {
            "hands": {k: v.to_dict() for k, v in self.hands.items()},
            "camera": None if self.camera is None else self.camera.to_dict(),
            "world": {k: v.to_dict() for k, v in self.world.items()},
            "strata": {k: v.to_dict() for k, v in self.strata.items()},
            "fov_error_deg": none_for_nan(self.fov_error_deg),
        }

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "Score":
        """Invert ``to_dict``; ValueError where a field is missing or unknown."""
        if set(values) != {"hands", "camera", "world", "strata", "fov_error_deg"}:
            raise ValueError(f"score: expected its five fields, got {sorted(values)}")
        camera, fov = values["camera"], values["fov_error_deg"]
        return cls(
            {k: HandStatistics.from_dict(v) for k, v in values["hands"].items()},
            None if camera is None else TrajectoryErrors.from_dict(camera),
            {k: WorldStatistics.from_dict(v) for k, v in values["world"].items()},
            {k: HandStatistics.from_dict(v) for k, v in values["strata"].items()},
            nan if fov is None else float(fov),
        )


@dataclass(frozen=True, eq=False)
class ClipScorer:
    """Scores predictions of one clip; what is the same for all of them is made once.

    Args:
        clip: with its truth.
        hand_model: turns the prediction's states into joints where they speak its shape space;
            trivial rows do without, so that they are the same beside any prediction.

    """

    clip: Clip
    hand_model: HandModel | None = None
    _once: dict[str, Any] = field(default_factory=dict[str, Any], repr=False)

    def score(self, predicted: Episode, row: str = "prediction") -> Score:
        """Score one prediction.

        Raises:
            ValueError: another number of frames, or numbers that cannot be scored; names the clip.

        """
        clip, truth = self.clip, self.clip.truth
        if predicted.num_frames != truth.num_frames:
            raise ValueError(
                f"{clip.key}: expected a prediction of {truth.num_frames} frames, as the truth "
                f"has, got {predicted.num_frames}"
            )
        try:
            camera = None
            if row not in NO_CAMERA:
                camera = trajectory_errors(
                    predicted.T_world_from_camera, truth.T_world_from_camera, truth.fps
                )
            fov_true = K_to_fov_vh(clip.K, clip.image_size_hw)
            fov_error = np.degrees(np.abs(predicted.fov_vh_rad[:, 1] - fov_true[..., 1])).mean()
            by_reading, strata, world = {}, {}, {}
            if clip.hands:
                joints = self._hands(predicted, self.hand_model if row == "prediction" else None)
                if row not in NO_HANDS:
                    by_reading = self._by_reading(predicted, joints)
                    strata = self._strata(joints)
                if camera is not None:
                    world = self._world(predicted, joints)
        except ValueError as error:
            raise ValueError(f"{clip.key}, {row}: {error}") from None
        return Score(by_reading, camera, world, strata, float(fov_error))

    def seen(self) -> NDArray[np.bool_]:
        """Which true hands are on screen, (T, 2); none where the truth does not know hands."""
        if not self.clip.hands:
            return np.zeros((self.clip.truth.num_frames, 2), bool)
        return present_hands(self._truth, self.clip.K, self.clip.image_size_hw)

    # ------------------------------------------------------------------ parts

    def _hands(self, predicted: Episode, given: HandModel | None) -> Hands:
        return _hands_of(predicted, model_for(predicted, self.clip, given))

    @property
    def _truth(self) -> Hands:
        if "truth" not in self._once:
            self._once["truth"] = _hands_of(self.clip.truth, self.clip.hand_model)
            self._once["canonical"] = canonical_joints(self.clip.hand_model)
        return self._once["truth"]

    def _by_reading(self, predicted: Episode, joints: Hands) -> dict[str, HandStatistics]:
        truth, clip = self._truth, self.clip
        common = (clip.K, clip.image_size_hw, self._once["canonical"])
        known = self._known(predicted, joints)
        return {
            "published": hand_statistics(joints, truth, *common),
            "predicted": hand_statistics(
                joints, truth, *common, predicted_K=_intrinsics(predicted, clip.image_size_hw)
            ),
            "known": hand_statistics(known, truth, *common),
        }

    def _known(self, predicted: Episode, joints: Hands) -> Hands:
        """The hands under the true focal length."""
        fov_true = np.asarray(K_to_fov_vh(self.clip.K, self.clip.image_size_hw))
        state, fov = predicted.hand_state.astype(np.float64), predicted.fov_vh_rad.astype(float)
        place = unpack(correct_translation(state, fov, fov_true)).translation
        shifted = joints.joints + (place - joints.translation)[:, :, None]
        return Hands(shifted, joints.orientation, place, joints.present)

    def _strata(self, joints: Hands) -> dict[str, HandStatistics]:
        truth, clip = self._truth, self.clip
        if "strata" not in self._once:
            self._once["strata"] = strata_of(clip)
        return {
            name: hand_statistics(
                joints, truth, clip.K, clip.image_size_hw, self._once["canonical"], only=mask
            )
            for name, mask in self._once["strata"].items()
        }

    def _world(self, predicted: Episode, joints: Hands) -> dict[str, WorldStatistics]:
        truth = self.clip.truth
        true = WorldHands(truth.T_world_from_camera, self._truth.joints, self._truth.present)
        known = self._known(predicted, joints)
        plain, moved = (
            WorldHands(predicted.T_world_from_camera, h.joints, h.present) for h in (joints, known)
        )
        sides = dict(zip(ALIGNMENTS, (plain, plain, moved), strict=True))
        return {
            name: world_hand_statistics(side, true, truth.fps, with_scale=name == "Sim(3)")
            for name, side in sides.items()
        }


def model_for(predicted: Episode, clip: Clip, given: HandModel | None = None) -> HandModel:
    """Return the hand that a prediction's joints are made with.

    The truth's own where the prediction says that it was made with that one; else the given one, or
    the truth's own, where the prediction's shape numbers mean something to it; else the template,
    with its mean shape.
    """
    own = clip.hand_model
    if (predicted.meta.get("hand_model"), _shape_space(predicted)) == (own.name, own.shape_space):
        return own
    for model in (given, own):
        if model is not None and model.shape_space == _shape_space(predicted):
            return model
    return HandModel.template()


def _shape_space(episode: Episode) -> ShapeSpace:
    return episode.meta.get("shape_space", "mint")


def _hands_of(episode: Episode, model: HandModel) -> Hands:
    state = episode.hand_state.astype(np.float64)
    return Hands.from_state(state, episode.presence, model, _shape_space(episode))


def _intrinsics(predicted: Episode, image_size_hw: tuple[int, int]) -> NDArray[np.float64]:
    """Predicted K (T, 3, 3) in pixels of the protocol's image."""
    scale_v, scale_u = (p / e for p, e in zip(image_size_hw, predicted.image_size_hw, strict=True))
    return np.diag([scale_u, scale_v, 1.0]) @ predicted.K
