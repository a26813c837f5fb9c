"""One way in for every kind of video: a file or URL to decode, or frames already in memory."""

from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray

from mint_hub.conventions import MODEL_FPS
from mint_hub.loaders.video import Frame, OnError, VideoFrames, VideoSource, iter_frames
from mint_hub.model.frames_mint import is_decoded, rgb_uint8

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
        if is_decoded(video):
            return cls._from_arrays(rgb_uint8(video), MODEL_FPS if fps is None else fps)
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
