"""The stage protocol: what a backend has to be.

A stage is a function from record to record that declares what it needs and gives. A `ClipStage`
sees one clip at a time, so clips spread over workers; a `VideoStage` sees all clips of a video at
once. Settings are a frozen dataclass of plain values; stages are made from settings alone and hold
no other state between calls than workers they may have started (`close` ends those).
"""

import json
from collections.abc import Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import PurePath
from typing import Any, Final, Protocol, runtime_checkable

from mint_hub.labelling.records import Clip, Lost, StageReport, Video


class StageError(RuntimeError):
    """A stage could not do its work on this clip; the message is the reason kept for it."""


class NotReadyError(RuntimeError):
    """A backend lacks something; the message says what, and where to get it."""


@dataclass(frozen=True)
class Resources:
    """What one worker of a stage occupies."""

    cpus: float = 1.0
    gpus: float = 0.0
    memory_gib: float = 1.0


@dataclass(frozen=True)
class Outcome:
    """What a clip became: none, one or several clips, and the stretches that were let go."""

    clips: tuple[Clip, ...]
    lost: tuple[Lost, ...] = ()


class Stage(Protocol):
    """What every backend declares; class attributes will do.

    Places in the cascade are "normalise", "detect", "filter", "intrinsics", "undistort", "depth",
    "camera", "hands", "stitch", "scale", "clean", "describe" and "accept".
    """

    @property
    def stage(self) -> str:
        """Its place in the cascade."""
        ...

    @property
    def backend(self) -> str:
        """Its name there."""
        ...

    @property
    def version(self) -> str:
        """Goes up when results change."""
        ...

    @property
    def needs(self) -> tuple[str, ...]:
        """Fields of `Clip` it reads."""
        ...

    @property
    def gives(self) -> tuple[str, ...]:
        """Fields of `Clip` it writes."""
        ...

    @property
    def resources(self) -> Resources:
        """What one worker of it occupies."""
        ...

    @property
    def settings(self) -> Any:
        """A frozen dataclass of plain values."""
        ...

    def close(self) -> None:
        """End workers, if any were started."""
        ...


@runtime_checkable
class ClipStage(Stage, Protocol):
    """A stage that sees one clip at a time."""

    def run_clip(self, clip: Clip, video: Video) -> Outcome:
        """Do the work; `StageError` (or any exception) fails this clip and no other.

        ``video`` is there for what belongs to the whole (uid, size, lens); its clips may be stale.
        """
        ...


@runtime_checkable
class VideoStage(Stage, Protocol):
    """A stage that sees all clips of a video at once."""

    def run_video(self, video: Video) -> Video:
        """Return the video with its clips changed, and what was let go added to ``lost``."""
        ...


def reported(clip: Clip, report: StageReport, **changes: Any) -> Clip:
    """Return the clip with ``changes`` and the report added."""
    return replace(clip, **changes, reports=(*clip.reports, report))


LOCAL: Final = {"local": True}
"""Metadata of a settings field that says where something is on this machine."""


def plain(settings: Any) -> dict[str, Any]:
    """Return a settings dataclass as plain JSON; LOCAL fields by their last part only."""
    values: dict[str, Any] = {}
    for f in fields(settings):
        value = getattr(settings, f.name)
        if f.metadata.get("local"):
            value = PurePath(value).name
        values[f.name] = plain(value) if is_dataclass(value) else value
    return json.loads(json.dumps(values, default=str))


def report_of(stage: Stage, **numbers: Any) -> StageReport:
    """Return the report of a stage that measured these numbers; its time is added later."""
    return StageReport(
        stage.stage, stage.backend, stage.version, plain(stage.settings), numbers=numbers
    )


def require(stage: Stage, clip: Clip) -> None:
    """Check that earlier stages gave what this one needs.

    Raises:
        StageError: names the stage, the clip and the missing field.

    """
    for name in stage.needs:
        if getattr(clip, name) is None:
            raise StageError(
                f"{stage.stage} ({stage.backend}): expected {name} of clip {clip.key}, got none: "
                "a stage before this one has to give it"
            )


def lost_seconds(
    span: tuple[float, float], kept: Sequence[tuple[float, float]], lost: Sequence[Lost]
) -> dict[str, float]:
    """Seconds lost by reason, each moment of the span counted once: span = kept + all reasons.

    What is kept anywhere is not lost; of two reasons for one moment the first one counts; what
    nobody accounts for is listed as "unaccounted".
    """
    free = subtract([span], list(kept))
    seconds: dict[str, float] = {}
    for item in lost:
        rest = subtract(free, [(item.start_s, item.stop_s)])
        taken = length(free) - length(rest)
        if taken > 0:
            reason = f"{item.stage}: {item.reason}"
            seconds[reason] = seconds.get(reason, 0.0) + taken
        free = rest
    if (remainder := length(free)) > 1e-6:
        seconds["unaccounted"] = remainder
    return seconds


def length(intervals: Sequence[tuple[float, float]]) -> float:
    """Total length of disjoint intervals."""
    return sum(stop - start for start, stop in intervals)


def subtract(
    intervals: Sequence[tuple[float, float]], holes: Sequence[tuple[float, float]]
) -> list[tuple[float, float]]:
    """Disjoint intervals without the holes, in order.

    >>> subtract([(0.0, 10.0)], [(2.0, 3.0), (9.0, 12.0)])
    [(0.0, 2.0), (3.0, 9.0)]
    """
    left = sorted(intervals)
    for hole_start, hole_stop in holes:
        parts = [
            part
            for start, stop in left
            for part in ((start, min(stop, hole_start)), (max(start, hole_stop), stop))
        ]
        left = sorted({(start, stop) for start, stop in parts if stop > start})
    return left
