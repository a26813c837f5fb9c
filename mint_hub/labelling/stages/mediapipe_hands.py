"""Hand detection by MediaPipe Hands (Zhang et al. 2020, arXiv 2006.10214), tracked over a clip.

Runs on a CPU without anything to download but the package, which pins numpy < 2 and therefore
lives in an environment of its own. Its sides are per frame and often wrong: tracks vote later.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from mint_hub.labelling.environments import Environment
from mint_hub.labelling.frames import clip_frames
from mint_hub.labelling.readiness import Lack, python_for, python_lacks
from mint_hub.labelling.records import Clip, Detections, Video
from mint_hub.labelling.stage import LOCAL, Outcome, Resources, report_of, reported
from mint_hub.labelling.worker import Arrays, Worker

ENVIRONMENT: Final = Environment(
    "mediapipe",
    ("mediapipe==0.10.21", "numpy>=1.26,<2", "protobuf>=4.25.3,<5"),
    ("mediapipe", "mediapipe.python.solution_base"),
)
_CHUNK: Final = 64
_TIMEOUT_S: Final = 300.0


@dataclass(frozen=True)
class MediaPipeSettings:
    """Settings of `MediaPipeHands`.

    Attributes:
        height: frames that are higher are shrunk to this height for detection.
        max_hands: hands followed at once; more than two, so that a third one is noticed.
        detection_confidence: least score of a palm, 0 to 1.
        tracking_confidence: least presence of a hand that is followed, 0 to 1.
        complexity: 0 or 1, the lighter or the better landmark model.
        double_distance, double_overlap: two hands of one frame are one when their landmarks lie
            this near on average, as a share of the smaller one's size, or when this share of the
            smaller one's box lies in the other's. One hand in a hundred that are really two looks
            like that, nearly all thirds do.
        python: an interpreter that has mediapipe, instead of one made for it.

    """

    height: int = 384
    max_hands: int = 4
    detection_confidence: float = 0.5
    tracking_confidence: float = 0.5
    complexity: int = 1
    double_distance: float = 0.4
    double_overlap: float = 0.75
    python: str = field(default="", metadata=LOCAL)


class MediaPipeHands:
    """Stage "detect", backend "mediapipe"."""

    stage: str = "detect"
    backend: str = "mediapipe"
    version: str = "1"
    needs: tuple[str, ...] = ()
    gives: tuple[str, ...] = ("detections",)
    resources: Resources = Resources(cpus=1.0, memory_gib=1.0)

    def __init__(self, settings: MediaPipeSettings | None = None) -> None:
        self.settings = settings or MediaPipeSettings()
        self._worker: Worker | None = None

    def lacks(self) -> tuple[Lack, ...]:
        """Return what is missing for it to run."""
        return python_lacks(self.settings.python, ENVIRONMENT)

    def run_clip(self, clip: Clip, video: Video) -> Outcome:
        """Find the hands of every frame, each clip from its own beginning.

        Raises:
            StageError: the frames cannot be read, or MediaPipe fails on them.
            NotReadyError: its environment cannot be made.

        """
        parts = [self.detect(images, at) for at, images in self._chunks(clip)]
        found = without_doubles(
            joined(parts), self.settings.double_distance, self.settings.double_overlap
        )
        counts = np.bincount(found.frame, minlength=clip.num_frames)
        numbers = {
            "detections": len(found.frame),
            "frames_with_a_hand": float((counts > 0).mean()),
            "frames_with_two": float((counts == 2).mean()),
            "frames_with_more": float((counts > 2).mean()),
        }
        return Outcome((reported(clip, report_of(self, **numbers), detections=found),))

    def detect(self, images: list[NDArray[np.uint8]], at: int) -> Detections:
        """Find the hands of frames that follow those of the last call; at 0, a new clip begins.

        Args:
            images: RGB (H, W, 3), all of one size.
            at: number of the first in its clip.

        Raises:
            StageError: MediaPipe fails on them.
            NotReadyError: its environment cannot be made.

        """
        settings = self.settings
        if self._worker is None:
            python = python_for(settings.python, ENVIRONMENT)
            script = Path(__file__).with_name("mediapipe_worker.py")
            self._worker = Worker(python, script, "mediapipe", timeout_s=_TIMEOUT_S)
        size_hw = images[0].shape[:2]
        arrays, _ = self._worker.call(
            "detect",
            {"images": np.stack([_shrunk(image, settings.height) for image in images])},
            restart=at == 0,
            max_hands=settings.max_hands,
            detection_confidence=settings.detection_confidence,
            tracking_confidence=settings.tracking_confidence,
            complexity=settings.complexity,
        )
        return to_detections(arrays, size_hw, at, settings.tracking_confidence)

    def close(self) -> None:
        """End the worker."""
        if self._worker is not None:
            self._worker.close()
            self._worker = None

    def _chunks(self, clip: Clip) -> Iterator[tuple[int, list[NDArray[np.uint8]]]]:
        """Frames in handfuls, each with the number of its first."""
        images: list[NDArray[np.uint8]] = []
        for number, image in enumerate(clip_frames(clip)):
            images.append(image)
            if len(images) == _CHUNK or number + 1 == clip.num_frames:
                yield number + 1 - len(images), images
                images = []


def to_detections(
    arrays: Arrays, size_hw: tuple[int, int], first_frame: int, tracked_score: float
) -> Detections:
    """Make detections of what the worker's ``detect`` returned.

    A hand's score is that of the palm found over it in the same frame, or ``tracked_score`` where
    only the tracker saw it (it has at least that presence). Its box bounds its landmarks.
    """
    height, width = size_hw
    landmarks = arrays["landmarks"][..., :2] * np.array([width, height], np.float32)
    box = np.concatenate([landmarks.min(1), landmarks.max(1)], -1)
    palm = arrays["palm_box"] * np.array([width, height, width, height], np.float32)
    # The palm's joints: wrist and the roots of the four fingers.
    middle = landmarks[:, [0, 5, 9, 13, 17]].mean(1)
    inside = (middle[:, None] >= palm[None, :, :2]) & (middle[:, None] <= palm[None, :, 2:])
    same = arrays["frame"][:, None] == arrays["palm_frame"][None]
    scores = np.where(inside.all(-1) & same, arrays["palm_score"][None], 0.0)
    best = scores.max(1, initial=tracked_score)
    return Detections(
        frame=arrays["frame"] + np.int32(first_frame),
        box_xyxy=box.astype(np.float32),
        score=best.astype(np.float32),
        right_score=arrays["right_score"],
        landmarks_uv=landmarks.astype(np.float32),
        landmarks_m=arrays["landmarks_m"],
    )


def without_doubles(found: Detections, distance: float, overlap: float) -> Detections:
    """Keep one of detections that lie on the same hand of a frame: the surer one, then the first.

    Two are one hand when their landmarks are less than ``distance`` apart on average, in units of
    the smaller one's size (the diagonal of its box), or when more than ``overlap`` of the smaller
    box lies in the other.
    """
    keep = np.ones(len(found.frame), bool)
    for frame in np.flatnonzero(np.bincount(found.frame) > 1):
        (here,) = np.nonzero(found.frame == frame)
        order = here[np.argsort(-found.score[here], kind="stable")]
        for place, one in enumerate(order):
            for other in order[:place]:
                apart, inside = _nearness(found, one, other)
                if keep[other] and (apart < distance or inside > overlap):
                    keep[one] = False
    return _taken(found, keep)


def _nearness(found: Detections, one: int, other: int) -> tuple[float, float]:
    """Mean distance of landmarks over size, and how much of the smaller box is in the other."""
    boxes = found.box_xyxy[[one, other]]
    sides = boxes[:, 2:] - boxes[:, :2]
    between = found.landmarks_uv[one] - found.landmarks_uv[other]
    apart = float(np.linalg.norm(between, axis=-1).mean())
    shared = np.clip(boxes[:, 2:].min(0) - boxes[:, :2].max(0), 0, None).prod()
    size = float(np.linalg.norm(sides, axis=-1).min())
    return apart / max(size, 1e-6), float(shared) / max(float(sides.prod(-1).min()), 1e-6)


def joined(parts: list[Detections]) -> Detections:
    """Put detections of successive frames together."""
    first = parts[0]
    return Detections(
        **{name: np.concatenate([getattr(p, name) for p in parts]) for name in vars(first)}
    )


def _taken(found: Detections, keep: NDArray[np.bool_]) -> Detections:
    return Detections(**{name: value[keep] for name, value in vars(found).items()})


def _shrunk(image: NDArray[np.uint8], height: int) -> NDArray[np.uint8]:
    if image.shape[0] <= height:
        return image
    size: tuple[Any, Any] = (max(1, round(image.shape[1] * height / image.shape[0])), height)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
