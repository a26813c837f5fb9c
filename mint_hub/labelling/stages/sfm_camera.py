"""Camera by structure from motion: one focal for a video, then a path for each of its clips.

`SfmIntrinsics` maps a few windows spread over the video with the focal free and pools what they
say; `SfmCamera` maps keyframes of a clip with the focal frozen, finds the frames between from the
map's points, and keeps what the covisibility gate believes. Both run `sfm_worker` in an
environment of its own; hands and forearms are masked where the detector saw them.
"""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mint_hub.geometry.camera import fov_vh_to_K
from mint_hub.labelling.frames import clip_frames, clip_pictures
from mint_hub.labelling.readiness import Lack, python_lacks
from mint_hub.labelling.records import CameraPath, Clip, Intrinsics, Lost, Video
from mint_hub.labelling.stage import Outcome, Resources, report_of, reported, require
from mint_hub.labelling.stages import sfm_gate as gate
from mint_hub.labelling.stages.sfm_calls import (
    ENVIRONMENT,
    SfmSettings,
    SfmWorker,
    gray_images,
    hands_seen,
)
from mint_hub.labelling.stages.sfm_points import MapPoints, points_path
from mint_hub.labelling.worker import Arrays

ENOUGH_IMAGES: Final = 20
"""Images that are enough for a focal even where a window holds more."""

MIN_LINKED: Final = 0.8
"""Share of a model's links that the gate has to believe, for its focal to count."""


@dataclass(frozen=True)
class SfmIntrinsicsSettings(SfmSettings):
    """Settings of `SfmIntrinsics`.

    Attributes:
        windows: how many are mapped, spread over the video.
        window_s: length of each; windows of two seconds fail half the time.
        images: keyframes of each.
        start_fov_deg: where the focal starts, along the longer side; the next one is tried where
            no map came of one.

    """

    windows: int = 3
    window_s: float = 15.0
    images: int = 75
    start_fov_deg: tuple[float, ...] = (80.0, 60.0, 105.0)


@dataclass(frozen=True)
class SfmCameraSettings(SfmSettings):
    """Settings of `SfmCamera`.

    Attributes:
        keyframe_every: frames from one keyframe to the next; halved where that maps too little,
            and lower in a short clip, which needs images.
        min_images: keyframes a short clip should have.
        min_shared: map points two keyframes in a row must share, else the clip is split there.
        enough: share of the frames that the first try has to keep, else a denser one is made.
        min_clip_s: shorter pieces are let go.

    """

    keyframe_every: int = 6
    min_images: int = 30
    min_shared: int = gate.MIN_SHARED
    enough: float = 0.9
    min_clip_s: float = 0.8


class SfmIntrinsics:
    """One pinhole for the video: the focal that structure from motion agrees on."""

    stage: str = "intrinsics"
    backend: str = "sfm"
    version: str = "1"
    needs: tuple[str, ...] = ()
    gives: tuple[str, ...] = ("intrinsics",)
    resources: Resources = Resources(cpus=2.0, memory_gib=2.0)

    def __init__(self, settings: SfmIntrinsicsSettings | None = None) -> None:
        self._settings = settings or SfmIntrinsicsSettings()
        self._worker = SfmWorker(self._settings)
        self.resources = replace(self.resources, cpus=float(self._settings.threads))

    @property
    def settings(self) -> SfmIntrinsicsSettings:
        """See `SfmIntrinsicsSettings`."""
        return self._settings

    def lacks(self) -> tuple[Lack, ...]:
        """Return what is missing for it to run."""
        return python_lacks(self._settings.python, ENVIRONMENT)

    def close(self) -> None:
        """End the worker."""
        self._worker.close()

    def run_video(self, video: Video) -> Video:
        """Give every clip the same intrinsics; lose them all, with the reason, where none came."""
        if not video.clips:
            return video
        settings = self.settings
        found: list[dict[str, Any]] = []
        reasons: Counter[str] = Counter()
        for clip, start, stop in spread(video.clips, settings.windows, settings.window_s):
            models, why = self._window(clip, start, stop)
            found += models
            if not models:
                reasons[why] += 1
        if not found:
            why = reasons.most_common(1)[0][0]
            lost = tuple(clip.lost(self.stage, why) for clip in video.clips)
            return replace(video, clips=(), lost=(*video.lost, *lost))
        relative = [model["relative_focal"] for model in found]
        pooled = gate.pool_focals(relative, [weight(model) for model in found])
        height, width = video.clips[0].image_size_hw
        focal = pooled.focal * max(height, width)
        fov = (2 * np.arctan(height / 2 / focal), 2 * np.arctan(width / 2 / focal))
        given = Intrinsics((float(fov[0]), float(fov[1])), self.backend, pooled.confidence)
        numbers = {
            "focal_px": focal,
            "spread": pooled.spread,
            "focals_px": [f * max(height, width) for f in relative],
            "agreeing": pooled.agreeing,
            "failed": dict(reasons),
        }
        report = report_of(self, **numbers)
        clips = tuple(replace(clip, intrinsics=given) for clip in video.clips)
        return replace(video, clips=clips, reports=(*video.reports, report))

    def _window(self, clip: Clip, start: int, stop: int) -> tuple[list[dict[str, Any]], str]:
        """Map frames start .. stop - 1; the models to be trusted, or why there are none."""
        step = -((start - stop) // self.settings.images)
        frames = np.arange(start, stop, step)
        images, shrunk = gray_images(
            clip_pictures(clip, frames.tolist()), self.settings.max_side_px
        )
        arrays: Arrays = {"images": images, "frames": frames, **hands_seen(clip, shrunk)}
        why = gate.UNSOLVED
        for fov_deg in self.settings.start_fov_deg:
            _, values = self._worker.call(
                "intrinsics", arrays, start_fov_rad=float(np.radians(fov_deg))
            )
            models: list[dict[str, Any]] = values["models"]
            longer = max(images.shape[1:])
            if good := [model for model in models if trusted(model, len(frames))]:
                return [
                    {**model, "relative_focal": model["focal_px"][0] / longer} for model in good
                ], ""
            why = gate.reason(values["evidence"], models)
            if why not in (gate.UNSOLVED, gate.UNLINKED):
                break
        return [], why


class SfmCamera:
    """A path for a clip from structure from motion with known intrinsics."""

    stage: str = "camera"
    backend: str = "sfm"
    version: str = "1"
    needs: tuple[str, ...] = ("intrinsics",)
    gives: tuple[str, ...] = ("camera",)
    resources: Resources = Resources(cpus=2.0, memory_gib=3.0)

    def __init__(self, settings: SfmCameraSettings | None = None) -> None:
        self._settings = settings or SfmCameraSettings()
        self._worker = SfmWorker(self._settings)
        self.resources = replace(self.resources, cpus=float(self._settings.threads))

    @property
    def settings(self) -> SfmCameraSettings:
        """See `SfmCameraSettings`."""
        return self._settings

    def lacks(self) -> tuple[Lack, ...]:
        """Return what is missing for it to run."""
        return python_lacks(self._settings.python, ENVIRONMENT)

    def close(self) -> None:
        """End the worker."""
        self._worker.close()

    def run_clip(self, clip: Clip, video: Video) -> Outcome:
        """Solve the clip; it comes back whole, in pieces, or not at all with the reason."""
        require(self, clip)
        settings = self.settings
        images, shrunk = gray_images(clip_frames(clip), settings.max_side_px)
        focal = _focal_px(clip, images.shape[1:])
        arrays: Arrays = {"images": images, **hands_seen(clip, shrunk)}
        step = max(1, min(settings.keyframe_every, clip.num_frames // settings.min_images))
        best = _Try([], {}, step)
        while True:
            frames = np.unique(np.append(np.arange(0, clip.num_frames, step), clip.num_frames - 1))
            out, values = self._worker.call("camera", {**arrays, "frames": frames}, focal_px=focal)
            tried = _Try(_pieces(out, values["models"], self.settings, clip.fps), values, step)
            if not best.values or tried.kept > best.kept:
                best = tried
            hopeless = gate.reason(values["evidence"], ()) in (gate.STILL, gate.FLAT)
            if best.kept >= settings.enough * clip.num_frames or step <= 2 or hopeless:
                return self._outcome(clip, best, shrunk)
            step = step // 2

    def _outcome(self, clip: Clip, tried: "_Try", shrunk: float) -> Outcome:
        why = gate.reason(tried.values["evidence"], tried.values["models"])
        kept = [(piece.start, piece.stop) for piece in tried.pieces]
        lost = [
            _lost(clip, start, stop, why if not kept else gate.UNLINKED)
            for start, stop in gate.gaps(kept, clip.num_frames)
        ]
        clips: list[Clip] = []
        for i, piece in enumerate(tried.pieces):
            whole = (piece.start, piece.stop) == (0, clip.num_frames)
            key = clip.key if whole else f"{clip.key}-c{i}"
            part = clip.window(piece.start, piece.stop, key)
            path = points_path(part)
            piece.points(part, shrunk).save(path)
            numbers = {
                **piece.numbers(),
                "keyframe_every": tried.step,
                "kept": tried.kept / clip.num_frames,
                "map_points": str(path),
                **{name: round(float(x), 3) for name, x in tried.values["evidence"].items()},
            }
            report = report_of(self, **numbers)
            clips.append(reported(part, report, camera=piece.camera(shrunk)))
        return Outcome(tuple(clips), tuple(lost))


@dataclass(frozen=True, eq=False)
class _Piece:
    """Frames start .. stop - 1 of a clip, held together by one model."""

    start: int
    stop: int
    first: int
    model: Mapping[str, Any]
    arrays: Arrays
    covisible: NDArray[np.float32]

    def camera(self, shrunk: float) -> CameraPath:
        frames = slice(self.start - self.first, self.stop - self.first)
        T, solved = self.arrays["T"][frames], self.arrays["solved"][frames]
        return CameraPath(
            T_camera_from_world=T @ np.linalg.inv(T[0]),
            solved=solved,
            covisible=self.covisible[frames],
            residual_px=float(self.model["residual_px"]) / shrunk,
            source="sfm",
        )

    def points(self, part: Clip, shrunk: float) -> MapPoints:
        """The map as this piece sees it, in the world of its camera path."""
        frames = slice(self.start - self.first, self.stop - self.first)
        T = self.arrays["T"][frames]
        frame = self.arrays["obs_frame"] - self.start
        seen = (frame >= 0) & (frame < len(T))
        used, number = np.unique(self.arrays["obs_point"][seen], return_inverse=True)
        points = self.arrays["points"][used] @ T[0, :3, :3].T + T[0, :3, 3]
        return MapPoints(
            timestamps_s=part.source_timestamps_s,
            T_camera_from_world=T @ np.linalg.inv(T[0]),
            image_size_hw=part.image_size_hw,
            points=points,
            obs_frame=frame[seen],
            obs_point=number.astype(np.int64),
            obs_uv=self.arrays["obs_uv"][seen] / shrunk,
        )

    def numbers(self) -> dict[str, Any]:
        """What was measured, plain JSON."""
        frames = slice(self.start - self.first, self.stop - self.first)
        keyframe = self.arrays["keyframe"]
        inside = (keyframe >= self.start) & (keyframe < self.stop)
        shared = self.arrays["shared"][inside[:-1] & inside[1:]]
        residual = self.arrays["residual"][frames]
        between = residual[np.isfinite(residual)]
        return {
            "keyframes": int(inside.sum()),
            "points": int(self.model["points"]),
            "map_residual_px": float(self.model["residual_px"]),
            "between_residual_px": float(between.mean()) if len(between) else None,
            "solved": float(self.arrays["solved"][frames].mean()),
            "shared_min": int(shared.min()) if len(shared) else 0,
            "shared_median": float(np.median(shared)) if len(shared) else 0.0,
            "angle_deg": float(self.model["angle_deg"]),
        }


@dataclass(frozen=True, eq=False)
class _Try:
    """One mapping of a clip."""

    pieces: list[_Piece]
    values: dict[str, Any] = field(default_factory=dict[str, Any])
    step: int = 1

    @property
    def kept(self) -> int:
        """Frames in pieces."""
        return sum(piece.stop - piece.start for piece in self.pieces)


def _pieces(
    out: Arrays, models: Sequence[Mapping[str, Any]], settings: SfmCameraSettings, fps: float
) -> list[_Piece]:
    """Cut every model where the gate fails and keep stretches that do not overlap."""
    found: list[_Piece] = []
    for i, model in enumerate(models):
        if gate.moved_too_little(model):
            continue
        prefix = f"{i}/"
        arrays = {k.removeprefix(prefix): v for k, v in out.items() if k.startswith(prefix)}
        covisible = gate.covisibility(arrays["keyframe"], arrays["shared"])
        first = int(arrays["keyframe"][0])
        for start, stop in gate.segments(
            covisible,
            arrays["solved"],
            min_shared=settings.min_shared,
            min_frames=max(round(settings.min_clip_s * fps), 2),
        ):
            found.append(_Piece(start + first, stop + first, first, model, arrays, covisible))
    return [found[i] for i in gate.disjoint([(p.start, p.stop) for p in found])]


def spread(clips: Sequence[Clip], count: int, window_s: float) -> list[tuple[Clip, int, int]]:
    """Up to ``count`` windows (clip, start, stop) of at most ``window_s``, spread over the clips.

    A long clip gives several; as many windows as its length holds at least half of.
    """
    every: list[tuple[Clip, int, int]] = []
    for clip in clips:
        length = max(round(window_s * clip.fps), 2)
        parts = max(1, round(clip.num_frames / length))
        edges = np.linspace(0, clip.num_frames, parts + 1).round().astype(int).tolist()
        every += [(clip, a, b) for a, b in pairwise(edges)]
    picks = np.unique(np.linspace(0, len(every) - 1, min(count, len(every))).round().astype(int))
    return [every[i] for i in picks]


def trusted(model: Mapping[str, Any], num_images: int) -> bool:
    """Whether a model's focal may be asked for: enough images, held together, seen from aside."""
    linked = [n >= gate.MIN_SHARED for n in model["shared"]]
    enough = model["images"] >= min(0.7 * num_images, ENOUGH_IMAGES)
    held = sum(linked) >= MIN_LINKED * max(len(linked), 1)
    return enough and held and not gate.moved_too_little(model)


def weight(model: Mapping[str, Any]) -> float:
    """What a window's focal counts: images, points, and the angle under which they were seen."""
    return float(np.sqrt(model["points"] * model["images"]) * min(model["angle_deg"], 5.0))


def _lost(clip: Clip, start: int, stop: int, why: str) -> Lost:
    times = clip.source_timestamps_s
    end = clip.stop_s if stop >= clip.num_frames else float(times[stop])
    return Lost(float(times[start]), end, "camera", why)


def _focal_px(clip: Clip, shape_hw: tuple[int, ...]) -> list[float]:
    """(fx, fy) for images of ``shape_hw``."""
    assert clip.intrinsics is not None
    size = (int(shape_hw[0]), int(shape_hw[1]))
    K = fov_vh_to_K(np.array(clip.intrinsics.fov_vh_rad, dtype=np.float64), size)
    return [float(K[0, 0]), float(K[1, 1])]
