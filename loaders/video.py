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
from itertools import chain
from typing import Literal, NamedTuple, Self, cast

import av
import cv2
import numpy as np
from av.container import InputContainer
from av.error import FFmpegError
from av.stream import Disposition
from av.video.frame import VideoFrame
from av.video.reformatter import VideoReformatter
from av.video.stream import VideoStream
from numpy.typing import NDArray

from mint_hub.conventions import MODEL_FPS
from mint_hub.loaders.video_source import (
    VideoError,
    VideoNotFoundError,
    VideoSource,
    open_video,
    reason,
)

__all__ = [
    "Frame",
    "VideoError",
    "VideoFrames",
    "VideoInfo",
    "VideoNotFoundError",
    "VideoSource",
    "iter_frames",
    "probe",
]

OnError = Literal["raise", "stop"]
NumThreads = int | Literal["auto"]

_TIE_S = 1e-6


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


class _Stored(NamedTuple):
    """A frame as decoded: when it is shown and for how long (0 where unknown), in seconds."""

    time_s: float
    duration_s: float
    number: int
    frame: VideoFrame


_Pick = tuple[float, _Stored]


class _Decoder:
    """Stored frames in order of presentation, and what happens when they stop coming."""

    def __init__(
        self, name: str, container: InputContainer, num_threads: NumThreads, on_error: OnError
    ) -> None:
        self.name = name
        self.container = container
        self.stream = _video_stream(container, name)
        self.stream.codec_context.thread_type = "NONE" if num_threads == 1 else "AUTO"
        self.stream.codec_context.thread_count = 0 if num_threads == "auto" else num_threads
        self.warnings: list[str] = []
        self._on_error = on_error
        assert self.stream.time_base is not None
        self._tick_s = self.stream.time_base
        rate = self.stream.average_rate or self.stream.guessed_rate
        self._usual_duration_s = float(1 / rate) if rate else 0.0

    def stored(self) -> Iterator[_Stored]:
        """Decode from where the container stands."""
        index, last_s = 0, -math.inf
        try:
            for packet in self.container.demux(self.stream):
                for frame in packet.decode():
                    stored = self._timed(frame, index, last_s)
                    if stored.time_s < last_s - _TIE_S:
                        raise VideoError(
                            f"its times run backwards, from {last_s:.3f} s to {stored.time_s:.3f} s"
                        )
                    if stored.time_s <= last_s + _TIE_S:
                        self.warnings.append(f"{self.name}: two frames at {last_s:.3f} s, one kept")
                        continue
                    yield stored
                    index, last_s = index + 1, stored.time_s
            self._check_complete()
        except (FFmpegError, OSError, VideoError) as error:
            where = f"frame {index}, after {last_s:.3f} s" if index else "the first frame"
            message = f"{self.name}: damaged at {where}: {reason(error)}"
            if self._on_error == "raise":
                raise VideoError(message) from error
            self.warnings.append(message)

    def stored_from(
        self, start_s: float, first: _Stored, stored: Iterator[_Stored]
    ) -> Iterator[_Stored]:
        """Decode from a key frame at or before ``start_s``, or from the first frame."""
        stored = chain([first], stored)
        for margin_s in (1.0, 10.0):
            if start_s - margin_s <= first.time_s:
                break
            self.container.seek(int((start_s - margin_s) / self._tick_s), stream=self.stream)
            sought = self.stored()
            begin = next(sought, None)
            if begin is not None and begin.time_s <= start_s:
                return chain([begin], sought)
            self.container.seek(int(first.time_s / self._tick_s), stream=self.stream)
            stored = self.stored()
        return stored

    def _timed(self, frame: VideoFrame, index: int, last_s: float) -> _Stored:
        if frame.pts is not None:
            time_s = float(frame.pts * self._tick_s)
        else:
            time_s = last_s + self._usual_duration_s if index else 0.0
        duration_s = float(frame.duration * self._tick_s) or self._usual_duration_s
        return _Stored(time_s, duration_s, index, frame)

    def _check_complete(self) -> None:
        """Several decoding threads take a file that was cut for one that ends: ask its index."""
        promised = max((entry.pos + entry.size for entry in self.stream.index_entries), default=0)
        if 0 < self.container.size < promised:
            raise VideoError(
                f"cut short: its index tells of {promised} bytes, there are {self.container.size}"
            )


class _Picture:
    """Stored frame to shown picture: RGB, square pixels, upright.

    The display matrix takes a stored pixel (x, y) to (a x + c y, b x + d y), so a picture is at
    most transposed and then flipped; other angles than quarter turns are taken as the nearest.
    """

    def __init__(self, first: VideoFrame, stream: VideoStream) -> None:
        a, b, c, d = 1, 0, 0, 1
        side_data = first.side_data.get("DISPLAYMATRIX")
        if side_data is not None:
            a, b, _, c, d, *_ = np.frombuffer(bytes(side_data), np.int32).tolist()
        self._swap = abs(b) + abs(c) > abs(a) + abs(d)
        flip_rows, flip_columns = (b < 0, c < 0) if self._swap else (d < 0, a < 0)
        self.straight = (a == d == 0) if self._swap else (b == c == 0)
        self.mirrored = self._swap ^ flip_rows ^ flip_columns
        quarter = 90 + 180 * flip_columns if self._swap else 180 * flip_rows
        self.rotation_deg = int(quarter)
        # cv2.flip's code: 0 flips rows, 1 columns, -1 both.
        flips = {(True, False): 0, (False, True): 1, (True, True): -1}
        self._flip = flips.get((flip_rows, flip_columns))
        self.pixel_aspect = float(stream.sample_aspect_ratio or 1)
        self._stored_hw = first.height, max(1, round(first.width * self.pixel_aspect))
        height, width = self._stored_hw
        self.image_size_hw = (width, height) if self._swap else (height, width)
        self._reformatter = VideoReformatter()

    def rgb(self, frame: VideoFrame) -> NDArray[np.uint8]:
        height, width = self._stored_hw
        rgb = self._reformatter.reformat(frame, width, height, "rgb24")
        image = cast("NDArray[np.uint8]", rgb.to_ndarray())
        if self._swap:
            image = cv2.transpose(image)
        if self._flip is not None:
            image = cv2.flip(image, self._flip)
        return cast("NDArray[np.uint8]", image)


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
            decoder = _Decoder(name, container, num_threads, on_error)
            self.warnings = decoder.warnings
            stored = decoder.stored()
            first = next(stored, None)
            if first is None:
                cause = f": {self.warnings[0]}" if self.warnings else ""
                raise VideoError(f"{name}: its video stream holds no frames{cause}")
            picture = _Picture(first.frame, decoder.stream)
            if not picture.straight:
                self.warnings.append(
                    f"{name}: its turn of {first.frame.rotation} degrees was taken as "
                    f"{picture.rotation_deg}"
                )
            self.info = _describe(name, container, decoder.stream, first, picture)
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
        picture: _Picture,
        start_s: float | None,
        stop_s: float | None,
    ) -> Iterator[Frame]:
        shown, image, index = -1, np.empty((0, 0, 3), np.uint8), 0
        for time_s, stored in picks:
            if stop_s is not None and time_s > stop_s - _TIE_S:
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


def _native(stored: Iterator[_Stored], t0: float) -> Iterator[_Pick]:
    """Pick every stored frame from t0 on, at its own time."""
    return ((item.time_s, item) for item in stored if item.time_s > t0 - _TIE_S)


def _grid(stored: Iterator[_Stored], t0: float, fps: float) -> Iterator[_Pick]:
    """Pick the stored frame nearest to each t0 + k / fps, until the last one's time is over."""
    index, previous, duration_s = 0, None, 0.0
    for current in stored:
        if previous is not None:
            middle = (previous.time_s + current.time_s) / 2 + _TIE_S
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
    end_s -= min(1 / fps, duration_s) / 2 + _TIE_S
    while t0 + index / fps < end_s:
        yield t0 + index / fps, previous
        index += 1


def _describe(
    name: str, container: InputContainer, stream: VideoStream, first: _Stored, picture: _Picture
) -> VideoInfo:
    rate = float(stream.average_rate or stream.guessed_rate or 0)
    duration_s: float | None = None
    if stream.duration is not None and stream.time_base is not None:
        duration_s = float(stream.duration * stream.time_base)
    elif container.duration is not None:
        duration_s = container.duration / av.time_base
    return VideoInfo(
        source=name,
        image_size_hw=picture.image_size_hw,
        fps=rate,
        duration_s=duration_s,
        num_frames=stream.frames or (round(duration_s * rate) if duration_s and rate else None),
        rotation_deg=picture.rotation_deg,
        mirrored=picture.mirrored,
        sample_aspect_ratio=picture.pixel_aspect,
        codec=stream.codec_context.name,
        start_time_s=first.time_s,
    )


def _video_stream(container: InputContainer, name: str) -> VideoStream:
    for stream in container.streams.video:
        if not stream.disposition & Disposition.attached_pic:
            return stream
    held = [f"{stream.type} ({stream.codec_context.name})" for stream in container.streams]
    raise VideoError(f"{name}: no video stream; it holds {', '.join(held) or 'nothing'}")


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
