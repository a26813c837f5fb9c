"""What flows through the cascade: a video, its clips, and what each stage found out.

Letters in shapes: T frames of a clip, 2 hands (left, right), N detections, 21 landmarks in OpenPose
order. Frames, units and sides are those of ``mint_hub.conventions``. Every record is frozen: a
stage returns a changed copy.

>>> lost = Lost(2.0, 3.5, stage="filter", reason="no hand for more than 1 s")
>>> lost.seconds
1.5
"""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np
from numpy.typing import NDArray

from mint_hub.loaders.fields import TextSegment

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]

ScaleSource = Literal["given", "length", "depth", "hands", "camera", "none"]
"""Who knew metres: the user's factor, a known length, a depth backend, the hands, a camera backend
that is metric by itself, or nobody."""


@dataclass(frozen=True)
class StageReport:
    """What a stage did to a record.

    Attributes:
        stage, backend, version: which code it was.
        settings: its settings, plain JSON.
        seconds: wall time.
        numbers: what it measured, plain JSON (focal in pixels, fraction registered, ...).

    """

    stage: str
    backend: str
    version: str
    settings: dict[str, Any] = field(default_factory=dict[str, Any])
    seconds: float = 0.0
    numbers: dict[str, Any] = field(default_factory=dict[str, Any])


@dataclass(frozen=True)
class Lost:
    """A stretch of source time that goes no further, and why.

    Attributes:
        start_s, stop_s: seconds of the source video.
        stage: who let go of it.
        reason: in words that group: the same reason reads the same for every clip.
        failed: an error rather than a judgement.

    """

    start_s: float
    stop_s: float
    stage: str
    reason: str
    failed: bool = False

    @property
    def seconds(self) -> float:
        """How long the stretch is."""
        return self.stop_s - self.start_s


@dataclass(frozen=True, eq=False)
class Detections:
    """Hands seen in single frames, N of them, in order of frame.

    Attributes:
        frame: (N,) int32, frame of the clip.
        box_xyxy: (N, 4) float32, pixels.
        score: (N,) float32, how sure the detector is that this is a hand.
        right_score: (N,) float32, how sure it is that it is a right one; 0 is surely a left one.
        landmarks_uv: (N, 21, 2) float32, pixels; NaN where the detector has none.
        landmarks_m: (N, 21, 3) float32, metres, camera axes up to the turn of the viewing ray,
            about their own centre; NaN where the detector has none.

    """

    frame: NDArray[np.int32]
    box_xyxy: Float32
    score: Float32
    right_score: Float32
    landmarks_uv: Float32
    landmarks_m: Float32


@dataclass(frozen=True, eq=False)
class Intrinsics:
    """One pinhole for the whole video (and the lens that was taken out, if any).

    Attributes:
        fov_vh_rad: (vertical, horizontal) radians of frames of the clip's ``image_size_hw``.
        source: which backend or "given".
        confidence: 0 to 1.
        lens: the lens of the source video, as `Lens.to_dict` gives it; None for a pinhole.

    """

    fov_vh_rad: tuple[float, float]
    source: str
    confidence: float
    lens: dict[str, Any] | None = None


@dataclass(frozen=True, eq=False)
class CameraPath:
    """Camera poses of a clip.

    Attributes:
        T_camera_from_world: (T, 4, 4) float64, metres once ``metric``, else units of its own.
        solved: (T,) bool, frames whose pose was measured rather than interpolated.
        covisible: (T,) float32, points shared with the next frame (the last repeats), the gate's
            evidence.
        residual_px: mean reprojection error.
        source: which backend.
        metric: whether units are metres.

    """

    T_camera_from_world: Float64
    solved: Bool
    covisible: Float32
    residual_px: float
    source: str
    metric: bool = False


@dataclass(frozen=True, eq=False)
class Scale:
    """What makes metres of a camera path's units.

    Attributes:
        metres_per_unit: the factor. The scale stage has applied it: once a clip has a scale, its
            camera path is metric, and this says what became of it.
        source: who knew.
        confidence: 0 to 1.
        log_sigma: standard deviation of the factor's logarithm, as far as the evidence tells.

    """

    metres_per_unit: float
    source: ScaleSource
    confidence: float
    log_sigma: float


@dataclass(frozen=True, eq=False)
class Hands:
    """Both hands of a clip in the camera frame.

    Attributes:
        hand_state: (T, 2, 109) float32; `hand_state.absent` where a hand is not there.
        presence: (T, 2) bool, observed or filled.
        score: (T, 2) float32, 0 to 1, how far to trust the fit.
        filled: (T, 2) bool, present but not observed: bridged by the cleaner.
        shape_space: "mint" or "mano".
        hand_model: the model's name.
        source: which backend.
        residual_px: (T, 2) float32, mean distance of fitted from seen landmarks; NaN where unseen.

    """

    hand_state: Float32
    presence: Bool
    score: Float32
    filled: Bool
    shape_space: str
    hand_model: str
    source: str
    residual_px: Float32


@dataclass(frozen=True, eq=False)
class Clip:
    """A stretch of a video on its way through the cascade.

    Attributes:
        key: name of the clip, [a-z0-9_-]+; starts with its video's.
        video: the normalised file: constant rate, H.264, upright, square pixels.
        first_frame: frame of that file where the clip begins.
        image_size_hw: (height, width) of its frames.
        fps: its rate.
        source_timestamps_s: (T,) float64, presentation times in the source video.
        detections, intrinsics, camera, scale, hands, text: what the stages found; None before.
        reports: what each stage did, in order.

    """

    key: str
    video: Path
    first_frame: int
    image_size_hw: tuple[int, int]
    fps: float
    source_timestamps_s: Float64
    detections: Detections | None = None
    intrinsics: Intrinsics | None = None
    camera: CameraPath | None = None
    scale: Scale | None = None
    hands: Hands | None = None
    text: tuple[TextSegment, ...] = ()
    reports: tuple[StageReport, ...] = ()

    @property
    def num_frames(self) -> int:
        """T."""
        return len(self.source_timestamps_s)

    @property
    def start_s(self) -> float:
        """Source time of the first frame."""
        return float(self.source_timestamps_s[0])

    @property
    def stop_s(self) -> float:
        """Source time at which the last frame ends."""
        return float(self.source_timestamps_s[-1]) + 1.0 / self.fps

    def lost(self, stage: str, reason: str, *, failed: bool = False) -> Lost:
        """Give up the whole clip."""
        return Lost(self.start_s, self.stop_s, stage, reason, failed)

    def window(self, start: int, stop: int, key: str) -> Self:
        """Return frames start .. stop - 1 as a clip of its own; text is cut and renumbered."""
        frames = slice(start, stop)

        def cut(record: Any, names: tuple[str, ...]) -> Any:
            if record is None:
                return None
            return replace(record, **{name: getattr(record, name)[frames] for name in names})

        detections = self.detections
        if detections is not None:
            inside = (detections.frame >= start) & (detections.frame < stop)
            names = ("box_xyxy", "score", "right_score", "landmarks_uv", "landmarks_m")
            kept = {name: getattr(detections, name)[inside] for name in names}
            detections = Detections(frame=detections.frame[inside] - np.int32(start), **kept)
        return replace(
            self,
            key=key,
            first_frame=self.first_frame + start,
            source_timestamps_s=self.source_timestamps_s[frames],
            detections=detections,
            camera=cut(self.camera, ("T_camera_from_world", "solved", "covisible")),
            hands=cut(self.hands, ("hand_state", "presence", "score", "filled", "residual_px")),
            text=tuple(
                replace(s, start=max(s.start, start) - start, end=min(s.end, stop) - start)
                for s in self.text
                if s.start < stop and s.end > start
            ),
        )


@dataclass(frozen=True, eq=False)
class Video:
    """A source video and what became of it.

    Attributes:
        key: name, [a-z0-9_-]+.
        uid: what the source calls it.
        source: corpus it belongs to ("ego4d", "epic", "egodex"), or "user".
        path: the file.
        duration_s: seconds of source time there are to account for, from ``start_s`` on.
        fps: native frame rate.
        image_size_hw: native (height, width), upright.
        start_s: presentation time of its first frame.
        clips: what is still in the running.
        lost: what is not.
        reports: of the stages that saw the whole video.

    """

    key: str
    uid: str
    source: str
    path: Path
    duration_s: float
    fps: float
    image_size_hw: tuple[int, int]
    start_s: float = 0.0
    clips: tuple[Clip, ...] = ()
    lost: tuple[Lost, ...] = ()
    reports: tuple[StageReport, ...] = ()

    @property
    def stop_s(self) -> float:
        """Source time at which the video ends."""
        return self.start_s + self.duration_s
