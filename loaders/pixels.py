"""Pictures of an episode's frames by number, from packed clips or from the user's own videos."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mint_hub.loaders.attach import VideoAttachment
from mint_hub.loaders.packing import packed_images
from mint_hub.loaders.reader import CorpusReader
from mint_hub.loaders.resolvers import Videos

Pixels = Callable[[CorpusReader, int, int, int], NDArray[np.uint8]]
"""From (reader, episode, first frame, length) to pictures (length, H, W, 3) uint8 RGB."""


@dataclass(frozen=True)
class PackedPixels:
    """Pictures from the clips of a packed config (``mint-hub pack``).

    Attributes:
        size_hw: (height, width) of the pictures; None: each clip's own.

    """

    size_hw: tuple[int, int] | None = None

    def __call__(self, reader: CorpusReader, i: int, start: int, length: int) -> NDArray[np.uint8]:
        """Return frames of an episode, (length, H, W, 3); errors as of ``packed_images``."""
        return packed_images(reader, i, start, length, self.size_hw)


@dataclass(frozen=True)
class AttachedPixels:
    """Pictures from the user's own videos; travels to workers where ``videos`` does.

    Attributes:
        videos: where they are: see ``resolvers.resolve``.
        size_hw: (height, width) of the pictures; None: the episode's.
        options: what ``VideoAttachment`` takes beside, such as ``lens``.

    """

    videos: Videos
    size_hw: tuple[int, int] | None = None
    options: dict[str, Any] = field(default_factory=dict[str, Any])

    def __call__(self, reader: CorpusReader, i: int, start: int, length: int) -> NDArray[np.uint8]:
        """Return frames of an episode, (length, H, W, 3); errors as of ``VideoAttachment``."""
        video = VideoAttachment(reader[i], self.videos, **self.options)
        return video.window(start, length, self.size_hw).images


def pictures(
    reader: CorpusReader,
    pixels: Pixels,
    episode: NDArray[np.int64],
    frame: NDArray[np.int64],
    offsets: NDArray[np.int64],
) -> NDArray[np.uint8]:
    """Return pictures (B, N, 3, H, W) uint8 RGB of the frames about some frames.

    Args:
        reader: whose episodes they are.
        pixels: where pictures are from.
        episode: (B,) numbers of episodes.
        frame: (B,) frames in them.
        offsets: (N,) which are shown, counted from each of these; outside the episode, its first or
            last.

    Raises:
        ValueError: pictures of different sizes. What ``pixels`` raises is raised.

    """
    shown = frame[:, None] + offsets
    shown = shown.clip(0, reader.num_frames[episode][:, None] - 1)
    made: list[NDArray[np.uint8]] = []
    for i, frames in zip(episode.tolist(), shown, strict=True):
        start, stop = int(frames.min()), int(frames.max()) + 1
        images = pixels(reader, i, start, stop - start)
        made.append(images[frames - start].transpose(0, 3, 1, 2))
    if len(sizes := {images.shape[2:] for images in made}) > 1:
        raise ValueError(
            f"pixels: expected pictures of one size in a batch, got (height, width) "
            f"{sorted(sizes)}: give size_hw"
        )
    return np.stack(made) if made else np.empty((0, len(offsets), 3, 1, 1), np.uint8)
