"""Video in: frames with their times, from any source, with bounded memory.

One clock: every time is a presentation time of the container, in seconds. It starts at
``VideoInfo.start_time_s``, which is 0 in nearly all files. Frames are what a player would show:
rotation metadata is applied and non-square pixels are resampled to square ones (the stored height
is kept, the width becomes width x sample aspect ratio).
"""

import io
import math
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from fractions import Fraction
from itertools import chain
from os import PathLike, fspath
from pathlib import Path
from typing import Any, BinaryIO, Literal, NamedTuple, Self, cast

import av
import cv2
import numpy as np
from av.container import InputContainer
from av.sidedata.sidedata import Type as SideDataType
from av.video.frame import VideoFrame
from av.video.reformatter import VideoReformatter
from av.video.stream import VideoStream
from numpy.typing import NDArray

from mint_hub.conventions import MODEL_FPS

VideoSource = str | PathLike[str] | bytes | bytearray | memoryview | BinaryIO | Mapping[str, Any]
"""Path, URL (http, https, hf, and what fsspec knows), encoded bytes, seekable binary file object, or
the {"path": ..., "bytes": ...} of an undecoded column of a dataset."""

_TIE_S = 1e-6
_NOT_VIDEO_FORMATS = frozenset({"tty"})  # ffmpeg would render a text file as a terminal


class VideoError(ValueError):
    """A video that cannot be read; the message names the source and the place."""


class VideoNotFoundError(VideoError, FileNotFoundError):
    """There is nothing at this path or URL."""

    def __str__(self) -> str:
        return str(self.args[0])


@dataclass(frozen=True)
class VideoInfo:
    """What is known of a video once its first frame is decoded.

    Attributes:
        source: path, URL or a description, as errors name it.
        image_size_hw: (height, width) of the frames that come out, after rotation and pixel aspect.
        fps: average frame rate, frames a second; 0 where the file does not tell.
        duration_s: seconds; None where the file does not tell.
        num_frames: number of stored frames as the container claims or duration times rate, an
            estimate; None where neither is known.
        rotation_deg: turn applied to the stored frames, counter-clockwise: 0, 90, 180 or 270.
        mirrored: whether the stored frames were also flipped left to right (before the turn).
        sample_aspect_ratio: width over height of a stored pixel.
        codec: name of the decoder.
        start_time_s: presentation time of the first frame.
    """

    source: str
    image_size_hw: tuple[int, int]
    fps: float
    duration_s: float | None
    num_frames: int | None
    rotation_deg: int
    mirrored: bool
    sample_aspect_ratio: float
    codec: str
    start_time_s: float


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
    num_threads: int | Literal["auto"] = "auto",
    on_error: Literal["raise", "stop"] = "raise",
) -> "VideoFrames":
    """Stream the frames of a video, on a regular grid of times or at the video's own.

    With ``fps`` the k-th frame is the stored one nearest in presentation time to t0 + k / fps, the
    earlier of two as near; t0 is ``start_s``, or the first frame's time. A whole video gives
    round(duration x fps) frames, at least one. ``fps=None`` gives every stored frame once.

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


class _Stored(NamedTuple):
    time_s: float
    index: int
    frame: VideoFrame


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
        num_threads: int | Literal["auto"] = "auto",
        on_error: Literal["raise", "stop"] = "raise",
    ) -> None:
        _check_arguments(fps, start_s, stop_s, num_threads, on_error)
        self.warnings: list[str] = []
        self._on_error = on_error
        self._num_decoded = 0
        self._last: _Stored | None = None
        self._reformatter = VideoReformatter()
        self._closing = ExitStack()
        try:
            self._name, self._container = _open(source, self._closing)
            self._stream = _video_stream(self._container, self._name)
            self._stream.thread_type = "AUTO" if num_threads != 1 else "NONE"  # pyright: ignore[reportAttributeAccessIssue]
            self._stream.thread_count = 0 if num_threads == "auto" else num_threads
            stored = self._stored()
            first = next(stored, None)
            if first is None:
                cause = f" ({self.warnings[0]})" if self.warnings else ""
                raise VideoError(f"{self._name}: the video stream holds no frames{cause}")
            self.info, self._swap, self._flip = self._describe(first)
            frames = self._from(start_s, first, stored)
        except BaseException:
            self.close()
            raise
        stop = math.inf if stop_s is None else stop_s
        t0 = self.info.start_time_s if start_s is None else max(start_s, self.info.start_time_s)
        self._frames = self._emit(frames, fps, t0, stop)

    def __next__(self) -> Frame:
        return next(self._frames)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Let go of the file; iterating further ends."""
        self._frames: Iterator[Frame] = iter(())
        self._last = None
        self._closing.close()

    def _describe(self, first: _Stored) -> tuple[VideoInfo, bool, tuple[bool, bool]]:
        stream, frame = self._stream, first.frame
        swap, flip_rows, flip_columns, straight = _orientation(frame)
        if not straight:
            self.warnings.append(
                f"{self._name}: its rotation of {frame.rotation} degrees was rounded to a quarter turn"
            )
        rotation = (270 if flip_columns else 90) if swap else (180 if flip_rows else 0)
        aspect = float(stream.sample_aspect_ratio or 1) or 1.0
        size = frame.height, max(1, round(frame.width * aspect))
        rate = float(stream.average_rate or stream.guessed_rate or 0)
        duration = _duration_s(stream)
        info = VideoInfo(
            source=self._name,
            image_size_hw=(size[1], size[0]) if swap else size,
            fps=rate,
            duration_s=duration,
            num_frames=stream.frames or (round(duration * rate) if duration else None),
            rotation_deg=rotation,
            mirrored=swap ^ flip_rows ^ flip_columns,
            sample_aspect_ratio=aspect,
            codec=stream.codec_context.name,
            start_time_s=first.time_s,
        )
        return info, swap, (flip_rows, flip_columns)

    def _stored(self) -> Iterator[_Stored]:
        """Decode from where the container stands, in order of presentation."""
        try:
            for frame in self._decode():
                time_s = self._time_s(frame)
                if self._last is not None and time_s <= self._last.time_s:
                    self._check_order(time_s)
                    continue
                if frame.is_corrupt:
                    self.warnings.append(f"{self._name}: the frame at {time_s:.3f} s is damaged")
                self._last = _Stored(time_s, self._num_decoded, frame)
                self._num_decoded += 1
                yield self._last
        except (av.FFmpegError, OSError) as error:
            self._stop(f"damaged after {self._progress()}: {error}", error)
        except _RunsBackwards as error:
            self._stop(str(error), error)

    def _decode(self) -> Iterator[VideoFrame]:
        for packet in self._container.demux(self._stream):
            yield from cast("list[VideoFrame]", packet.decode())
        # With several threads ffmpeg takes a file that was cut for one that ends: ask its index.
        entries = self._stream.index_entries
        promised = max((e.pos + e.size for e in entries), default=0)
        if 0 < self._container.size < promised:
            self._stop(
                f"cut short after {self._progress()}: its index promises {promised} bytes, "
                f"the file has {self._container.size}"
            )

    def _time_s(self, frame: VideoFrame) -> float:
        if frame.pts is not None:
            assert frame.time_base is not None
            return float(frame.pts * self._time_base(frame))
        return 0.0 if self._last is None else self._last.time_s + self._frame_duration_s(self._last)
