"""Clips: short H.264 files from which any window is decoded at once.

No B-frames, a key frame every few frames, the index in front; frame k is shown at k / fps. The same
pictures give the same bytes with the same FFmpeg.

>>> from mint_hub.assets import sample_clip
>>> clip = encode_clip(sample_clip(), 1.0, 2.0, size_hw=64)
>>> decode_window(clip, 10, 16).shape
(16, 64, 86, 3)
"""

import math
import tempfile
from collections.abc import Iterable, Iterator
from fractions import Fraction
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal, Self, cast, overload

import av
import numpy as np
from av.codec.context import Flags
from av.video.frame import VideoFrame
from av.video.reformatter import Interpolation
from numpy.typing import NDArray

from mint_hub.conventions import MODEL_FPS
from mint_hub.loaders.fields import checked_size, require_window
from mint_hub.loaders.video import iter_frames
from mint_hub.loaders.video_reader import VideoReader, tensor
from mint_hub.loaders.video_source import VideoError, VideoSource

if TYPE_CHECKING:
    import torch

GOP: Final = 8
CRF: Final = 23
PRESET: Final = "veryfast"

_BITEXACT: Final = 0x400  # AVFMT_FLAG_BITEXACT: neither version nor date in the file
_BT601, _LIMITED = 6, 1  # how RGB is coded, said in the file so that every player agrees

Images = NDArray[np.uint8]
Size = tuple[int, int] | int | None


# --------------------------------------------------------------------- encode


def encode_clip(
    source: "VideoSource | Images | Iterable[Images]",
    start_s: float | None = None,
    stop_s: float | None = None,
    *,
    fps: float = MODEL_FPS,
    gop: int = GOP,
    size_hw: Size = None,
    crf: int = CRF,
    preset: str = PRESET,
) -> bytes:
    """Encode pictures, or a stretch of a video, as a clip.

    Args:
        source: images (N, H, W, 3) uint8 RGB, a list or iterator of (H, W, 3); or a video as
            `iter_frames` takes it, read at ``fps``.
        start_s: of a video, the first time wanted.
        stop_s: of a video, the time to stop before.
        fps: frames a second of the clip.
        gop: frames from one key frame to the next.
        size_hw: even (height, width), or the shorter side; default: the source's, each side rounded
            down to an even number. Pictures are stretched, never cropped: the field of view stays.
        crf: x264's quality, 0 (best) to 51.
        preset: x264's effort.

    Returns:
        The bytes of the mp4.

    Raises:
        VideoError: a video that cannot be read, or no pictures.
        ValueError: malformed pictures or numbers out of range.

    """
    for name, value, low, high in (("gop", gop, 1, 250), ("crf", crf, 0, 51)):
        if not low <= value <= high:
            raise ValueError(f"{name}: expected {low} to {high}, got {value}")
    if not (math.isfinite(fps) and fps > 0):
        raise ValueError(f"fps: expected frames a second, got {fps}")
    # One thread and no look at later frames: with mbtree the bytes varied now and then.
    steady = "threads=1:mbtree=0:rc-lookahead=0:weightp=0"
    x264 = f"keyint={gop}:min-keyint={gop}:scenecut=0:bframes=0:open-gop=0:{steady}"
    options = {"preset": preset, "crf": str(crf), "x264-params": x264}
    if isinstance(source, np.ndarray | list | tuple | Iterator):
        if start_s is not None or stop_s is not None:
            raise ValueError("start_s, stop_s: expected only with a video, got them with pictures")
        return _encoded(iter(cast("Iterable[Images]", source)), fps, size_hw, options)
    with iter_frames(cast("VideoSource", source), fps, start_s, stop_s) as frames:
        return _encoded((frame.image for frame in frames), fps, size_hw, options)


def clip_size(size_hw: Size, source_hw: tuple[int, int]) -> tuple[int, int]:
    """Return the even (height, width) of a clip; see `encode_clip`."""
    if isinstance(size_hw, tuple | list):
        height, width = checked_size(size_hw)
        if height % 2 or width % 2:
            raise ValueError(f"size_hw: expected even sizes, as H.264 needs, got {size_hw}")
        return height, width
    if size_hw is None:
        height, width = (side // 2 * 2 for side in source_hw)
    else:
        height, width = (2 * round(side * size_hw / min(source_hw) / 2) for side in source_hw)
    if height < 2 or width < 2:
        raise ValueError(f"size_hw: expected at least (2, 2), got {(height, width)}")
    return height, width


def _encoded(images: Iterator[Images], fps: float, size_hw: Size, options: dict[str, str]) -> bytes:
    first = next(images, None)
    if first is None:
        raise VideoError("expected pictures to encode, got none")
    shape = np.shape(first)
    if len(shape) != 3 or shape[2] != 3:
        raise ValueError(f"images: expected (H, W, 3), got shape {shape}")
    height, width = clip_size(size_hw, shape[:2])
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "clip.mp4"  # a real file: putting the index in front rereads it
        with av.open(str(path), "w", options={"movflags": "+faststart"}) as container:
            container.flags |= _BITEXACT
            rate = Fraction(fps).limit_denominator(1001)
            stream = container.add_stream("libx264", rate=rate, options=options)
            stream.height, stream.width, stream.pix_fmt = height, width, "yuv420p"
            stream.codec_context.flags |= Flags.bitexact
            stream.codec_context.thread_count = 1
            stream.codec_context.colorspace = _BT601
            stream.codec_context.color_range = _LIMITED
            for k, image in enumerate(chain([first], images)):
                if image.shape != shape or image.dtype != np.uint8:
                    got = f"{image.dtype} {image.shape}"
                    raise ValueError(f"images: expected uint8 {shape}, got {got} at frame {k}")
                rgb = VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
                yuv = rgb.reformat(width, height, "yuv420p", interpolation=Interpolation.AREA)
                container.mux(stream.encode(yuv))
            container.mux(stream.encode())
        return path.read_bytes()


# --------------------------------------------------------------------- decode


class PackedClip:
    """A clip opened for windows; each is decoded from the key frame before it.

    Args:
        mp4: the member's bytes (any buffer), or a path.

    Attributes:
        num_frames, fps, image_size_hw: of the clip.

    Raises:
        VideoError: not a clip that can be read.

    """

    def __init__(self, mp4: VideoSource) -> None:
        self._reader = VideoReader(mp4, num_threads=1)
        info = self._reader.info
        self.num_frames = info.num_frames or 0
        self.fps, self.image_size_hw = info.fps, info.image_size_hw

    def images(
        self, start: int = 0, length: int | None = None, size_hw: tuple[int, int] | None = None
    ) -> Images:
        """Return frames start .. start + length - 1, (length, H, W, 3) uint8 RGB.

        Raises:
            VideoError: the clip is damaged there.
            ValueError: the frames are not all in the clip.

        """
        length = self.num_frames - start if length is None else length
        require_window(start, length, self.num_frames)
        return self._reader.at((start + np.arange(length)) / self.fps, size_hw).images

    def close(self) -> None:
        """Let go of the bytes."""
        self._reader.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


@overload
def decode_window(
    mp4: VideoSource,
    start: int = 0,
    length: int | None = None,
    size_hw: tuple[int, int] | None = None,
    as_torch: Literal[False] = False,
) -> Images: ...


@overload
def decode_window(
    mp4: VideoSource,
    start: int = 0,
    length: int | None = None,
    size_hw: tuple[int, int] | None = None,
    *,
    as_torch: Literal[True],
) -> "torch.Tensor": ...


def decode_window(
    mp4: VideoSource,
    start: int = 0,
    length: int | None = None,
    size_hw: tuple[int, int] | None = None,
    as_torch: bool = False,
) -> "Images | torch.Tensor":
    """Return frames start .. start + length - 1 of a clip, (length, H, W, 3) uint8 RGB.

    Errors as of `PackedClip`, which is faster for many windows of one clip.
    """
    with PackedClip(mp4) as clip:
        images = clip.images(start, length, size_hw)
    return tensor(images) if as_torch else images
