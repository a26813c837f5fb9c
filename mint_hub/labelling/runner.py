"""Carry videos through the cascade: here, or on whatever an executor stands for.

The runner alone decides what is done next and writes the manifest; executors only do tasks. Videos
that are further along go first and only so many are open at once, so that nothing piles up.
"""

import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

from tqdm.auto import tqdm

from mint_hub.labelling.cascade import Cascade, Result, Task
from mint_hub.labelling.manifest import FINAL, Manifest, Row, State
from mint_hub.labelling.records import Lost, Video

ATTEMPTS = 3
"""How often a task may cost a worker its life before it is given up."""


@dataclass(frozen=True)
class Died:
    """A worker died over a task: killed, out of memory, lost with its machine."""

    reason: str


class Executor(Protocol):
    """Whoever does the tasks."""

    def has_room(self, task: Task) -> bool:
        """Whether to submit this task now."""
        ...

    def submit(self, task: Task) -> None:
        """Begin a task."""
        ...

    def finished(self) -> Sequence[tuple[Task, Result | Died]]:
        """Wait until tasks ended, and return them; never called with nothing under way."""
        ...

    def close(self) -> None:
        """End all workers."""
        ...


class InProcess:
    """Does each task at once, in this process."""

    def __init__(self, cascade: Cascade) -> None:
        self._cascade = cascade
        self._waiting: deque[Task] = deque()

    def has_room(self, task: Task) -> bool:
        """One at a time."""
        return not self._waiting

    def submit(self, task: Task) -> None:
        """Keep it until it is asked for."""
        self._waiting.append(task)

    def finished(self) -> Sequence[tuple[Task, Result | Died]]:
        """Do what waits."""
        task = self._waiting.popleft()
        return [(task, self._cascade.perform(task))]

    def close(self) -> None:
        """End the stages' own workers."""
        self._cascade.close()


@dataclass
class _Progress:
    """A video between two stages: what is still to be done of the present one."""

    video: Video
    position: int
    tasks: list[Task]
    ready: deque[Task]
    under_way: int = 0

    @property
    def share(self) -> float:
        """How much of the present stage is done."""
        return 1 - (len(self.ready) + self.under_way) / len(self.tasks) if self.tasks else 0.0


class Run:
    """One run of a cascade over videos.

    Args:
        cascade: the stages.
        executor: who does the tasks.
        work: folder of the tasks' files.
        manifest: where states are written.
        open_videos: how many videos are between first and last stage at once.
        retry_failed: do again what failed with an error in an earlier run.
        progress: show a bar: hours done, hours an hour, time to go.
        on_video: called with each finished video.

    """

    def __init__(
        self,
        cascade: Cascade,
        executor: Executor,
        work: Path,
        manifest: Manifest,
        *,
        open_videos: int = 4,
        retry_failed: bool = False,
        progress: bool = False,
        on_video: Callable[[Video], None] | None = None,
    ) -> None:
        self.cascade, self.executor, self.work, self.manifest = cascade, executor, work, manifest
        self._open_videos = open_videos
        self._retry_failed = retry_failed
        self._progress = progress
        self._on_video = on_video or _ignore
        self._open: list[_Progress] = []
        self._finished_h = 0.0
        self._begun = time.monotonic()

    def __call__(self, videos: Iterable[Video]) -> None:
        """Label every video; what each became is told to ``on_video``.

        Raises:
            FullDiskError, NotReadyError: nothing can go on; what is finished stays finished.

        """
        waiting = deque(videos)
        hours = sum(video.duration_s for video in waiting) / 3600
        with self._bar(hours) as bar:
            try:
                while waiting or self._open:
                    while waiting and len(self._open) < self._open_videos:
                        self._begin(waiting.popleft(), bar)
                    self._submit()
                    if any(p.under_way for p in self._open):
                        for task, result in self.executor.finished():
                            self._end(task, result, bar)
            finally:
                self.executor.close()

    # ------------------------------------------------------------------- steps

    def _begin(self, video: Video, bar: Any) -> None:
        self.manifest.add(Row(video.key, "", "", "running"))
        opened = _Progress(video, -1, [], deque())
        self._open.append(opened)
        self._advance(opened, bar)

    def _advance(self, opened: _Progress, bar: Any) -> None:
        """Go on to the next stage that has something to do, or finish the video."""
        while not opened.ready and not opened.under_way:
            if opened.tasks:
                opened.video = self.cascade.gathered(opened.video, opened.tasks)
            opened.position += 1
            last = opened.position == len(self.cascade)
            if last or (opened.position and not opened.video.clips):
                self._finish(opened, bar)
                return
            opened.tasks = self.cascade.tasks(opened.video, opened.position, self.work)
            opened.ready = deque(task for task in opened.tasks if not self._stored(task))
            for task in opened.ready:
                if task.clip is not None:
                    self._say(task, "pending")
            self._show(bar)

    def _stored(self, task: Task) -> bool:
        return self.cascade.stored(task, retry_failed=self._retry_failed)

    def _submit(self) -> None:
        for opened in sorted(self._open, key=lambda p: -p.position):
            while opened.ready and self.executor.has_room(opened.ready[0]):
                task = opened.ready.popleft()
                self._say(task, "running")
                self.executor.submit(task)
                opened.under_way += 1

    def _end(self, task: Task, result: Result | Died, bar: Any) -> None:
        opened = next(p for p in self._open if p.video.key == task.video.key)
        opened.under_way -= 1
        if isinstance(result, Died):
            if task.attempt < ATTEMPTS:
                opened.ready.appendleft(replace(task, attempt=task.attempt + 1))
                self._say(task, "pending", reason=f"worker died: {result.reason}")
                return
            reason = f"worker died {ATTEMPTS} times: {result.reason}"
            result = self.cascade.fail(task, reason)
        self._tell(task, result)
        self._show(bar)
        self._advance(opened, bar)

    def _finish(self, opened: _Progress, bar: Any) -> None:
        self._open.remove(opened)
        video = opened.video
        self._on_video(video)
        kept = {clip.key for clip in video.clips}
        for (key, clip), row in self.manifest.latest().items():
            if key == video.key and clip and clip not in kept and row.state not in FINAL:
                self.manifest.add(replace(row, state="done", reason="became other clips"))
        for clip in video.clips:
            self.manifest.add(Row(video.key, clip.key, "", "done"))
        failed = any(lost.failed for lost in video.lost)
        state: State = "done" if video.clips else "failed" if failed else "rejected"
        reason = "" if video.clips else _main_reason(video.lost)
        self.manifest.add(Row(video.key, "", "", state, reason))
        self._finished_h += video.duration_s / 3600
        self._show(bar)

    # ------------------------------------------------------------------- words

    def _say(self, task: Task, state: State, reason: str = "", seconds: float = 0.0) -> None:
        stage = self.cascade.stages[task.position].stage
        self.manifest.add(
            Row(task.video.key, task.clip_key, stage, state, reason, seconds, task.attempt)
        )

    def _tell(self, task: Task, result: Result) -> None:
        """Say how a task ended; a clip that goes on stays pending for its next stage."""
        seconds = round(result.seconds, 3)
        if result.failure:
            self._say(task, "failed", result.failure, seconds)
        elif task.clip is not None and not result.num_clips and result.lost:
            self._say(task, "rejected", result.lost[0].reason, seconds)
        elif task.clip is not None:
            self._say(task, "pending", seconds=seconds)

    def _bar(self, hours: float) -> Any:
        form = "{l_bar}{bar}| {n:.3f}/{total:.3f} h [{elapsed}<{remaining}{postfix}]"
        return tqdm(total=hours, bar_format=form, disable=None if self._progress else True)

    def _show(self, bar: Any) -> None:
        """Hours done count an open video by the stages it has behind it."""
        stages = len(self.cascade)
        parts = (p.video.duration_s * (p.position + p.share) / stages for p in self._open)
        bar.n = self._finished_h + sum(parts) / 3600
        rate = bar.n / (max(time.monotonic() - self._begun, 1e-3) / 3600)
        at = ", ".join(
            f"{p.video.key}: {self.cascade.stages[p.position].stage}" for p in self._open
        )
        bar.set_postfix_str(f"{rate:.2f} h/h, {at}")


def _main_reason(lost: Sequence[Lost]) -> str:
    """What cost most of the video."""
    if not lost:
        return "nothing was left of it"
    seconds: dict[str, float] = {}
    for item in lost:
        seconds[item.reason] = seconds.get(item.reason, 0.0) + item.seconds
    return max(seconds, key=lambda reason: seconds[reason])


def _ignore(_: Video) -> None:
    """Nobody wants to know."""
