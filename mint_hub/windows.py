"""How a video is cut into windows: bounds, overlaps, ramps; whole or as a stream.

Legend: ``length`` and ``overlap`` are in frames, the stride is ``length - overlap``. A window
starts at every multiple of the stride while it still ends before the video does; one last window
ends with the video. That one is full too, so it may start less than a stride after its predecessor
and put a frame in three windows. A video no longer than ``length`` is a single window of its own
length.
"""

from dataclasses import dataclass
from typing import Final

WINDOW_LENGTH: Final = 32
"""Frames in a window, as the network was trained."""

WINDOW_OVERLAP: Final = 8
"""Frames that consecutive windows share, at least."""


@dataclass(frozen=True, order=True, slots=True)
class Window:
    """The frames ``start <= i < stop`` of a video.

    Raises:
        ValueError: unless 0 <= start < stop.

    """

    start: int
    stop: int

    def __post_init__(self) -> None:
        if not 0 <= self.start < self.stop:
            raise ValueError(
                f"window: expected 0 <= start < stop, got start {self.start}, stop {self.stop}"
            )

    @property
    def num_frames(self) -> int:
        """Frames in the window."""
        return self.stop - self.start

    @property
    def frames(self) -> slice:
        """The slice that cuts this window out of an array over the video's frames."""
        return slice(self.start, self.stop)

    def overlap_with(self, later: "Window") -> int:
        """Frames shared with ``later``, a window that starts no earlier than this one."""
        return max(0, min(self.stop, later.stop) - later.start)


def windows(
    num_frames: int, length: int = WINDOW_LENGTH, overlap: int = WINDOW_OVERLAP
) -> list[Window]:
    """Cut ``num_frames`` frames into windows, left to right.

    All have ``length`` frames (a shorter video is one shorter window), consecutive ones share at
    least ``overlap``, together they cover every frame, and starts and stops strictly increase.

    >>> [(w.start, w.stop) for w in windows(60)]
    [(0, 32), (24, 56), (28, 60)]

    Raises:
        ValueError: no frames, or not 0 <= overlap < length.

    """
    stride = _stride(length, overlap)
    if num_frames < 1:
        raise ValueError(f"num_frames: expected at least one frame, got {num_frames}")
    last_start = max(0, num_frames - length)
    starts = [*range(0, last_start, stride), last_start]
    return [Window(start, min(start + length, num_frames)) for start in starts]


class WindowPlanner:
    """The same windows for a stream whose end is not known yet.

    Law: what ``push`` returned over all calls, then what ``finish`` returns, equals
    ``windows(frames pushed, length, overlap)``.
    """

    def __init__(self, length: int = WINDOW_LENGTH, overlap: int = WINDOW_OVERLAP) -> None:
        self._stride = _stride(length, overlap)
        self._length = length
        self._num_frames = 0
        self._next_start = 0  # of the next window in step
        self._finished = False

    @property
    def num_frames(self) -> int:
        """Frames pushed so far."""
        return self._num_frames

    @property
    def needed_from(self) -> int:
        """The first frame that a window not yet returned may hold; earlier ones can be dropped.

        Between calls at most ``length`` of the frames pushed so far are needed.
        """
        if self._finished:
            return self._num_frames
        if self._next_start == 0:
            return 0
        # If the stream ends after n > stop frames its last window starts at n - length.
        last_stop = self._next_start - self._stride + self._length
        earliest_end = max(self._num_frames, last_stop + 1)
        return min(self._next_start, earliest_end - self._length)

    def push(self, count: int = 1) -> list[Window]:
        """Count ``count`` further frames; the windows that became full, left to right.

        Raises:
            ValueError: a negative count, or a push after ``finish``.

        """
        if self._finished:
            raise ValueError("WindowPlanner.push: the stream was finished; make a new planner")
        if count < 0:
            raise ValueError(f"count: expected 0 or more frames, got {count}")
        self._num_frames += count
        ready: list[Window] = []
        while self._next_start + self._length <= self._num_frames:
            ready.append(Window(self._next_start, self._next_start + self._length))
            self._next_start += self._stride
        return ready

    def finish(self) -> list[Window]:
        """End the stream: the last window, shifted left to be full, or none where one ends there.

        Raises:
            ValueError: no frame was pushed, or a second ``finish``.

        """
        if self._finished:
            raise ValueError("WindowPlanner.finish: the stream was finished already")
        if self._num_frames == 0:
            raise ValueError("num_frames: expected at least one frame, got 0")
        self._finished = True
        covered = self._next_start - self._stride + self._length if self._next_start else 0
        if covered == self._num_frames:
            return []
        return [Window(max(0, self._num_frames - self._length), self._num_frames)]


def ramp(overlap: int) -> tuple[float, ...]:
    """Weights of the later window over the ``overlap`` frames it shares; the earlier has the rest.

    Linear and strictly inside (0, 1), so that both windows speak in every shared frame and the two
    sides are treated alike: ``ramp(n)[i] == 1 - ramp(n)[n - 1 - i]``.

    >>> ramp(3)
    (0.25, 0.5, 0.75)

    Raises:
        ValueError: a negative overlap.

    """
    if overlap < 0:
        raise ValueError(f"overlap: expected 0 or more frames, got {overlap}")
    return tuple((i + 1) / (overlap + 1) for i in range(overlap))


def _stride(length: int, overlap: int) -> int:
    if length < 1:
        raise ValueError(f"length: expected at least one frame, got {length}")
    if not 0 <= overlap < length:
        raise ValueError(f"overlap: expected 0 <= overlap < length ({length}), got {overlap}")
    return length - overlap
