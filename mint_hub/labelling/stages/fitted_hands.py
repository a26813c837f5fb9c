"""Stage "hands", backend "ik": from detections to both hands' states, frame by frame.

Detections are joined to one left and one right hand (`hand_tracks`), all hands of the clip are
fitted at once, each by itself, and then once more with a mild pull towards what the frames around
say, which takes out single frames that fell into a wrong pose. Wrist turn and depth of one camera
are weak: of the order of 25 degrees and 2 to 14 cm; the score says how weak.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from time import process_time
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mint_hub.conventions import RIGHT, SIDES
from mint_hub.geometry import hand_state
from mint_hub.geometry.camera import fov_vh_to_K
from mint_hub.geometry.hand_model import HandModel
from mint_hub.geometry.rotations import geodesic_angle, nearest_rotation
from mint_hub.labelling.records import Clip, Detections, Hands, Video
from mint_hub.labelling.stage import LOCAL, Outcome, Resources, report_of, reported, require
from mint_hub.labelling.stages.hand_evidence import (
    Evidence,
    NoiseSettings,
    Pose,
    Seen,
    evidence_of,
    hand_states,
    rest_of,
)
from mint_hub.labelling.stages.hand_fitting import Fit, FittingSettings, fit_hands
from mint_hub.labelling.stages.hand_tracks import HandTracks, TrackSettings, hand_tracks

Floats = NDArray[np.float64]
Bool = NDArray[np.bool_]

LEAST_LANDMARKS: Final = 8
"""A hand with fewer is not fitted."""


@dataclass(frozen=True)
class NeighbourSettings:
    """The pull of the frames around.

    Attributes:
        frames: how many on each side are asked; 0 asks none.
        turn_deg, log_depth, bend_deg: standard deviations of the wrist's turn, of the logarithm of
            its depth, and of joint angles from their median.
        astray_deg: a wrist this far from it begins again there.

    """

    frames: int = 3
    turn_deg: float = 8.0
    log_depth: float = 0.02
    bend_deg: float = 10.0
    astray_deg: float = 35.0


@dataclass(frozen=True)
class FittedHandsSettings:
    """Settings of `FittedHands`.

    Attributes:
        tracks: how detections become hands.
        noise: what is believed of landmarks.
        fitting: how hands are fitted.
        neighbours: how much the frames around say.
        depth_m: a wrist nearer or farther than these is an outlier.
        residual: mean distance from the landmarks, as a share of the hand's size in the image,
            beyond which a hand is an outlier.
        mano_dir: folder of the user's MANO files, to fit that hand instead of the template.
        shape_params: ten shape numbers of the person's hand, if known; depth follows its size.

    """

    tracks: TrackSettings = field(default_factory=TrackSettings)
    noise: NoiseSettings = field(default_factory=NoiseSettings)
    fitting: FittingSettings = field(default_factory=FittingSettings)
    neighbours: NeighbourSettings = field(default_factory=NeighbourSettings)
    depth_m: tuple[float, float] = (0.08, 1.3)
    residual: float = 0.10
    mano_dir: str = field(default="", metadata=LOCAL)
    shape_params: tuple[float, ...] = (0.0,) * hand_state.NUM_SHAPE_PARAMS


class FittedHands:
    """Stage "hands", backend "ik"."""

    stage, backend, version = "hands", "ik", "1"
    needs, gives = ("detections", "intrinsics"), ("hands",)
    resources = Resources(cpus=1.0, memory_gib=1.0)
    Settings = FittedHandsSettings

    def __init__(self, settings: FittedHandsSettings | None = None) -> None:
        """Raise ValueError for a shape that is not ten numbers, FileNotFoundError without MANO."""
        self.settings = settings or FittedHandsSettings()
        shape = self.settings.shape_params
        if len(shape) != hand_state.NUM_SHAPE_PARAMS:
            raise ValueError(
                f"shape_params: expected {hand_state.NUM_SHAPE_PARAMS} numbers, got {len(shape)}"
            )
        mano = self.settings.mano_dir
        self._model = HandModel.from_mano(mano) if mano else HandModel.template()

    def close(self) -> None:
        """Nothing to end."""

    def run_clip(self, clip: Clip, video: Video) -> Outcome:
        """Fit the hands of a clip; one in which none was detected goes on without hands."""
        require(self, clip)
        assert clip.detections is not None
        assert clip.intrinsics is not None
        began = process_time()
        found = clip.detections
        tracks = hand_tracks(found, clip.num_frames, self.settings.tracks)
        K = np.asarray(fov_vh_to_K(np.array(clip.intrinsics.fov_vh_rad), clip.image_size_hw))
        frames, sides = np.nonzero(tracks.index >= 0)
        fitted = self._fitted(found, tracks, frames, sides, K, clip.image_size_hw)
        hands = self._hands(fitted, frames, sides, clip.num_frames)
        report = report_of(
            self,
            coverage=[float(x) for x in hands.presence.mean(0)],
            median_residual_px=_median(hands.residual_px),
            median_score=_median(hands.score[hands.presence]),
            ms_a_hand=(process_time() - began) * 1e3 / max(1, len(frames)),
            tracks=[sum(t.side == side for t in tracks.tracks) for side in range(len(SIDES))],
            side_flips_repaired=tracks.flips,
            detections_dropped=tracks.dropped,
            depths_reversed=int((fitted.reversed & fitted.kept).sum()),
            outliers_dropped=int((~fitted.kept).sum()),
        )
        return Outcome((reported(clip, report, hands=hands),))

    def _fitted(
        self,
        found: Detections,
        tracks: HandTracks,
        frames: NDArray[np.int64],
        sides: NDArray[np.int64],
        K: Floats,
        image_size_hw: tuple[int, int],
    ) -> _Fitted:
        """Fit the detections at (frames, sides) of the tracks."""
        settings = self.settings
        chosen = tracks.index[frames, sides]
        seen = Seen(
            found.landmarks_uv[chosen].astype(np.float64),
            found.landmarks_m[chosen].astype(np.float64),
            sides,
        )
        result = _Fitted.none(len(frames))
        enough = np.isfinite(seen.uv).all(-1).sum(1) >= LEAST_LANDMARKS
        if not enough.any():
            return result
        seen = Seen(seen.uv[enough], seen.metres[enough], sides[enough])
        shape = np.array(settings.shape_params)
        evidence = evidence_of(seen, K, image_size_hw, rest_of(self._model, shape), settings.noise)
        named_right = found.right_score[chosen][enough] > 0.5
        doubted = named_right != (seen.hand == RIGHT)
        evidence, start, result.reversed[enough] = _first_fit(evidence, doubted, settings.fitting)
        fit = _with_neighbours(
            start, evidence, frames[enough], seen.hand, settings.neighbours, settings.fitting
        )
        focal = float(np.sqrt(K[0, 0] * K[1, 1]))
        share = fit.seen_residual * focal / np.maximum(seen.size_px, 1.0)
        depth = fit.pose.translation[:, 2]
        near, far = settings.depth_m
        result.state[enough] = hand_states(fit.pose, seen.hand, shape)
        result.residual_px[enough] = fit.seen_residual * focal
        result.kept[enough] = (
            np.isfinite(fit.cost) & (share <= settings.residual) & (depth >= near) & (depth <= far)
        )
        result.score[enough] = scores(
            found.score[chosen][enough], evidence.weight, share, fit.direction_residual
        )
        return result

    def _hands(
        self,
        fitted: _Fitted,
        frames: NDArray[np.int64],
        sides: NDArray[np.int64],
        num_frames: int,
    ) -> Hands:
        """Lay fitted hands out over frames."""
        shape = (num_frames, len(SIDES))
        state = np.asarray(hand_state.absent(shape), np.float32)
        presence, score = np.zeros(shape, bool), np.zeros(shape, np.float32)
        residual_px = np.full(shape, np.nan, np.float32)
        kept = fitted.kept
        where = frames[kept], sides[kept]
        state[where] = fitted.state[kept]
        presence[where] = True
        score[where] = fitted.score[kept]
        residual_px[where] = fitted.residual_px[kept]
        return Hands(
            hand_state=state,
            presence=presence,
            score=score,
            filled=np.zeros(shape, bool),
            shape_space=self._model.shape_space,
            hand_model=self._model.name,
            source=self.backend,
            residual_px=residual_px,
        )


@dataclass(frozen=True, eq=False)
class _Fitted:
    """What became of N detections; those not kept have no meaning elsewhere."""

    state: Floats  # (N, 109)
    residual_px: Floats  # (N,)
    score: Floats  # (N,)
    kept: Bool  # (N,)
    reversed: Bool  # (N,) the detector's depth was taken the other way round

    @classmethod
    def none(cls, count: int) -> _Fitted:
        state = np.zeros((count, hand_state.HAND_STATE_SIZE))
        no = np.zeros(count, bool)
        return cls(state, np.full(count, np.nan), np.zeros(count), no, no.copy())


def scores(
    detector: NDArray[np.float32], weight: Floats, share: Floats, direction_rad: Floats
) -> Floats:
    """How far to trust fits, 0 to 1: the detector's score times three shares.

    Args:
        detector: (N,) its score.
        weight: (N, 21) of landmarks; what is outside the image counts less.
        share: (N,) mean distance from the landmarks over the hand's size; 4 % halves the score.
        direction_rad: (N,) mean angle between bones and the detector's own; 30 degrees halve it.

    """
    angle = np.where(np.isfinite(direction_rad), direction_rad, np.pi / 2)
    fit = 1 / (1 + (share / 0.04) ** 2) / (1 + (angle / np.deg2rad(30)) ** 2)
    return np.clip(np.nan_to_num(detector.astype(np.float64)), 0, 1) * weight.mean(1) * fit


def _first_fit(
    evidence: Evidence, doubted: Bool, settings: FittingSettings
) -> tuple[Evidence, Pose, Bool]:
    """Fit each hand by itself; where the detector took it for the other hand, in both depths.

    Seen along the optical axis, a hand and the other hand with its depth reversed look alike: who
    takes the one for the other puts in front what is behind. Of the two the better fit stays.
    """
    fit = fit_hands(evidence, settings)
    turned = np.zeros(len(doubted), bool)
    if not doubted.any():
        return evidence, fit.pose, turned
    reversed_ = evidence[doubted].with_depth_reversed()
    other = fit_hands(reversed_, settings)
    better = other.cost < fit.cost[doubted]
    turned[doubted] = better
    directions = evidence.directions.copy()
    directions[turned] = reversed_.directions[better]
    pose = fit.pose.updated(turned, other.pose[better])
    return replace(evidence, directions=directions), pose, turned


def _with_neighbours(
    pose: Pose,
    evidence: Evidence,
    frames: NDArray[np.int64],
    hand: NDArray[np.int64],
    settings: NeighbourSettings,
    fitting: FittingSettings,
) -> Fit:
    """Fit again, drawn mildly to the median of the frames around."""
    if settings.frames == 0:
        return fit_hands(evidence, fitting, pose)
    near, known = neighbourhood(pose, frames, hand, settings.frames)
    spread = np.array(
        [np.deg2rad(settings.turn_deg), settings.log_depth, np.deg2rad(settings.bend_deg)]
    )
    noise = np.where(known[:, None], spread, np.inf)
    away = np.asarray(geodesic_angle(near.rotation, pose.rotation))
    astray = away > np.deg2rad(settings.astray_deg)
    start = pose.updated(astray, near[astray])
    return fit_hands(replace(evidence, near=near, near_noise=noise), fitting, start)


def neighbourhood(
    found: Pose, frames: NDArray[np.int64], hand: NDArray[np.int64], reach: int
) -> tuple[Pose, Bool]:
    """Median pose of the same hand in the frames around, itself not counted.

    Returns:
        It, with the translation's direction of the hand itself and the median's depth; and (N,)
        whether at least two frames were there to ask (elsewhere it is the hand's own pose).

    """
    place = np.full((int(frames.max()) + 1 + 2 * reach, len(SIDES)), -1)
    place[frames + reach, hand] = np.arange(len(frames))
    offsets = [o for o in range(-reach, reach + 1) if o]
    around = np.stack([place[frames + reach + o, hand] for o in offsets])  # (2 reach, N)
    known = (around >= 0).sum(0) >= 2
    around = np.where(known, around, np.arange(len(frames)))

    def median(values: Floats) -> Floats:
        there = (around >= 0).reshape(*around.shape, *[1] * (values.ndim - 1))
        return np.nanmedian(np.where(there, values[around], np.nan), axis=0)

    rotation = nearest_rotation(median(found.rotation) + 1e-9 * np.eye(3), check=False)
    depth = found.translation[:, 2]
    farther = np.exp(median(np.log(depth))) / depth
    translation = found.translation * farther[:, None]
    return Pose(rotation, translation, median(found.angles)), known


def _median(values: NDArray[Any]) -> float | None:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else None
