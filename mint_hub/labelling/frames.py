"""Frames of a clip, streamed or picked."""

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from mint_hub.labelling.records import Clip
from mint_hub.labelling.stage import StageError
from mint_hub.loaders.video import iter_frames, probe
from mint_hub.loaders.video_reader import VideoReader

UInt8 = NDArray[np.uint8]


def clip_frames(clip: Clip, start: int = 0, stop: int | None = None) -> Iterator[UInt8]:
    """Stream frames ``start`` .. ``stop - 1`` of a clip, (H, W, 3) uint8 RGB, in order.

    Raises:
        StageError: the file holds fewer frames than the clip, or frames of another size.
        VideoError: the file is missing or damaged.
        ValueError: not 0 <= start < stop <= number of frames.

    """
    stop = clip.num_frames if stop is None else stop
    _check_range(clip, start, stop)
    return _stream(clip, start, stop)


def clip_pictures(clip: Clip, frames: Sequence[int]) -> UInt8:
    """Return the given frames of a clip, (N, H, W, 3) uint8 RGB; ``frames`` do not decrease.

    Raises:
        StageError, VideoError: as of `clip_frames`.
        ValueError: no frames, frames in another order, or frames that the clip does not have.

    """
    wanted = [int(frame) for frame in frames]
    if not wanted or wanted != sorted(wanted):
        raise ValueError(f"frames: expected some in order, got {wanted}")
    _check_range(clip, wanted[0], wanted[-1] + 1)
    with VideoReader(clip.video) as reader:
        _check_size(clip, reader.info.image_size_hw)
        numbers = np.array(wanted) + clip.first_frame
        times = reader.info.start_time_s + numbers / clip.fps
        images, got = reader.at(times)
    late = int(np.abs(got - times).argmax())
    if abs(got[late] - times[late]) > 0.5 / clip.fps:
        raise StageError(
            f"{clip.video}: expected a frame at {times[late]:.3f} s for frame {wanted[late]} of "
            f"clip {clip.key}, got one of {got[late]:.3f} s"
        )
    return images


def _stream(clip: Clip, start: int, stop: int) -> Iterator[UInt8]:
    info = probe(clip.video)
    _check_size(clip, info.image_size_hw)
    half = 0.5 / clip.fps
    first_s = info.start_time_s + (clip.first_frame + start) / clip.fps
    last_s = info.start_time_s + (clip.first_frame + stop - 1) / clip.fps
    came = 0
    with iter_frames(clip.video, None, first_s - half, last_s + half) as frames:
        for frame in frames:
            yield frame.image
            came += 1
    if came != stop - start:
        raise StageError(
            f"{clip.video}: expected {stop - start} frames at {clip.fps:g} frames/s from "
            f"{first_s:.3f} s for clip {clip.key}, got {came}"
        )


def _check_range(clip: Clip, start: int, stop: int) -> None:
    if not 0 <= start < stop <= clip.num_frames:
        raise ValueError(
            f"frames of clip {clip.key}: expected 0 <= start < stop <= {clip.num_frames}, got "
            f"{start} and {stop}"
        )


def _check_size(clip: Clip, size_hw: tuple[int, int]) -> None:
    if size_hw != tuple(clip.image_size_hw):
        raise StageError(
            f"{clip.video}: expected frames of {clip.image_size_hw} (height, width) as clip "
            f"{clip.key} says, got {size_hw}"
        )
