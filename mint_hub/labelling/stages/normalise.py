"""Stage "normalise": a video of any make becomes short overlapping clips at a constant rate.

The video is decoded once, from beginning to end, with bounded memory: turned upright, its pixels
made square, resampled to 30 frames/s by presentation time, shrunk, and written as H.264 pieces.
"""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from itertools import chain, count, islice
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from mint_hub.conventions import MODEL_FPS
from mint_hub.labelling.records import Clip, Lost, Video
from mint_hub.labelling.stage import LOCAL, NotReadyError, Resources, report_of
from mint_hub.loaders.atomic import replacing
from mint_hub.loaders.clips import clip_size, encode_clip
from mint_hub.loaders.video import Frame, VideoFrames, iter_frames

HEIGHT: Final = 384
HEIGHTS: Final = {"ego4d": 768}
"""Height by corpus, where it is another than HEIGHT."""

DAMAGED: Final = "the video is damaged from here on"
MISSING: Final = "the video ends before its container says"
SHORT_TAIL: Final = "tail shorter than {:g} s"
SHORT_VIDEO: Final = "video shorter than {:g} s"
SLOW: Final = "frame rate too low for tracking: {:.0f} of at least {:g}"

_ROUNDING_S: Final = 0.1

Image = NDArray[np.uint8]


class Normalise:
    """Cuts a video into clips of its own, one file each.

    Piece i begins ``i * (piece_s - overlap_s)`` seconds into the video and is ``piece_s`` long; the
    last one ends with the video. A last piece under ``min_tail_s`` is dropped, unless it is the
    whole video: that one stays if it has ``min_video_s``, and acceptance may still refuse it.
    """

    stage, backend, version = "normalise", "default", "1"
    needs, gives = (), ()
    resources = Resources(cpus=1, memory_gib=1.5)

    @dataclass(frozen=True)
    class Settings:
        """Where the clips go, and how long, high and good they are.

        Attributes:
            work_dir: folder of the clips, which go into ``work_dir/VIDEO KEY/CLIP KEY.mp4``.
            height: height of the clips (of a portrait video: their width), pixels; None is 384, and
                768 for Ego4D. Nothing is enlarged, odd sizes are rounded down.
            piece_s, overlap_s: length of a clip and what it shares with the next one, seconds.
            min_tail_s, min_video_s: shortest last piece, and shortest video.
            min_fps: rate of different pictures below which nothing can be tracked, frames/s.
            crf: x264's quality, 0 (best) to 51.

        """

        work_dir: str = field(default="", metadata=LOCAL)
        height: int | None = None
        piece_s: float = 12.0
        overlap_s: float = 1.0
        min_tail_s: float = 3.0
        min_video_s: float = 1.0
        min_fps: float = 10.0
        crf: int = 18

    def __init__(self, settings: Settings | None = None) -> None:
        """Raise ValueError for lengths that do not go together."""
        self.settings = settings or self.Settings()
        s = self.settings
        if not 0 <= s.overlap_s <= s.piece_s / 2:
            raise ValueError(
                f"overlap_s: expected 0 to half of piece_s ({s.piece_s:g}), got {s.overlap_s:g}"
            )
        if s.height is not None and s.height < 2:
            raise ValueError(f"height: expected pixels or None, got {s.height}")

    def run_video(self, video: Video) -> Video:
        """Decode, cut and write.

        What was decoded before damage is kept, the rest is lost with a reason.

        Raises:
            NotReadyError: no ``work_dir`` was given.
            VideoError: not even the first frame can be read.

        """
        if not self.settings.work_dir:
            raise NotReadyError("normalise: expected the setting work_dir, a folder, got none")
        if 0 < video.fps < self.settings.min_fps:
            return self._refused(video, SLOW.format(video.fps, self.settings.min_fps))
        with iter_frames(video.path, MODEL_FPS, on_error="stop") as frames:
            size_hw = self._size(frames.info.image_size_hw, video.source)
            decoded = _Decoded(frames, size_hw)
            clips, lost = self._cut(video, decoded)
        damaged = any(": damaged at " in warning for warning in frames.warnings)
        rest = Lost(decoded.stop_s, video.stop_s, self.stage, DAMAGED if damaged else MISSING)
        if rest.seconds > _ROUNDING_S:
            lost.append(replace(rest, failed=damaged))
        report = report_of(
            self,
            frames=decoded.count,
            different_frames=decoded.different,
            clips=len(clips),
            image_size_hw=list(size_hw),
            rotation_deg=frames.info.rotation_deg,
            codec=frames.info.codec,
            warnings=list(frames.warnings),
        )
        return replace(
            video,
            clips=tuple(clips),
            lost=(*video.lost, *lost),
            reports=(*video.reports, report),
        )

    def close(self) -> None:
        """Nothing to end."""

    def _refused(self, video: Video, reason: str) -> Video:
        lost = Lost(video.start_s, video.stop_s, self.stage, reason)
        reports = (*video.reports, report_of(self, clips=0))
        return replace(video, clips=(), lost=(*video.lost, lost), reports=reports)

    def _size(self, native_hw: tuple[int, int], source: str) -> tuple[int, int]:
        wanted = self.settings.height or HEIGHTS.get(source, HEIGHT)
        return clip_size(wanted if wanted < min(native_hw) else None, native_hw)

    def _cut(self, video: Video, decoded: "_Decoded") -> tuple[list[Clip], list[Lost]]:
        """Write piece after piece while frames come."""
        s = self.settings
        length, overlap = round(s.piece_s * MODEL_FPS), round(s.overlap_s * MODEL_FPS)
        clips: list[Clip] = []
        lost: list[Lost] = []
        shared: list[_Shrunk] = []
        for number in count():
            new = islice(decoded, length - len(shared))
            first = next(new, None)
            if first is None:  # the piece before ended with the video
                break
            key = f"{video.key}-{number:04d}"
            piece = _Piece(chain(shared, [first], new), overlap)
            mp4 = encode_clip(piece, fps=MODEL_FPS, crf=s.crf)
            whole = len(piece.times) == length
            if reason := self._flaw(piece.times, alone=number == 0, whole=whole):
                stop_s = piece.times[-1] + 1 / MODEL_FPS
                lost.append(Lost(first.time_s, stop_s, self.stage, reason))
            else:
                path = Path(s.work_dir) / video.key / f"{key}.mp4"
                with replacing(path) as temporary:
                    temporary.write_bytes(mp4)
                times = np.array(piece.times)
                clips.append(Clip(key, path, 0, decoded.size_hw, MODEL_FPS, times))
            if not whole:
                break
            shared = piece.last
        return clips, lost

    def _flaw(self, times: list[float], *, alone: bool, whole: bool) -> str:
        """Why a piece cannot stay; empty when it can."""
        s = self.settings
        seconds = len(times) / MODEL_FPS
        if alone and seconds < s.min_video_s:
            return SHORT_VIDEO.format(s.min_video_s)
        if not alone and not whole and seconds < s.min_tail_s:
            return SHORT_TAIL.format(s.min_tail_s)
        rate = len(set(times)) / seconds
        # One frame more or less is what the ends of a piece make of the same rate.
        if rate + 1 / seconds < s.min_fps:
            return SLOW.format(rate, s.min_fps)
        return ""


@dataclass(frozen=True, eq=False)
class _Shrunk:
    """A picture of its final size, and when the source shows it."""

    image: Image
    time_s: float


class _Decoded(Iterator[_Shrunk]):
    """Frames of the video at a constant rate and of their final size."""

    def __init__(self, frames: VideoFrames, size_hw: tuple[int, int]) -> None:
        self.size_hw = size_hw
        self.count = self.different = 0
        self.start_s = frames.info.start_time_s
        self._frames = frames
        self._shown = -1
        self._last: _Shrunk | None = None

    @property
    def stop_s(self) -> float:
        """Source time up to which frames came."""
        return self.start_s + self.count / MODEL_FPS

    def __next__(self) -> _Shrunk:
        frame: Frame = next(self._frames)
        self.count += 1
        if self._last is None or frame.source_index != self._shown:
            self._shown = frame.source_index
            self.different += 1
            self._last = _Shrunk(_resized(frame.image, self.size_hw), frame.source_timestamp_s)
        return self._last


class _Piece(Iterator[Image]):
    """Pictures of one piece, noting their times and keeping the last ones for the next piece."""

    def __init__(self, frames: Iterator[_Shrunk], overlap: int) -> None:
        self.times: list[float] = []
        self._frames = frames
        self._last: deque[_Shrunk] = deque(maxlen=overlap)

    @property
    def last(self) -> list[_Shrunk]:
        """What the next piece begins with."""
        return list(self._last)

    def __next__(self) -> Image:
        frame = next(self._frames)
        self.times.append(frame.time_s)
        self._last.append(frame)
        return frame.image


def _resized(image: Image, size_hw: tuple[int, int]) -> Image:
    if image.shape[:2] == size_hw:
        return image
    resized = cv2.resize(image, size_hw[::-1], interpolation=cv2.INTER_AREA)
    return np.asarray(resized, np.uint8)
