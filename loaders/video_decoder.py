"""From a container to stored frames, and from a stored frame to the picture a player shows.

The parts that `video` (streams of frames) and `video_reader` (frames at given times) share.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain
from typing import Literal, NamedTuple, cast

import av
import cv2
import numpy as np
from av.container import InputContainer
from av.error import FFmpegError
from av.stream import Disposition
from av.video.frame import VideoFrame
from av.video.reformatter import Interpolation, VideoReformatter
from av.video.stream import VideoStream
from numpy.typing import NDArray

from mint_hub.loaders.video_source import VideoError, reason

OnError = Literal["raise", "stop"]
NumThreads = int | Literal["auto"]

TIE_S = 1e-6
"""Times closer than this are the same time."""


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


class Stored(NamedTuple):
    """A frame as decoded: when it is shown and for how long (0 where unknown), in seconds."""

    time_s: float
    duration_s: float
    number: int
    frame: VideoFrame


class Decoder:
    """Stored frames in order of presentation, and what happens when they stop coming."""

    def __init__(
        self, name: str, container: InputContainer, num_threads: NumThreads, on_error: OnError
    ) -> None:
        self.name = name
        self.container = container
        self.stream = video_stream(container, name)
        self.stream.codec_context.thread_type = "NONE" if num_threads == 1 else "AUTO"
        self.stream.codec_context.thread_count = 0 if num_threads == "auto" else num_threads
        self.warnings: list[str] = []
        self._on_error = on_error
        assert self.stream.time_base is not None
        self._tick_s = self.stream.time_base
        rate = self.stream.average_rate or self.stream.guessed_rate
        self._usual_duration_s = float(1 / rate) if rate else 0.0

    def stored(self) -> Iterator[Stored]:
        """Decode from where the container stands."""
        index, last_s = 0, -math.inf
        try:
            for packet in self.container.demux(self.stream):
                for frame in packet.decode():
                    stored = self._timed(frame, index, last_s)
                    if stored.time_s < last_s - TIE_S:
                        raise VideoError(
                            f"its times run backwards, from {last_s:.3f} s to {stored.time_s:.3f} s"
                        )
                    if stored.time_s <= last_s + TIE_S:
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
        self, start_s: float, first: Stored, stored: Iterator[Stored]
    ) -> Iterator[Stored]:
        """Decode from a key frame at or before ``start_s``, or from the first frame."""
        stored = chain([first], stored)
        for margin_s in (1.0, 10.0):
            if start_s - margin_s <= first.time_s:
                break
            self.container.seek(int((start_s - margin_s) / self._tick_s), stream=self.stream)
            sought = self.stored()
            for begin in sought:
                if begin.time_s > start_s:
                    break
                if begin.frame.key_frame:
                    return chain([begin], sought)
            self.container.seek(int(first.time_s / self._tick_s), stream=self.stream)
            stored = self.stored()
        return stored

    def sought(self, start_s: float, first_s: float) -> Iterator[Stored] | None:
        """Decode from the last key frame at or before ``start_s``, from wherever the file stands.

        Files tell where key frames are by decoding time, which may be earlier than when they show,
        and streams do not tell at all: where an attempt lands too late or between key frames, the
        next one looks further back. None when even the first frame, at ``first_s``, is out of reach
        (as in a transport stream): the file has to be opened again.
        """
        for margin_s in (0.0, 1.0, 10.0, math.inf):
            target_s = max(start_s - margin_s, first_s)
            self.container.seek(int(target_s / self._tick_s), stream=self.stream)
            sought = self.stored()
            for begin in sought:
                if begin.time_s > max(start_s, first_s) + TIE_S:
                    break
                if begin.frame.key_frame:
                    return chain([begin], sought)
            if target_s == first_s:
                break
        return None

    def key_time_s(self, time_s: float) -> float | None:
        """Decoding time of the last key frame at or before ``time_s``; None where nobody knows."""
        entries = self.stream.index_entries
        place = entries.search_timestamp(int(time_s / self._tick_s), backward=True)
        return float(entries[place].timestamp * self._tick_s) if place >= 0 else None

    def _timed(self, frame: VideoFrame, index: int, last_s: float) -> Stored:
        if frame.pts is not None:
            time_s = float(frame.pts * self._tick_s)
        else:
            time_s = last_s + self._usual_duration_s if index else 0.0
        duration_s = float(frame.duration * self._tick_s) or self._usual_duration_s
        return Stored(time_s, duration_s, index, frame)

    def _check_complete(self) -> None:
        """Several decoding threads take a file that was cut for one that ends: ask its index."""
        promised = max((entry.pos + entry.size for entry in self.stream.index_entries), default=0)
        if 0 < self.container.size < promised:
            raise VideoError(
                f"cut short: its index tells of {promised} bytes, there are {self.container.size}"
            )


class Picture:
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

    def rgb(self, frame: VideoFrame, size_hw: tuple[int, int] | None = None) -> NDArray[np.uint8]:
        """Return the picture (H, W, 3), resampled to ``size_hw`` where given (area or bicubic)."""
        height, width = self._stored_hw
        if size_hw is None or size_hw == self.image_size_hw:
            rgb = self._reformatter.reformat(frame, width, height, "rgb24")
        else:
            shrinks = size_hw[0] <= self.image_size_hw[0] and size_hw[1] <= self.image_size_hw[1]
            how = Interpolation.AREA if shrinks else Interpolation.BICUBIC
            height, width = size_hw[::-1] if self._swap else size_hw
            rgb = self._reformatter.reformat(frame, width, height, "rgb24", interpolation=how)
        image = cast("NDArray[np.uint8]", rgb.to_ndarray())
        if self._swap:
            image = cv2.transpose(image)
        if self._flip is not None:
            image = cv2.flip(image, self._flip)
        return cast("NDArray[np.uint8]", image)


def describe(
    name: str, container: InputContainer, stream: VideoStream, first: Stored, picture: Picture
) -> VideoInfo:
    """Gather what container, stream and first frame tell."""
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


def video_stream(container: InputContainer, name: str) -> VideoStream:
    """Return the first stream of moving pictures; VideoError where there is none."""
    for stream in container.streams.video:
        if not stream.disposition & Disposition.attached_pic:
            return stream
    held = [f"{stream.type} ({stream.codec_context.name})" for stream in container.streams]
    raise VideoError(f"{name}: no video stream; it holds {', '.join(held) or 'nothing'}")
