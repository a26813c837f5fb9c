"""Video in: frames with their times, from any source, with bounded memory.

One clock: every time is a presentation time of the container, in seconds. It starts at
``VideoInfo.start_time_s``, which is 0 in nearly all files. Frames are what a player would show:
rotation metadata is applied and non-square pixels are resampled to square ones (the stored height
is kept, the width becomes width x sample aspect ratio).
"""

import math
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from mint_hub.conventions import MODEL_FPS
from mint_hub.loaders.video_decoder import (
    TIE_S,
    Decoder,
    NumThreads,
    OnError,
    Picture,
    Stored,
    VideoInfo,
    describe,
)
from mint_hub.loaders.video_source import (
    VideoError,
    VideoNotFoundError,
    VideoSource,
    open_video,
)

__all__ = [
    "Frame",
    "NumThreads",
    "OnError",
    "VideoError",
    "VideoFrames",
    "VideoInfo",
    "VideoNotFoundError",
    "VideoSource",
    "iter_frames",
    "probe",
]


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One frame that comes out.

    Attributes:
        index: its number k among the frames that come out.
        timestamp_s: its own time: on the grid t0 + k / fps, or the source's when not resampled.
        source_timestamp_s: presentation time of the stored frame it shows.
        source_index: number of that stored frame, counted from the first one decoded (the first
            of the file unless ``start_s`` was given).
        image: (H, W, 3) uint8 RGB; neighbours that show one stored frame share one array.

    """

    index: int
    timestamp_s: float
    source_timestamp_s: float
    source_index: int
    image: NDArray[np.uint8]


def probe(source: VideoSource) -> VideoInfo:
    """Describe a video by opening it and decoding its first frame; errors as in `iter_frames`."""
    with VideoFrames(source, num_threads=1) as frames:
        return frames.info


def iter_frames(
    source: VideoSource,
    fps: float | None = MODEL_FPS,
    start_s: float | None = None,
    stop_s: float | None = None,
    num_threads: NumThreads = "auto",
    on_error: OnError = "raise",
) -> "VideoFrames":
    """Stream the frames of a video, on a regular grid of times or at the video's own.

    With ``fps`` the k-th frame is the stored one nearest in presentation time to t0 + k / fps, the
    earlier of two as near; t0 is ``start_s``, or the first frame's time. A whole video gives
    duration x fps frames, rounded, at least one. ``fps=None`` gives every stored frame once.

    Args:
        source: see `VideoSource`. A file object is read from its beginning and left open.
        fps: frames a second of the grid, or None for the video's own timing.
        start_s: first time wanted, on the container's clock (inclusive).
        stop_s: time to stop before (exclusive).
        num_threads: threads of the decoder; "auto" is one a core.
        on_error: what damage in the middle does: "raise" a VideoError that tells how far decoding
            came, or "stop" there and note it in ``warnings``. With several threads up to as many
            frames after the damage may still come out.

    Returns:
        A `VideoFrames`: an iterator of `Frame` with ``info`` and ``warnings``.

    Raises:
        VideoNotFoundError: nothing at that path or URL.
        VideoError: a folder, not a video, no video stream, no frames, cut short, damaged, no frame
            in the interval; opening errors at once, the others while iterating.
        ValueError: arguments out of range.

    """
    return VideoFrames(source, fps, start_s, stop_s, num_threads, on_error)


_Pick = tuple[float, Stored]


class VideoFrames(Iterator[Frame]):
    """Iterator of `Frame`; made by `iter_frames`. A context manager; exhausting it closes it too.

    Attributes:
        info: `VideoInfo`, known from the start.
        warnings: what was forgiven, in words; complete once the iterator is exhausted.

    """

    def __init__(
        self,
        source: VideoSource,
        fps: float | None = None,
        start_s: float | None = None,
        stop_s: float | None = None,
        num_threads: NumThreads = "auto",
        on_error: OnError = "raise",
    ) -> None:
        _check_arguments(fps, start_s, stop_s, num_threads, on_error)
        self._closing = ExitStack()
        self._frames: Iterator[Frame] = iter(())
        try:
            name, container = open_video(source, self._closing)
            decoder = Decoder(name, container, num_threads, on_error)
            self.warnings = decoder.warnings
            stored = decoder.stored()
            first = next(stored, None)
            if first is None:
                cause = f": {self.warnings[0]}" if self.warnings else ""
                raise VideoError(f"{name}: its video stream holds no frames{cause}")
            picture = Picture(first.frame, decoder.stream)
            if not picture.straight:
                self.warnings.append(
                    f"{name}: its turn of {first.frame.rotation} degrees was taken as "
                    f"{picture.rotation_deg}"
                )
            self.info = describe(name, container, decoder.stream, first, picture)
            t0 = first.time_s if start_s is None else max(start_s, first.time_s)
            stored = decoder.stored_from(t0, first, stored)
        except BaseException:
            self.close()
            raise
        picks = _native(stored, t0) if fps is None else _grid(stored, t0, fps)
        self._frames = self._emit(picks, picture, start_s, stop_s)

    def __next__(self) -> Frame:
        return next(self._frames)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Let go of the file; iterating further ends."""
        self._frames = iter(())
        self._closing.close()

    def _emit(
        self,
        picks: Iterator[_Pick],
        picture: Picture,
        start_s: float | None,
        stop_s: float | None,
    ) -> Iterator[Frame]:
        shown, image, index = -1, np.empty((0, 0, 3), np.uint8), 0
        for time_s, stored in picks:
            if stop_s is not None and time_s > stop_s - TIE_S:
                break
            if stored.number != shown:
                shown, image = stored.number, picture.rgb(stored.frame)
            yield Frame(index, time_s, stored.time_s, stored.number, image)
            index += 1
        self._closing.close()
        if index == 0:
            length = (
                "" if self.info.duration_s is None else f", is {self.info.duration_s:.3f} s long"
            )
            raise VideoError(
                f"{self.info.source}: no frame between start_s={start_s} and stop_s={stop_s}; "
                f"the video starts at {self.info.start_time_s:.3f} s{length}"
            )


def _native(stored: Iterator[Stored], t0: float) -> Iterator[_Pick]:
    """Pick every stored frame from t0 on, at its own time."""
    return ((item.time_s, item) for item in stored if item.time_s > t0 - TIE_S)


def _grid(stored: Iterator[Stored], t0: float, fps: float) -> Iterator[_Pick]:
    """Pick the stored frame nearest to each t0 + k / fps, until the last one's time is over."""
    index, previous, duration_s = 0, None, 0.0
    for current in stored:
        if previous is not None:
            middle = (previous.time_s + current.time_s) / 2 + TIE_S
            while t0 + index / fps <= middle:
                yield t0 + index / fps, previous
                index += 1
            duration_s = current.duration_s or current.time_s - previous.time_s
        else:
            duration_s = current.duration_s
        previous = current
    if previous is None:
        return
    end_s = previous.time_s + duration_s
    if index == 0 and (t0 < end_s or t0 == previous.time_s):
        yield t0, previous
        index = 1
    # Half a step, or half of the last frame, of slack: a video neither grows nor loses its end.
    end_s -= min(1 / fps, duration_s) / 2 + TIE_S
    while t0 + index / fps < end_s:
        yield t0 + index / fps, previous
        index += 1


def _check_arguments(
    fps: float | None,
    start_s: float | None,
    stop_s: float | None,
    num_threads: NumThreads,
    on_error: OnError,
) -> None:
    if fps is not None and not (math.isfinite(fps) and fps > 0):
        raise ValueError(f"fps: expected a positive number or None, got {fps}")
    for name, value in (("start_s", start_s), ("stop_s", stop_s)):
        if value is not None and not math.isfinite(value):
            raise ValueError(f"{name}: expected seconds or None, got {value}")
    if start_s is not None and stop_s is not None and stop_s <= start_s:
        raise ValueError(f"stop_s: expected more than start_s={start_s}, got {stop_s}")
    if num_threads != "auto" and num_threads < 1:
        raise ValueError(f"num_threads: expected a positive number or 'auto', got {num_threads}")
    if on_error not in ("raise", "stop"):
        raise ValueError(f"on_error: expected 'raise' or 'stop', got {on_error!r}")
