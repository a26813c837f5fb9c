"""Frames of a video at given times: an open decoder that seeks, and a few of them kept open.

Where `video` streams a video once, a `VideoReader` answers many small questions about one: it goes
to the key frame before the first time wanted, or simply decodes on where that is nearer.
"""

import os
import threading
from collections import OrderedDict
from collections.abc import Generator, Iterator
from contextlib import ExitStack, contextmanager
from functools import cache
from os import PathLike, fspath
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mint_hub.loaders.video_decoder import TIE_S, Decoder, NumThreads, Picture, Stored, describe
from mint_hub.loaders.video_source import VideoError, VideoSource, open_video

if TYPE_CHECKING:
    import torch

_SAME_S = 5e-4
"""A frame this near is the nearest one: containers keep times to a millisecond or finer."""

_KEEP_OPEN = 8


class Pictures(NamedTuple):
    """What `VideoReader.at` returns: images (N, H, W, 3) uint8 RGB, and when they are shown (N,)"""

    images: NDArray[np.uint8]
    source_timestamps_s: NDArray[np.float64]


class VideoReader:
    """An open video that gives the stored frames nearest to given times.

    Attributes:
        info: `VideoInfo`; times are presentation times of the container, as everywhere.

    Raises:
        VideoNotFoundError: nothing at that path or URL.
        VideoError: what `video.iter_frames` raises.

    """

    def __init__(self, source: VideoSource, num_threads: NumThreads = "auto") -> None:
        self._source = source
        self._num_threads: NumThreads = num_threads
        self._closing = ExitStack()
        self._begin()

    def _begin(self) -> None:
        """Open the file and stand at its first frame."""
        try:
            name, container = open_video(self._source, self._closing)
            self._decoder = Decoder(name, container, self._num_threads, "raise")
            self._coming = self._decoder.stored()
            first = next(self._coming, None)
            if first is None:
                raise VideoError(f"{name}: its video stream holds no frames")
            self._picture = Picture(first.frame, self._decoder.stream)
            self.info = describe(name, container, self._decoder.stream, first, self._picture)
        except BaseException:
            self.close()
            raise
        self._current, self._next = first, None
        self._open, self._lost = True, False

    def at(self, times_s: ArrayLike, size_hw: tuple[int, int] | None = None) -> Pictures:
        """Return the stored frames nearest to ``times_s``, the earlier of two as near.

        Before the first stored frame that is the first one, after the last one the last one; who
        minds looks at ``source_timestamps_s``.

        Args:
            times_s: (N,) seconds, N >= 1, not decreasing, on the container's clock.
            size_hw: size of the images, resampled in one step with the colours; the video's own
                when None.

        Raises:
            VideoError: the file is damaged or cut short on the way there.
            ValueError: times out of order, or a closed reader.

        """
        times = np.asarray(times_s, np.float64)
        if times.ndim != 1 or not times.size or not np.isfinite(times).all():
            raise ValueError(f"times_s: expected (N,) finite seconds, N >= 1, got {times_s!r}")
        if (np.diff(times) < 0).any():
            raise ValueError(f"times_s: expected times that do not decrease, got {times.tolist()}")
        if not self._open:
            raise ValueError(f"{self.info.source}: this reader was closed")
        size = self.info.image_size_hw if size_hw is None else size_hw
        images = np.empty((len(times), *size, 3), np.uint8)
        source_s = np.empty(len(times))
        for i, stored in enumerate(self._nearest(times)):
            source_s[i] = stored.time_s
            if i and source_s[i] == source_s[i - 1]:
                images[i] = images[i - 1]
            else:
                images[i] = self._picture.rgb(stored.frame, size)
        return Pictures(images, source_s)

    def close(self) -> None:
        """Let go of the file."""
        self._open = False
        self._closing.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _nearest(self, times: NDArray[np.float64]) -> Iterator[Stored]:
        self._approach(float(times[0]))
        for time_s in times:
            while time_s > self._current.time_s + _SAME_S:
                following = self._peek()
                if following is None or time_s <= _middle_s(self._current, following):
                    break
                self._current, self._next = following, None
            yield self._current

    def _peek(self) -> Stored | None:
        """Return the frame after the current one; None at the end."""
        if self._next is None:
            try:
                self._next = next(self._coming, None)
            except VideoError:
                self._lost = True
                raise
        return self._next

    def _approach(self, time_s: float) -> None:
        """Stand at a frame at or before ``time_s``, the first frame where there is none."""
        at_s = (self._next or self._current).time_s
        if not self._lost and self._current.time_s <= time_s + TIE_S:
            key_s = self._decoder.key_time_s(time_s)
            if (key_s is not None and key_s <= at_s) or time_s <= at_s:
                return
        self._lost = True  # until a frame has come
        sought = self._decoder.sought(time_s, self.info.start_time_s)
        begin = None if sought is None else next(sought, None)
        if sought is None or begin is None:
            self._closing.close()
            self._begin()
            return
        self._current, self._next, self._coming, self._lost = begin, None, sought, False


def _middle_s(a: Stored, b: Stored) -> float:
    return (a.time_s + b.time_s) / 2 + TIE_S


class DecoderCache:
    """The videos read last, kept open; the one not read for longest is closed first.

    It may be shared by threads (one reads at a time); a forked or unpickled copy starts empty. A
    file that changed on disk is opened anew.
    """

    def __init__(self, keep_open: int = _KEEP_OPEN, num_threads: NumThreads = "auto") -> None:
        if keep_open < 1:
            raise ValueError(f"keep_open: expected at least 1, got {keep_open}")
        self._settings = keep_open, num_threads
        self._readers: OrderedDict[object, VideoReader] = OrderedDict()
        self._lock = threading.RLock()
        self._pid = os.getpid()

    @contextmanager
    def reader(self, source: VideoSource) -> Generator[VideoReader]:
        """Lend the reader of ``source`` for the block; one that fails is not kept.

        Paths and URLs are kept open; bytes, file objects and mappings only for the block.
        """
        keep_open, num_threads = self._settings
        if not isinstance(source, str | PathLike):
            with VideoReader(source, num_threads) as reader:
                yield reader
            return
        self._leave_the_parent()
        with self._lock:
            key = _identity(fspath(source))
            reader = self._readers.pop(key, None) or VideoReader(source, num_threads)
            try:
                yield reader
            except VideoError:
                reader.close()
                raise
            self._readers[key] = reader
            while len(self._readers) > keep_open:
                self._readers.popitem(last=False)[1].close()

    def close(self) -> None:
        """Close every video; the cache can be used again."""
        with self._lock:
            while self._readers:
                self._readers.popitem()[1].close()

    def __len__(self) -> int:
        return len(self._readers)

    def __reduce__(self) -> tuple[type["DecoderCache"], tuple[Any, ...]]:
        return type(self), self._settings

    def _leave_the_parent(self) -> None:
        """After a fork, forget readers whose file offsets and threads are the parent's."""
        if self._pid != os.getpid():
            self._parents = self._readers  # never closed: their threads did not come along
            self._readers, self._lock, self._pid = OrderedDict(), threading.RLock(), os.getpid()


@cache
def shared_decoders() -> DecoderCache:
    """Return the cache of this process, made when first asked for."""
    return DecoderCache()


def tensor(images: NDArray[np.uint8]) -> "torch.Tensor":
    """Return pictures as a torch tensor that shares their memory."""
    import torch

    return torch.from_numpy(images)


def _identity(source: str) -> object:
    """What tells one version of a file from the next; of a URL, itself."""
    if "://" in source or not (path := Path(source)).exists():
        return source
    status = path.stat()
    return str(path.resolve()), status.st_mtime_ns, status.st_size
