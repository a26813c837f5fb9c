"""Pictures for an episode, from the user's own copy of its video.

A frame of the episode shows the stored frame nearest in presentation time. Which file that is, and
whether it is the video that was labelled, is checked before a picture comes out. What is known of
the video is in the episode's ``meta``, where the converters put what their sources tell:
``native_fps``, ``video_start_sec``, ``video_duration_s``, ``undistorted``, ``lens`` and
``image_turn_clockwise_deg``; see `resolvers.VideoReference`.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Literal, overload

import cv2
import numpy as np
from numpy.typing import NDArray

from mint_hub.conventions import MODEL_FPS
from mint_hub.geometry.lenses import PinholeLens, Rectification, lens_from, rectification
from mint_hub.loaders.fields import checked_size, require_window
from mint_hub.loaders.resolvers import VideoReference, Videos, resolve
from mint_hub.loaders.schema import Episode
from mint_hub.loaders.video_decoder import VideoInfo
from mint_hub.loaders.video_reader import DecoderCache, shared_decoders, tensor
from mint_hub.loaders.video_source import VideoError

if TYPE_CHECKING:
    import torch

Check = Literal["duration", "size", "fps", "lens"]

CHECKS: Final[tuple[Check, ...]] = ("duration", "size", "fps", "lens")

ASPECT_TOLERANCE = 0.01
"""Relative difference of aspect ratios up to which a video was only resized, not cropped."""

FPS_TOLERANCE = 0.005
"""Relative: 29.97 is 30, and 59.94 is 60, but not 50. Matching is by time, so nothing drifts."""

DURATION_TOLERANCE_S = 0.5
"""Between what the labels say of the whole video and what the file says."""

_GIVE_LENS = "give lens=, or lens=None if the file is undistorted"
_SLACK_S = 1e-3
"""Containers round times to a millisecond."""


class VideoMismatchError(VideoError):
    """A file that is not the video that was labelled, or lacks some of its frames.

    Attributes:
        check: which of CHECKS refused it; None where a frame is missing.
        fact: the message without advice to callers.

    """

    check: Check | None = None
    fact: str = ""


@dataclass(frozen=True, eq=False)
class VideoWindow:
    """Pictures of consecutive frames of an episode.

    Attributes:
        images: (length, H, W, 3) uint8 RGB.
        timestamps_s: (length,) of the episode's frames, on the container's clock.
        source_timestamps_s: (length,) when the stored frames that are shown have their place.

    """

    images: NDArray[np.uint8]
    timestamps_s: NDArray[np.float64]
    source_timestamps_s: NDArray[np.float64]

    @property
    def error_s(self) -> NDArray[np.float64]:
        """(length,) seconds from each frame to the stored one shown; negative: that is earlier."""
        return self.source_timestamps_s - self.timestamps_s


class VideoAttachment:
    """The video of one episode: found, checked, and read a window at a time.

    Args:
        episode: an `Episode`, or the ``json`` member of one as `members.decode_meta` gives it.
        videos: where videos are: see `resolvers.resolve`.
        video_start_s: when the video's first frame is shown, on the clock of the labels: 0 where
            labels count from the first frame. Default: ``meta["video_start_sec"]``; without it the
            labels' clock is the container's.
        lens: how to rectify, where labels refer to rectified pictures: what `lens_from` takes.
            Default: ``meta["lens"]``; None: the file is rectified already.
        ignore: checks to leave out, of CHECKS.
        decoders: videos kept open; default: those of this process.

    Attributes:
        reference, source, info: what was looked for, the file, and what it says of itself.
        rectified: whether a lens is undone.
        turn_clockwise_deg: how pictures are turned afterwards.
        offset_s: from the clock of the labels to the container's.

    Raises:
        VideoNotFoundError: no such file; says where it was looked for and where to get it.
        VideoMismatchError: another duration, aspect ratio or frame rate than the labels say, or
            labels that refer to undistorted pictures with no lens to undo.
        VideoError: a file that cannot be read.
        ValueError: malformed arguments.

    """

    def __init__(
        self,
        episode: "Episode | Mapping[str, Any]",
        videos: Videos,
        *,
        video_start_s: float | None = None,
        lens: Any = "meta",
        ignore: Collection[Check] = (),
        decoders: DecoderCache | None = None,
    ) -> None:
        if unknown := sorted(set(ignore) - set(CHECKS)):
            raise ValueError(f"ignore: expected some of {', '.join(CHECKS)}, got {unknown[0]!r}")
        self.reference = VideoReference.of(episode)
        self._decoders = decoders
        self.source = resolve(self.reference, videos)
        with self._cache().reader(self.source) as reader:
            self.info: VideoInfo = reader.info
        start_s = self.reference.video_start_s if video_start_s is None else video_start_s
        self.offset_s = 0.0 if start_s is None else self.info.start_time_s - start_s
        spec = self.reference.lens if isinstance(lens, str) and lens == "meta" else lens
        self.rectified = spec is not None
        self.turn_clockwise_deg = self.reference.turn_clockwise_deg
        self._check(frozenset(ignore), spec is None and lens is not None)
        self._warp = _warp(spec, self.info.image_size_hw)

    @property
    def num_frames(self) -> int:
        """T, frames of the episode."""
        return len(self.reference.timestamps_s)

    @property
    def native_fps(self) -> float:
        """Frames a second of the video, as the file says, else the labels, else MODEL_FPS."""
        return self.info.fps or self.reference.native_fps or MODEL_FPS

    def window(
        self, start: int = 0, length: int | None = None, size_hw: tuple[int, int] | None = None
    ) -> VideoWindow:
        """Return pictures of frames start .. start + length - 1 with their times.

        Args:
            start: first frame of the episode.
            length: how many; default: to its end.
            size_hw: size of the pictures; default: ``image_size_hw`` of the episode, so that its K
                and the pictures agree. Other sizes stretch the picture; the field of view stays.

        Raises:
            VideoMismatchError: a frame with no stored one within half a native frame.
            VideoError: the file is damaged there.
            ValueError: the frames are not all in the episode.

        """
        length = self.num_frames - start if length is None else length
        require_window(start, length, self.num_frames, self.reference.key)
        size = self.reference.image_size_hw if size_hw is None else checked_size(size_hw)
        times = self.reference.timestamps_s[start : start + length] + self.offset_s
        with self._cache().reader(self.source) as reader:
            turned = self.turn_clockwise_deg in (90, 270)
            before = (size[1], size[0]) if turned else size
            images, source_s = reader.at(times, before if self._warp is None else None)
        self._check_times(start, times, source_s)
        if self._warp is not None:
            images = _warped(images, self._warp, before)
        if self.turn_clockwise_deg:
            quarters = -self.turn_clockwise_deg // 90
            images = np.ascontiguousarray(np.rot90(images, quarters, axes=(1, 2)))
        return VideoWindow(images, times, source_s)

    @overload
    def frames(
        self,
        start: int = 0,
        length: int | None = None,
        size_hw: tuple[int, int] | None = None,
        as_torch: Literal[False] = False,
    ) -> NDArray[np.uint8]: ...

    @overload
    def frames(
        self,
        start: int = 0,
        length: int | None = None,
        size_hw: tuple[int, int] | None = None,
        *,
        as_torch: Literal[True],
    ) -> "torch.Tensor": ...

    def frames(
        self,
        start: int = 0,
        length: int | None = None,
        size_hw: tuple[int, int] | None = None,
        as_torch: bool = False,
    ) -> "NDArray[np.uint8] | torch.Tensor":
        """Return the pictures of `window`, (length, H, W, 3) uint8 RGB, as numpy or torch."""
        images = self.window(start, length, size_hw).images
        return tensor(images) if as_torch else images

    def _cache(self) -> DecoderCache:
        return self._decoders or shared_decoders()

    def _check(self, ignore: frozenset[str], no_lens: bool) -> None:
        """Refuse a file that is not the labelled video."""
        video, info = self.reference, self.info
        if "size" not in ignore:
            height, width = video.image_size_hw
            h, w = info.image_size_hw[:: -1 if self.turn_clockwise_deg in (90, 270) else 1]
            if abs(w * height / (h * width) - 1) > ASPECT_TOLERANCE:
                want = f"the aspect ratio of (height, width) {video.image_size_hw}"
                self._refuse("size", want, str(info.image_size_hw))
        native_fps = video.native_fps
        ratio = info.fps / native_fps if info.fps and native_fps else 1.0
        if "fps" not in ignore and abs(ratio - 1) > FPS_TOLERANCE:
            self._refuse("fps", f"{native_fps:.6g} frames a second", f"{info.fps:.6g}")
        if "duration" not in ignore:
            self._check_duration()
        if "lens" not in ignore and video.undistorted and no_lens:
            want = "a lens, as these labels refer to undistorted pictures"
            self._refuse("lens", want, "none", _GIVE_LENS)

    def _check_duration(self) -> None:
        video, info = self.reference, self.info
        if info.duration_s is None:
            return
        whole_s = info.duration_s if video.duration_s is None else video.duration_s
        if abs(info.duration_s - whole_s) > DURATION_TOLERANCE_S:
            self._refuse("duration", f"a video of {whole_s:.3f} s", f"{info.duration_s:.3f} s")
        half_s = 0.5 / self.native_fps + _SLACK_S
        first_s, last_s = (float(t) + self.offset_s for t in video.timestamps_s[[0, -1]])
        stop_s = info.start_time_s + info.duration_s
        if first_s < info.start_time_s - half_s or last_s > stop_s + half_s:
            want = f"a video that holds {first_s:.3f} s to {last_s:.3f} s"
            self._refuse("duration", want, f"{info.start_time_s:.3f} s to {stop_s:.3f} s")

    def _check_times(
        self, start: int, times: NDArray[np.float64], source_s: NDArray[np.float64]
    ) -> None:
        error = np.abs(source_s - times)
        limit_s = 0.5 / self.native_fps
        if (bad := np.flatnonzero(error > limit_s + _SLACK_S)).size:
            k = int(bad[0])
            raise VideoMismatchError(
                f"{self.info.source}: expected a stored frame within {1e3 * limit_s:.1f} ms (half "
                f"a native frame) of frame {start + k} at {times[k]:.3f} s, got the nearest at "
                f"{source_s[k]:.3f} s; so it is with {bad.size} of {len(times)} frames, at most "
                f"{1e3 * error.max():.1f} ms off (episode {self.reference.key})"
            )

    def _refuse(self, check: Check, expected: str, got: str, advice: str = "") -> None:
        fact = f"{self.info.source}: {check}: expected {expected}, got {got}"
        fact = f"{fact} (episode {self.reference.key})"
        advice = advice or f"if you know better, ignore={{{check!r}}}"
        error = VideoMismatchError(f"{fact}; {advice}")
        error.check, error.fact = check, fact
        raise error


def _warp(spec: Any, image_size_hw: tuple[int, int]) -> Rectification | None:
    """Build the rectification of a lens; None where pictures are a centred pinhole's already."""
    if spec is None:
        return None
    lens, (height, width) = lens_from(spec, image_size_hw), image_size_hw
    centred = abs(lens.cx - width / 2) < 0.5 and abs(lens.cy - height / 2) < 0.5
    return None if isinstance(lens, PinholeLens) and centred else rectification(lens)


def _warped(
    images: NDArray[np.uint8], warp: Rectification, size_hw: tuple[int, int]
) -> NDArray[np.uint8]:
    """Rectify each picture, then resample it where the size differs."""
    out = np.empty((len(images), *size_hw, 3), np.uint8)
    shrinks = size_hw[0] <= warp.image_size_hw[0] and size_hw[1] <= warp.image_size_hw[1]
    for i, image in enumerate(images):
        rectified = warp.apply(image)
        if size_hw != warp.image_size_hw:
            how = cv2.INTER_AREA if shrinks else cv2.INTER_CUBIC
            rectified = cv2.resize(rectified, size_hw[::-1], interpolation=how)
        out[i] = rectified
    return out
