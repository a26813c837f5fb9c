"""One way in for every kind of video: a file or URL to decode, or frames already in memory."""

from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, Self

import numpy as np
import torch
from numpy.typing import NDArray

from mint_hub.conventions import MODEL_FPS
from mint_hub.loaders.video import Frame, VideoFrames, VideoSource, iter_frames

OnError = Literal["raise", "stop"]
ArrayVideo = NDArray[Any] | torch.Tensor | Sequence[Any]
Video = VideoSource | ArrayVideo
"""A path, URL, bytes or binary file; or frames: (T, H, W, 3), a (T, 3, H, W) tensor, or a list."""


@dataclass
class VideoInput(AbstractContextManager["VideoInput"]):
    """Frames of a video, streamed, and what is known about it from the start.

    Attributes:
        name: where it came from, for messages and the episode's key.
        image_size_hw: (height, width) of every frame.
        fps: frames a second that come out.
        num_frames: how many are expected, or None; an estimate.
        frames: iterator of `Frame`.
        warnings: what was forgiven while decoding; complete at the end.

    """

    name: str
    image_size_hw: tuple[int, int]
    fps: float
    num_frames: int | None
    frames: Iterator[Frame]
    warnings: list[str] = field(default_factory=list[str])

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if isinstance(self.frames, VideoFrames):
            self.frames.close()

    @classmethod
    def open(cls, video: Video, fps: float | None = MODEL_FPS, on_error: OnError = "raise") -> Self:
        """Open a video.

        Args:
            video: see `Video`.
            fps: rate to resample files to, or None for their own timing. Frames in memory carry no
                times: they are taken to be at this rate (30 when None).

        Raises:
            VideoError: a file that cannot be read, naming it.
            ValueError: frames of the wrong shape or type.

        """
        if is_array_video(video):
            return cls._from_arrays(as_frames(video), fps or MODEL_FPS)
        frames = iter_frames(video, fps, on_error=on_error)  # pyright: ignore[reportArgumentType]
        info = frames.info
        count = info.num_frames
        if fps is not None and info.duration_s is not None:
            count = max(1, round(info.duration_s * fps))
        return cls(
            name=info.source,
            image_size_hw=info.image_size_hw,
            fps=fps or info.fps or MODEL_FPS,
            num_frames=count,
            frames=frames,
            warnings=frames.warnings,
        )

    @classmethod
    def _from_arrays(cls, images: NDArray[np.uint8], fps: float) -> Self:
        frames = (Frame(k, k / fps, k / fps, k, image) for k, image in enumerate(images))
        size = (images.shape[1], images.shape[2])
        return cls("<frames in memory>", size, fps, len(images), frames)


def is_array_video(video: object) -> bool:
    """Whether this is frames in memory: an array, a tensor, or a list of pictures (H, W, 3)."""
    if isinstance(video, np.ndarray | torch.Tensor):
        return True
    return isinstance(video, list | tuple) and len(video) > 0 and _is_picture(video[0])  # pyright: ignore


def as_frames(video: Any) -> NDArray[np.uint8]:
    """Frames in memory as (T, H, W, 3) uint8 RGB.

    Integers are taken as 0..255, floats as 0..1. Tensors may have the channels second.

    Raises:
        ValueError: another shape or type, or floats outside 0..1.

    """
    if isinstance(video, list | tuple):
        pictures = [np.asarray(picture) for picture in video]  # pyright: ignore
        if len({picture.shape for picture in pictures}) > 1:
            shapes = sorted({picture.shape for picture in pictures})
            raise ValueError(f"video: expected frames of one size, got {shapes}")
        array = np.stack(pictures)
    else:
        array = video.detach().cpu().numpy() if isinstance(video, torch.Tensor) else video
    if array.ndim == 4 and array.shape[-1] != 3 and array.shape[1] == 3:
        array = np.moveaxis(array, 1, -1)
    if array.ndim != 4 or array.shape[-1] != 3 or 0 in array.shape:
        raise ValueError(
            f"video: expected frames (T, H, W, 3) with T, H, W > 0, got shape {array.shape}"
        )
    if array.dtype == np.uint8:
        return array
    if not np.issubdtype(array.dtype, np.floating):
        raise ValueError(f"video: expected uint8, or floats in 0..1, got {array.dtype}")
    if not (np.isfinite(array).all() and array.min() >= 0 and array.max() <= 1):
        raise ValueError(f"video: expected floats in 0..1, got {array.min():g}..{array.max():g}")
    return np.round(array * 255).astype(np.uint8)


def key_from_name(name: str) -> str:
    """An episode key from where a video came from: [a-z0-9_-] only, never empty.

    >>> key_from_name("Videos/P01 (take 2).MP4")
    'p01_take_2'
    """
    stem = Path(name.rstrip("/").rsplit("/", 1)[-1]).stem if "<" not in name else "video"
    cleaned = "".join(
        c if c.isascii() and (c.isalnum() or c in "_-") else " " for c in stem.lower()
    )
    return "_".join(cleaned.split()) or "video"


def _is_picture(item: Any) -> bool:
    if isinstance(item, np.ndarray | torch.Tensor):
        return item.ndim == 3
    return hasattr(item, "getbands") and hasattr(item, "size")  # a Pillow image, if Pillow is there
