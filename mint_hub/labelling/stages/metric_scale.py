"""Metric scale of camera paths: who knows metres, asked in the order of how well they know.

The user's factor, a length that the user knows, a camera that is metric by itself, metric depth,
and last the hands, which are weak. What was used, how sure it is and how wrong it may be are kept
with the clip; a path without any of them keeps its units as metres, with confidence 0.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mint_hub.geometry.camera import fov_vh_to_K, project
from mint_hub.geometry.hand_model import HandModel
from mint_hub.geometry.hand_state import unpack
from mint_hub.geometry.lens_models import Lens
from mint_hub.geometry.lenses import lens_from
from mint_hub.labelling.records import Clip, Scale, ScaleSource, Video
from mint_hub.labelling.stage import Resources, report_of, reported, require
from mint_hub.labelling.stages.scale_evidence import (
    DEPTH_SIGMA,
    HAND_QUANTILE,
    HAND_SIGMA,
    Estimate,
    GivenFactor,
    KnownLength,
    Pixel,
    depth_ratios,
    hand_depth,
    hand_ratios,
    parse_scale,
    scale_from_length,
    scale_from_ratios,
)
from mint_hub.labelling.stages.sfm_points import MapPoints, points_of

Float = NDArray[np.float64]

CONFIDENCE: Final[dict[ScaleSource, float]] = {
    "given": 1.0,
    "length": 0.95,
    "camera": 0.8,
    "depth": 0.7,
    "hands": 0.3,
    "none": 0.0,
}
"""How far each source is to be trusted at its best."""

UNKNOWN_SIGMA: Final = 1.0
"""Log standard deviation where nobody knows: a unit is the scene's median depth, some 0.3 - 3 m."""

NEAR_S: Final = 0.4
"""Map points that keyframes within this of a frame see, speak for it."""


@dataclass(frozen=True)
class MetricScaleSettings:
    """Settings of `MetricScale`.

    Attributes:
        known: what the user knows, each as `parse_scale` takes it.
        min_hand_frames: frames with a hand among map points that the hands' estimate needs.

    """

    known: tuple[str, ...] = ()
    min_hand_frames: int = 5


class MetricScale:
    """Makes metres of every clip's camera path and says on whose word."""

    stage: str = "scale"
    backend: str = "evidence"
    version: str = "1"
    needs: tuple[str, ...] = ("camera", "intrinsics")
    gives: tuple[str, ...] = ("scale", "camera")
    resources: Resources = Resources()

    def __init__(self, settings: MetricScaleSettings | None = None) -> None:
        """Raise ValueError for anything known that cannot be read."""
        self._settings = settings or MetricScaleSettings()
        self._known = [parse_scale(text) for text in self._settings.known]

    @property
    def settings(self) -> MetricScaleSettings:
        """See `MetricScaleSettings`."""
        return self._settings

    def close(self) -> None:
        """Nothing to end."""

    def run_video(self, video: Video) -> Video:
        """Scale each clip's path, in its own way: clips that were not joined share no units."""
        clips = tuple(self._scaled(clip, video) for clip in video.clips)
        return replace(video, clips=clips)

    def _scaled(self, clip: Clip, video: Video) -> Clip:
        require(self, clip)
        assert clip.camera is not None
        scale, numbers = self._scale_of(clip, video)
        T = clip.camera.T_camera_from_world.copy()
        T[:, :3, 3] *= scale.metres_per_unit
        camera = replace(clip.camera, T_camera_from_world=T, metric=True)
        numbers = {"source": scale.source, "metres_per_unit": scale.metres_per_unit, **numbers}
        report = report_of(self, **numbers)
        return reported(clip, report, camera=camera, scale=scale)

    def _scale_of(self, clip: Clip, video: Video) -> tuple[Scale, dict[str, Any]]:
        assert clip.camera is not None
        for known in self._known:
            if isinstance(known, GivenFactor):
                return Scale(known.metres_per_unit, "given", CONFIDENCE["given"], 0.0), {}
        maps = points_of(clip)
        problems: list[str] = []
        lengths = self._lengths(clip, video, maps, problems)
        numbers: dict[str, Any] = {"problems": problems} if problems else {}
        if lengths:
            return _scale("length", pooled(lengths)), numbers
        if clip.camera.metric:
            return Scale(1.0, "camera", CONFIDENCE["camera"], 0.1), numbers
        by_depth = scale_from_ratios(_depth_evidence(clip, maps), DEPTH_SIGMA)
        by_hands = scale_from_ratios(
            _hand_evidence(clip, maps),
            HAND_SIGMA,
            quantile=HAND_QUANTILE,
            min_frames=self.settings.min_hand_frames,
        )
        if by_hands is not None:
            numbers["hands_metres_per_unit"] = by_hands.metres_per_unit
        if by_depth is not None:
            return _scale("depth", by_depth), numbers
        if by_hands is not None:
            return _scale("hands", by_hands), numbers
        return Scale(1.0, "none", CONFIDENCE["none"], UNKNOWN_SIGMA), numbers

    def _lengths(
        self, clip: Clip, video: Video, maps: Sequence[MapPoints], problems: list[str]
    ) -> list[Estimate]:
        """Estimates of the known lengths that lie in this clip; what fails is told, not hidden."""
        found: list[Estimate] = []
        for known in self._known:
            if isinstance(known, GivenFactor) or not clip.start_s <= known.time_s < clip.stop_s:
                continue
            try:
                found.append(_from_length(known, clip, video, maps))
            except ValueError as error:
                problems.append(f"length at {known.time_s:g} s: {error}")
        return found


def pooled(estimates: Sequence[Estimate]) -> Estimate:
    """Mean of logarithms, weighted by their precision."""
    logs = np.log([e.metres_per_unit for e in estimates])
    precision = np.array([1 / max(e.log_sigma, 1e-3) ** 2 for e in estimates])
    mean = float(np.average(logs, weights=precision))
    sigma = 1 / math.sqrt(float(precision.sum()))
    between = float(np.std(logs)) if len(logs) > 1 else 0.0
    return Estimate(math.exp(mean), math.hypot(sigma, between))


def _scale(source: ScaleSource, estimate: Estimate) -> Scale:
    """An estimate that is wider than 10 % loses confidence in proportion."""
    confidence = CONFIDENCE[source]
    if source != "hands":
        confidence *= min(1.0, 0.1 / max(estimate.log_sigma, 1e-6))
    return Scale(estimate.metres_per_unit, source, confidence, estimate.log_sigma)


def _seen(clip: Clip, maps: Sequence[MapPoints], time_s: float) -> tuple[Float, Float] | None:
    """Pixels (N, 2) and depths (N,), in units of the clip's path, at a source time."""
    K = _K(clip)
    for points in maps:
        frame = points.frame_at(time_s, 0.5 / clip.fps + 1e-6)
        units = points.units_of(clip) if frame is not None else None
        if frame is None or units is None:
            continue
        uv, depth = points.seen_near(frame, round(NEAR_S * clip.fps), K)
        height, width = clip.image_size_hw
        inside = ((uv >= 0) & (uv < (width, height))).all(axis=1)
        return uv[inside], depth[inside] * units
    return None


def _K(clip: Clip) -> Float:  # noqa: N802
    assert clip.intrinsics is not None
    return fov_vh_to_K(np.array(clip.intrinsics.fov_vh_rad, np.float64), clip.image_size_hw)


def _from_length(
    known: KnownLength, clip: Clip, video: Video, maps: Sequence[MapPoints]
) -> Estimate:
    at = int(np.abs(clip.source_timestamps_s - known.time_s).argmin())
    seen = _seen(clip, maps, float(clip.source_timestamps_s[at]))
    if seen is None:
        raise ValueError("the clip has no map points there; a camera backend that keeps them does")
    ends = (_clip_pixel(known.first_uv, clip, video), _clip_pixel(known.second_uv, clip, video))
    return scale_from_length(known.metres, ends, *seen, _K(clip), clip.image_size_hw)


def _clip_pixel(uv: Pixel, clip: Clip, video: Video) -> Pixel:
    """Where a pixel of the source video is in the clip's frames, which may be undistorted."""
    (height, width), (rows, columns) = video.image_size_hw, clip.image_size_hw
    if not (0 <= uv[0] <= width and 0 <= uv[1] <= height):
        raise ValueError(
            f"expected a pixel of the source video, {width} x {height}, got ({uv[0]:g}, {uv[1]:g})"
        )
    if clip.intrinsics is None or clip.intrinsics.lens is None:
        return uv[0] * columns / width, uv[1] * rows / height
    lens = lens_from(Lens.from_dict(clip.intrinsics.lens), video.image_size_hw)
    ray = lens.unproject(np.array(uv) - 0.5)  # lenses count from pixel centres
    if not np.isfinite(ray).all() or ray[2] <= 0:
        raise ValueError(f"expected a pixel that the lens sees, got ({uv[0]:g}, {uv[1]:g})")
    u, v = project(ray, _K(clip))[0]
    return float(u), float(v)


def _depth_evidence(clip: Clip, maps: Sequence[MapPoints]) -> list[Float]:
    """Metric over map depth, per frame that a depth backend saw.

    A depth backend names a file as ``numbers["depth_maps"]`` of its report: an ``.npz`` with
    ``timestamps_s`` (K,), source times, and ``depth_m`` (K, h, w), metres, of which values that
    are not finite or not positive are invalid.
    """
    ratios: list[Float] = []
    for report in clip.reports:
        path = report.numbers.get("depth_maps") if report.stage == "depth" else None
        if path is None:
            continue
        with np.load(Path(path), allow_pickle=False) as stored:
            times, depths = stored["timestamps_s"], stored["depth_m"]
        for time_s, depth_m in zip(times, depths, strict=True):
            seen = _seen(clip, maps, float(time_s))
            if seen is not None and clip.start_s <= time_s < clip.stop_s:
                ratios.append(depth_ratios(*seen, depth_m, clip.image_size_hw))
    return ratios


def _hand_evidence(clip: Clip, maps: Sequence[MapPoints]) -> list[Float]:
    """Hand depth over map depth around it, per hand and frame."""
    ratios: list[Float] = []
    for frame, uv, depth_m in _hands(clip):
        seen = _seen(clip, maps, float(clip.source_timestamps_s[frame]))
        if seen is not None:
            ratios.append(hand_ratios(uv, depth_m, *seen))
    return ratios


def _hands(clip: Clip, every: int = 5) -> list[tuple[int, Float, float]]:
    """(frame, landmarks (21, 2), depth in metres) of hands that are fitted, else just detected."""
    found: list[tuple[int, Float, float]] = []
    K = _K(clip)
    if clip.hands is not None:
        observed = clip.hands.presence & ~clip.hands.filled
        state = unpack(clip.hands.hand_state)
        plain = replace(state, shape_params=np.zeros_like(state.shape_params))
        keypoints = HandModel.template().keypoints(plain.pack())
        for frame, side in np.argwhere(observed[::every]) * (every, 1):
            points = np.asarray(keypoints[frame, side], np.float64)
            uv, depth = project(points, K)
            if np.isfinite(uv).all():
                found.append((int(frame), uv, float(np.median(depth))))
    elif clip.detections is not None:
        seen = clip.detections
        for i in np.flatnonzero(seen.frame % every == 0):
            uv = seen.landmarks_uv[i].astype(np.float64)
            depth_m = hand_depth(uv, seen.landmarks_m[i].astype(np.float64), K)
            if depth_m is not None:
                found.append((int(seen.frame[i]), uv, depth_m))
    return found
