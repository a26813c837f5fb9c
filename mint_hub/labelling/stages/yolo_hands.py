"""Hand detection by a YOLO model of the user's, through ultralytics.

Gives boxes and sides, no landmarks. WiLoR's detector (classes 0 left, 1 right) is one such model.
This adapter was run on recorded results only, made to ultralytics' documented ones, and not with
the package itself, whose licence (AGPL-3.0) is the user's to accept.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mint_hub.labelling.environments import Environment
from mint_hub.labelling.frames import clip_frames
from mint_hub.labelling.readiness import Lack, path_lacks
from mint_hub.labelling.records import Clip, Detections, Video
from mint_hub.labelling.stage import LOCAL, Outcome, Resources, StageError, report_of, reported
from mint_hub.labelling.stages.research import ResearchStage
from mint_hub.labelling.worker import Arrays

_CHUNK: Final = 64


@dataclass(frozen=True)
class YoloSettings:
    """Settings of `YoloHands`.

    Attributes:
        weights: path of the model (.pt).
        left_class, right_class: numbers of its classes; other classes are left out.
        confidence: least score of a box, 0 to 1.
        device: as ultralytics takes it; its own choice when empty.
        python: an interpreter that has ultralytics, instead of one made for it.
        timeout_s: for 64 frames.

    """

    weights: str = field(default="", metadata=LOCAL)
    left_class: int = 0
    right_class: int = 1
    confidence: float = 0.3
    device: str = ""
    python: str = field(default="", metadata=LOCAL)
    timeout_s: float = 600.0


class YoloHands(ResearchStage):
    """Stage "detect", backend "yolo"."""

    stage: str = "detect"
    backend: str = "yolo"
    version: str = "1"
    needs: tuple[str, ...] = ()
    gives: tuple[str, ...] = ("detections",)
    resources: Resources = Resources(cpus=1.0, gpus=0.25, memory_gib=4.0)
    environment = Environment("ultralytics", ("ultralytics>=8.3,<9",), ("ultralytics",))

    def __init__(self, settings: YoloSettings | None = None) -> None:
        self.settings = settings or YoloSettings()

    def files_lack(self) -> tuple[Lack, ...]:
        """Return what is missing of the user's files."""
        where = (
            "a YOLO model of left and right hands: your own, or detector.pt that WiLoR's authors "
            "publish at huggingface.co/spaces/rolpotamias/WiLoR (mind its licence)"
        )
        return path_lacks("weights", self.settings.weights, "weights of a hand detector", where)

    def run_clip(self, clip: Clip, video: Video) -> Outcome:
        """Find the hands of every frame.

        Raises:
            StageError: the frames cannot be read, or the model fails or has other classes.
            NotReadyError: weights or environment are missing.

        """
        settings = self.settings
        parts: list[Detections] = []
        for first, images in _chunks(clip):
            arrays, values = self.call(
                "yolo",
                {"images": images},
                weights=settings.weights,
                confidence=settings.confidence,
                device=settings.device,
            )
            names = values["names"]
            if not {str(settings.left_class), str(settings.right_class)} <= set(names):
                raise StageError(
                    f"{settings.weights}: expected classes {settings.left_class} (left) and "
                    f"{settings.right_class} (right), got {names}; set left_class, right_class"
                )
            parts.append(to_detections(arrays, first, settings.left_class, settings.right_class))
        found = Detections(
            **{n: np.concatenate([getattr(p, n) for p in parts]) for n in vars(parts[0])}
        )
        counts = np.bincount(found.frame, minlength=clip.num_frames)
        report = report_of(
            self, detections=len(found.frame), frames_with_a_hand=float((counts > 0).mean())
        )
        return Outcome((reported(clip, report, detections=found),))


def to_detections(arrays: Arrays, first: int, left: int, right: int) -> Detections:
    """Make detections of what the worker's ``yolo`` returned.

    The model scores hand and side in one: the surer the box, the surer the side.
    """
    known = (arrays["kind"] == left) | (arrays["kind"] == right)
    score = arrays["score"][known].astype(np.float32)
    count = len(score)
    sign = np.where(arrays["kind"][known] == right, 1.0, -1.0)
    return Detections(
        frame=(arrays["frame"][known] + first).astype(np.int32),
        box_xyxy=arrays["box"][known].astype(np.float32),
        score=score,
        right_score=((1 + sign * score) / 2).astype(np.float32),
        landmarks_uv=np.full((count, 21, 2), np.nan, np.float32),
        landmarks_m=np.full((count, 21, 3), np.nan, np.float32),
    )


def _chunks(clip: Clip) -> Iterator[tuple[int, NDArray[np.uint8]]]:
    for first in range(0, clip.num_frames, _CHUNK):
        stop = min(first + _CHUNK, clip.num_frames)
        yield first, np.stack(list(clip_frames(clip, first, stop)))
