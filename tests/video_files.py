"""Small videos made when a test asks: each returns its path; content says which frame it is.

Frame i is a flat grey of ``grey(i)`` with a red block in the upper left and a blue one in the lower
right corner, so that a decoded frame tells its number and which way up it is.
"""

from collections.abc import Callable
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
from av.video.stream import VideoStream

RED, BLUE = (255, 0, 0), (0, 0, 255)


def grey(i: int) -> int:
    return 30 + 7 * (i % 30)


def frame_number(image: np.ndarray) -> int:
    """Read which frame (modulo 30) a decoded picture shows."""
    height, width = image.shape[:2]
    middle = image[2 * height // 5 : 3 * height // 5, 2 * width // 5 : 3 * width // 5]
    return round((float(np.median(middle)) - 30) / 7) % 30


def picture(i: int, size_hw: tuple[int, int]) -> np.ndarray:
    height, width = size_hw
    image = np.full((height, width, 3), grey(i), np.uint8)
    image[: height // 4, : width // 4] = RED
    image[-(height // 4) :, -(width // 4) :] = BLUE
    return image


def video(
    path: Path,
    num_frames: int = 30,
    size_hw: tuple[int, int] = (48, 64),
    rate: int = 30,
    *,
    codec: str = "libx264",
    pix_fmt: str = "yuv420p",
    times_ms: list[int] | None = None,
    options: dict[str, str] | None = None,
    container_options: dict[str, str] | None = None,
    prepare: Callable[[VideoStream], None] | None = None,
    gop: int = 10,
) -> Path:
    """Write a video, at a constant rate or with the given presentation times (milliseconds).

    Without x264's macroblock tree, which now and then gives other bytes for the same pictures.
    """
    steady = {"x264-params": "mbtree=0"} if codec == "libx264" else {}
    with av.open(str(path), "w", options=container_options or {}) as container:
        stream = container.add_stream(codec, rate=rate, options={**steady, **(options or {})})
        stream.height, stream.width = size_hw
        stream.pix_fmt = pix_fmt
        stream.codec_context.gop_size = gop
        if times_ms is not None:
            stream.time_base = stream.codec_context.time_base = Fraction(1, 1000)
        if prepare is not None:
            prepare(stream)
        for i in range(num_frames):
            frame = av.VideoFrame.from_ndarray(picture(i, size_hw), format="rgb24")
            if times_ms is not None:
                frame.pts, frame.time_base = times_ms[i], Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


def vfr(path: Path, times_ms: list[int]) -> Path:
    return video(path, len(times_ms), times_ms=times_ms, options={"bf": "0"})


def rotated(path: Path, degrees: int, *, hflip: bool = False, num_frames: int = 6) -> Path:
    """Write a phone's video: stored sideways, with a display matrix (counter-clockwise degrees)."""

    def prepare(stream: VideoStream) -> None:
        stream.set_display_rotation(degrees, hflip=hflip)

    return video(path, num_frames, prepare=prepare)


def wide_pixels(path: Path, aspect: Fraction) -> Path:
    def prepare(stream: VideoStream) -> None:
        stream.codec_context.sample_aspect_ratio = aspect

    return video(path, 6, prepare=prepare)


def b_frames(path: Path) -> Path:
    """Write B-frames: decoding times start below zero, presentation times at zero."""
    return video(path, options={"bf": "3", "b-adapt": "0"})


def late_start(path: Path, first_ms: int) -> Path:
    """Write a video whose clock does not start at zero (.ts and .mkv keep it, .mp4 does not)."""
    return video(path, times_ms=[first_ms + round(i * 1000 / 30) for i in range(30)])


def deep_colour(path: Path) -> Path:
    return video(path, 6, codec="libx264", pix_fmt="yuv444p10le", options={"crf": "1"})


def audio_only(path: Path) -> Path:
    with av.open(str(path), "w") as container:
        stream = container.add_stream("aac", rate=16000, layout="mono")
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), "fltp", "mono")
        frame.sample_rate = 16000
        container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


def no_frames(path: Path) -> Path:
    """Write a matroska file with audio and a video stream into which no picture was ever put."""
    with av.open(str(path), "w") as container:
        silent = container.add_stream("libx264", rate=30)
        silent.height, silent.width, silent.pix_fmt = 48, 64, "yuv420p"
        stream = container.add_stream("aac", rate=16000, layout="mono")
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), "fltp", "mono")
        frame.sample_rate = 16000
        container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


def cut_without_index(path: Path) -> Path:
    """Write an mp4 whose end, where its index is, got lost."""
    data = video(path).read_bytes()
    path.write_bytes(data[: len(data) // 2])
    return path


def cut_with_index(path: Path) -> Path:
    """Write an mp4 whose end got lost but whose index is at the front."""
    data = video(path, 60, container_options={"movflags": "faststart"}).read_bytes()
    path.write_bytes(data[: len(data) * 2 // 3])
    return path


def damaged(path: Path, frame: int = 30) -> Path:
    """Write an mp4 of 60 frames in which the packet of one frame is zeroed."""
    video(path, 60, options={"bf": "0"})
    with av.open(str(path)) as container:
        entry = container.streams.video[0].index_entries[frame]
        start, stop = entry.pos, entry.pos + entry.size
    data = bytearray(path.read_bytes())
    data[start:stop] = bytes(stop - start)
    path.write_bytes(data)
    return path
