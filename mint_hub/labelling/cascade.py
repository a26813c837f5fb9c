"""The cascade: which stages, in which order, and how one task of it is done.

A task is one stage on one clip, or on a whole video. Its result is a file in the work folder, named
after stage and clip and stamped with the fingerprint of everything before it: the source file and
every stage up to this one with its version and settings. A task whose file is there and stamped
alike is never done again, whoever asks and however the last run ended.
"""

import errno
import hashlib
import json
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar, cast

from mint_hub.labelling import record_files
from mint_hub.labelling.records import Clip, Lost, Video
from mint_hub.labelling.stage import ClipStage, NotReadyError, Outcome, Stage, VideoStage, plain

RecordT = TypeVar("RecordT", Clip, Video)


class FullDiskError(OSError):
    """There is no room for results: the run stops, and goes on when there is."""


@dataclass(frozen=True)
class Task:
    """One stage on one clip, or on a whole video where ``clip`` is None."""

    position: int
    video: Video
    clip: Clip | None
    path: Path
    fingerprint: str
    attempt: int = 1

    @property
    def clip_key(self) -> str:
        """Key of the clip, empty for the whole video."""
        return "" if self.clip is None else self.clip.key

    @property
    def seconds(self) -> float:
        """Source time it covers."""
        if self.clip is None:
            return self.video.duration_s
        return self.clip.stop_s - self.clip.start_s


@dataclass(frozen=True)
class Result:
    """How a task ended; its file is there either way.

    Attributes:
        seconds: wall time.
        lost: what it let go of.
        num_clips: how many clips it left.

    """

    seconds: float
    lost: tuple[Lost, ...] = ()
    num_clips: int = 0

    @property
    def failure(self) -> str:
        """Why it failed; empty when it did not."""
        return next((item.reason for item in self.lost if item.failed), "")


class Cascade:
    """Stages in order."""

    def __init__(self, stages: Sequence[Stage]) -> None:
        if not stages:
            raise ValueError("stages: expected at least one, got none")
        self.stages = tuple(stages)

    def __len__(self) -> int:
        return len(self.stages)

    def fingerprint(self, video: Video, position: int) -> str:
        """Everything that the result of the stage at ``position`` depends on, as a hash."""
        stages = [
            [s.stage, s.backend, s.version, plain(s.settings)] for s in self.stages[: position + 1]
        ]
        stat = video.path.stat() if video.path.is_file() else None
        stamp = [str(video.path), stat and stat.st_size, stat and stat.st_mtime_ns]
        said = [video.key, video.uid, video.source, stamp, stages]
        return hashlib.sha256(json.dumps(said, sort_keys=True).encode()).hexdigest()

    def tasks(self, video: Video, position: int, work: Path) -> list[Task]:
        """Return the tasks of one stage on a video as earlier stages left it."""
        stage = self.stages[position]
        folder = work / video.key / f"{position:02d}-{stage.stage}"
        stamp = self.fingerprint(video, position)
        if isinstance(stage, VideoStage):
            return [Task(position, video, None, folder / "video.npz", stamp)]
        lean = replace(video, clips=(), reports=())
        return [
            Task(position, lean, clip, folder / f"{clip.key}.npz", stamp) for clip in video.clips
        ]

    def stored(self, task: Task, *, retry_failed: bool = False) -> bool:
        """Whether the task's file is there, whole and made by the same."""
        value = record_files.load_current(task.path, task.fingerprint)
        if value is None:
            return False
        return not (retry_failed and any(lost.failed for lost in _news(task, value)))

    def perform(self, task: Task) -> Result:
        """Do a task and write its file; an error of the stage is a result too, and kept.

        Raises:
            FullDiskError: there is no room for the file.
            NotReadyError: the backend lacks something; no clip can be blamed.

        """
        stage = self.stages[task.position]
        begun = time.perf_counter()
        try:
            value = _called(stage, task, begun)
        except NotReadyError:
            raise
        except Exception as error:  # a poison clip spoils nothing but itself
            if _disk_is_full(error):
                raise FullDiskError(errno.ENOSPC, f"{task.path.parent}: no room left") from error
            return self.fail(task, _reason(error), time.perf_counter() - begun)
        return _written(task, value, time.perf_counter() - begun)

    def fail(self, task: Task, reason: str, seconds: float = 0.0) -> Result:
        """Write that a task failed: what it covers is lost for this reason."""
        stage = self.stages[task.position].stage
        if task.clip is not None:
            value = Outcome((), (task.clip.lost(stage, reason, failed=True),))
        else:
            lost = Lost(task.video.start_s, task.video.stop_s, stage, reason, failed=True)
            value = replace(task.video, clips=(), lost=(*task.video.lost, lost))
        return _written(task, value, seconds)

    def gathered(self, video: Video, tasks: Sequence[Task]) -> Video:
        """Return the video after a stage whose tasks all have their files."""
        values = [record_files.load(task.path)[0] for task in tasks]
        if tasks and tasks[0].clip is None:
            return cast("Video", values[0])
        outcomes = cast("list[Outcome]", values)
        clips = [clip for outcome in outcomes for clip in outcome.clips]
        clips.sort(key=lambda clip: (clip.start_s, clip.key))
        lost = [item for outcome in outcomes for item in outcome.lost]
        return replace(video, clips=tuple(clips), lost=(*video.lost, *lost))

    def close(self) -> None:
        """End what the stages started."""
        for stage in self.stages:
            stage.close()


def _news(task: Task, value: Video | Outcome) -> tuple[Lost, ...]:
    """What the task itself let go of."""
    return value.lost if isinstance(value, Outcome) else value.lost[len(task.video.lost) :]


def _written(task: Task, value: Video | Outcome, seconds: float) -> Result:
    try:
        record_files.save(task.path, value, task.fingerprint)
    except OSError as error:
        if _disk_is_full(error):
            raise FullDiskError(errno.ENOSPC, f"{task.path.parent}: no room left") from error
        raise
    return Result(seconds, _news(task, value), len(value.clips))


def _disk_is_full(error: Exception) -> bool:
    return isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT)


def _called(stage: Stage, task: Task, begun: float) -> Video | Outcome:
    """Call the stage; its newest report gets the wall time."""
    if task.clip is not None:
        outcome = cast("ClipStage", stage).run_clip(task.clip, task.video)
        seconds = (time.perf_counter() - begun) / max(len(outcome.clips), 1)
        return replace(outcome, clips=tuple(_timed(c, stage, seconds) for c in outcome.clips))
    video = cast("VideoStage", stage).run_video(task.video)
    return _timed(video, stage, time.perf_counter() - begun)


def _timed(record: RecordT, stage: Stage, seconds: float) -> RecordT:
    if not record.reports or record.reports[-1].stage != stage.stage:
        return record
    newest = replace(record.reports[-1], seconds=round(seconds, 4))
    return replace(record, reports=(*record.reports[:-1], newest))


def _reason(error: Exception) -> str:
    known = isinstance(error, ValueError | OSError | RuntimeError)
    lines = str(error).strip().splitlines()
    text = lines[0] if lines else "no message"
    return text if known else f"{type(error).__name__}: {text}"
