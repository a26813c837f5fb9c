"""Text of a LeRobot episode: tasks and atomic segments, to and from an Episode's text segments.

A root numbers its texts in meta/tasks.parquet. An episode lists the texts of its frames
(``tasks``, the whole stretch first) and, as ``atomic_segments``, which frames each is about:
``{atomic_index, task_index, start_frame, end_frame}``, frames start <= k < end of the episode.
"""

import json
from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mint_hub.conventions import SIDES
from mint_hub.loaders.lerobot_columns import LeRobotError
from mint_hub.loaders.schema import Episode, TextSegment

NO_TEXT: Final = "null"
"""How the source project writes that a frame has no text: LeRobot wants one of every frame."""

_UNSAID: Final = -1


def segments(
    row: Mapping[str, Any], tasks: Mapping[int, str], main_type: NDArray[Any] | None
) -> tuple[tuple[TextSegment, ...], list[str]]:
    """Read the text of an episode row, and warnings.

    Without atomic segments each of ``tasks`` is a segment of the whole episode. The side is what
    ``main_type`` (T,) says at the segment's first frame. Segments are cut to the episode's frames.

    Raises:
        LeRobotError: a segment has no frames or a text that tasks.parquet does not have.

    """
    length = int(row["length"])
    given = row.get("atomic_segments")
    if isinstance(given, str):
        try:
            given = json.loads(given)
        except ValueError:
            raise LeRobotError(f"atomic_segments: expected JSON, got {given[:40]!r}") from None
    if not given:
        whole = [text for text in row.get("tasks") or () if text and text != NO_TEXT]
        side = _side(main_type, 0)
        return tuple(TextSegment(str(i), t, side, 0, length) for i, t in enumerate(whole)), []
    read: list[TextSegment] = []
    warnings: list[str] = []
    for number, item in enumerate(given):
        text, start, end = _text(item, tasks), int(item["start_frame"]), int(item["end_frame"])
        first, last = max(start, 0), min(end, length)
        if (first, last) != (start, end):
            warnings.append(
                f"atomic segment {number}: frames {start} to {end} of {length} were cut"
            )
        if text != NO_TEXT and first < last:
            name = str(item.get("atomic_index", number))
            read.append(TextSegment(name, text, _side(main_type, first), first, last))
    return tuple(read), warnings


def _text(item: Any, tasks: Mapping[int, str]) -> str:
    if not isinstance(item, Mapping):
        raise LeRobotError(f"atomic_segments: expected entries with names, got {item!r}")
    missing = [n for n in ("task_index", "start_frame", "end_frame") if item.get(n) is None]
    if missing:
        raise LeRobotError(f"atomic_segments: expected {missing}, got {sorted(item)}")
    if item["task_index"] not in tasks:
        raise LeRobotError(
            f"atomic_segments: expected a task_index of meta/tasks.parquet ({len(tasks)} texts), "
            f"got {item['task_index']}"
        )
    return tasks[item["task_index"]]


def _side(main_type: NDArray[Any] | None, frame: int) -> Any:
    value = _UNSAID if main_type is None else int(main_type[frame])
    return SIDES[value] if value in range(len(SIDES)) else None


def main_hand(main_type: NDArray[Any] | None) -> str | None:
    """Return the hand that every frame's ``main_type`` names, or None."""
    if main_type is None or (main_type != main_type[0]).any():
        return None
    return _side(main_type, 0)


class Tasks:
    """Numbers texts in the order in which they come, for the writer."""

    def __init__(self) -> None:
        self.numbers: dict[str, int] = {}

    def rows(self, episode: Episode) -> dict[str, Any]:
        """Return what an episode's text becomes.

        Returns:
            tasks (list of str), atomic_segments (list of dicts), and by frame task_index (T,) and
            main_type (T,); the later of two overlapping segments wins a frame.
            Segments that all cover the whole episode are ``tasks`` alone.

        """
        texts = [str(t) for t in episode.meta.get("tasks") or () if t]
        texts = texts or [s.text for s in episode.text if _is_whole(s, episode)]
        if not texts and not _covered(episode):
            texts = [NO_TEXT]
        first = self._number(texts[0]) if texts else 0
        task_index = np.full(episode.num_frames, first, np.int64)
        hand = episode.meta.get("main_hand")
        unsaid = SIDES.index(hand) if hand in SIDES else _UNSAID
        main_type = np.full(episode.num_frames, unsaid, np.int64)
        whole = all(_is_whole(segment, episode) for segment in episode.text)
        if whole and episode.text:
            main_type[:] = _hand(episode.text[0])
        for segment in () if whole else episode.text:
            frames = slice(segment.start, segment.end)
            task_index[frames] = self._number(segment.text)
            main_type[frames] = _hand(segment)
        atomic = [
            {
                "atomic_index": number,
                "task_index": self._number(segment.text),
                "start_frame": segment.start,
                "end_frame": segment.end,
            }
            for number, segment in enumerate(episode.text)
        ]
        tasks = list(dict.fromkeys((*texts, *(s.text for s in episode.text))))
        for text in tasks:
            self._number(text)
        return {
            "tasks": tasks,
            "atomic_segments": [] if whole else atomic,
            "task_index": task_index,
            "main_type": main_type,
        }

    def _number(self, text: str) -> int:
        return self.numbers.setdefault(text, len(self.numbers))


def _hand(segment: TextSegment) -> int:
    return SIDES.index(segment.side) if segment.side in SIDES else _UNSAID


def _covered(episode: Episode) -> bool:
    """Whether every frame has a segment."""
    silent = np.ones(episode.num_frames, bool)
    for segment in episode.text:
        silent[segment.start : segment.end] = False
    return not silent.any()


def _is_whole(segment: TextSegment, episode: Episode) -> bool:
    return segment.start == 0 and segment.end >= episode.num_frames
