"""Videos already in memory, in all their forms, as one: tensors of frames, channels first.

Shape letters: T frames, C channels, H x W a picture's size.
"""

from collections.abc import Mapping
from os import PathLike
from typing import Any

import numpy as np
import torch
from transformers.image_utils import ChannelDimension

_TIE = 1e-6


def is_encoded(video: Any) -> bool:
    """Whether this is a video to decode: a path, URL, bytes, file object or a dataset cell."""
    kinds = str | PathLike | bytes | bytearray | memoryview | Mapping
    return isinstance(video, kinds) or (hasattr(video, "read") and hasattr(video, "seek"))


def is_pillow(frame: Any) -> bool:
    """Whether this is a Pillow image, without importing Pillow."""
    return hasattr(frame, "getbands") and hasattr(frame, "convert")


def is_array(value: Any) -> bool:
    """Whether this is a numpy array or a torch tensor."""
    return isinstance(value, np.ndarray | torch.Tensor)


def is_decoded(video: Any) -> bool:
    """Whether this is frames in memory: an array, a tensor, or a list of pictures."""
    if is_array(video):
        return True
    return isinstance(video, list | tuple) and len(video) > 0 and _is_picture(video[0])


def _is_picture(item: Any) -> bool:
    return is_pillow(item) or (is_array(item) and item.ndim < 4)


def as_tensor(array: np.ndarray) -> torch.Tensor:
    """Share a NumPy array's memory where torch can (not with negative strides or read-only)."""
    usable = array.flags.writeable and min(array.strides, default=0) >= 0
    return torch.from_numpy(array if usable else array.copy())


def _frame(frame: Any, number: int, shape: tuple[int, ...] | None) -> torch.Tensor:
    if is_pillow(frame):
        frame = np.array(frame if frame.mode in ("L", "RGB", "RGBA") else frame.convert("RGB"))
        frame = frame[..., None] if frame.ndim == 2 else frame
    frame = as_tensor(frame) if isinstance(frame, np.ndarray) else frame
    if not isinstance(frame, torch.Tensor) or frame.ndim != 3:
        found = tuple(frame.shape) if isinstance(frame, torch.Tensor) else type(frame).__name__
        raise ValueError(f"frame {number}: expected (H, W, C) or (C, H, W), got {found}")
    if shape is not None and frame.shape != shape:
        raise ValueError(
            f"frame {number}: expected {tuple(shape)} as before, got {tuple(frame.shape)}"
        )
    return frame


def channels_first(video: Any, layout: str | ChannelDimension | None) -> torch.Tensor:
    """Any decoded video -> (T, C, H, W), uint8 or floating point."""
    prefer_last = isinstance(video, np.ndarray)
    if isinstance(video, list | tuple):
        prefer_last = not isinstance(video[0], torch.Tensor)
        frames: list[torch.Tensor] = []
        for number, frame in enumerate(video):
            frames.append(_frame(frame, number, frames[0].shape if frames else None))
        video = torch.stack(frames)
    video = as_tensor(video) if isinstance(video, np.ndarray) else video
    if video.ndim != 4:
        raise ValueError(f"videos: expected (T, H, W, C) or (T, C, H, W), got {tuple(video.shape)}")
    if len(video) == 0:
        raise ValueError(f"videos: expected at least one frame, got shape {tuple(video.shape)}")
    first, last = (video.shape[axis] in (1, 3, 4) for axis in (1, 3))
    if layout is not None:
        use_last = ChannelDimension(layout) == ChannelDimension.LAST
    elif first or last:
        use_last = last and (prefer_last or not first)
    else:
        raise ValueError(f"videos: expected (T, H, W, 3) or (T, 3, H, W), got {tuple(video.shape)}")
    video = video.permute(0, 3, 1, 2) if use_last else video
    if video.is_floating_point() or video.dtype == torch.uint8:
        return video
    wide = video.to(torch.int64)  # some unsigned types know no minimum
    low, high = int(wide.min()), int(wide.max())
    if video.dtype == torch.bool or low < 0 or high > 255:
        raise ValueError(f"videos: expected 0..255, got {low}..{high} as {video.dtype}")
    return wide.to(torch.uint8)


def check_unit_range(frames: torch.Tensor) -> None:
    """Raise ValueError unless floating point frames lie in [0, 1]."""
    low, high = float(frames.min()), float(frames.max())
    if not (low >= -_TIE and high <= 1 + _TIE):  # also refuses nan
        raise ValueError(
            f"videos: expected floating point frames in [0, 1], got [{low:g}, {high:g}]; "
            "give uint8, or do_rescale=False to take them as they are"
        )


def to_rgb(video: torch.Tensor) -> torch.Tensor:
    """(T, C, H, W) -> (T, 3, H, W): grey is repeated, transparency is laid over white."""
    if video.shape[1] == 1:
        return video.expand(-1, 3, -1, -1)
    if video.shape[1] == 4:
        white = 1.0 if video.is_floating_point() else 255.0
        colour, alpha = video[:, :3].float(), video[:, 3:].float() / white
        blended = white + (colour - white) * alpha
        return blended if video.is_floating_point() else blended.round().to(video.dtype)
    return video


def rgb_uint8(video: Any) -> np.ndarray:
    """Any video in memory as (T, H, W, 3) uint8 RGB.

    Raises:
        ValueError: a wrong shape or type, frames of several sizes, or floats outside [0, 1].

    """
    frames = to_rgb(channels_first(video, None))
    if frames.is_floating_point():
        check_unit_range(frames)
        frames = (frames * 255).round().to(torch.uint8)
    return frames.permute(0, 2, 3, 1).cpu().numpy()
