"""What a LeRobot root says of the video that an episode is from.

LeRobot itself has no place for it. A root names the video in a column of ``meta/episodes`` called
``video_uid``, ``uid`` or ``video_id``, the first of them that is filled. The published labels were
described without any of these. Then the video file of the root itself stands for it,
after the root's identity, as every root has files of these names:
``lerobot-1f0c22ab/videos/observation.images.ego/chunk-000/file-000``. By this name ``attach`` finds
the pictures in a root that has them, and all episodes of one file fall into one split; but the file
may join several videos. Where the root has no video either, an episode has no uid, and every
episode falls into a split by itself. ``meta["warnings"]`` says which.

Columns called as ATTACHMENT tells go into ``meta`` under the same name, for ``attach``.
"""

import re
from collections.abc import Mapping
from typing import Any, Final

from mint_hub.loaders.lerobot_files import VIDEO_PATH, Root
from mint_hub.loaders.participants import participant_of

VIDEO_KEY: Final = "observation.images.ego"
UID_COLUMNS: Final = ("video_uid", "uid", "video_id")
ATTACHMENT: Final[Mapping[str, type]] = {
    "participant": str,
    "native_fps": float,
    "video_start_sec": float,
    "video_duration_s": float,
    "undistorted": bool,
}
"""Columns of ``meta/episodes`` that say what ``attach`` and the splits need, if they are there."""

_FILE_COLUMNS: Final = tuple(f"videos/{VIDEO_KEY}/{n}" for n in ("chunk_index", "file_index"))
ORIGIN_COLUMNS: Final = (*UID_COLUMNS, *ATTACHMENT, *_FILE_COLUMNS)
"""All columns of ``meta/episodes`` that the functions here look at."""

_NO_COLUMN: Final = f"the root names no video (no column {', '.join(UID_COLUMNS)})"
_BY_FILE: Final = f"{_NO_COLUMN}: uid is its video file, which may join several videos"
_BY_NOTHING: Final = f"{_NO_COLUMN} and has no video file: no uid, so that a split may part a video"


def stated_uid(row: Mapping[str, Any]) -> str | None:
    """Return what a column of ``meta/episodes`` calls the video; None where none does."""
    return next((str(row[name]) for name in UID_COLUMNS if row.get(name)), None)


def video_uid(row: Mapping[str, Any], root: Root) -> str | None:
    """Return the name of the video: what the root states, else its own video file, else None."""
    if (stated := stated_uid(row)) is not None or not _has_file(row):
        return stated
    chunk, file = (int(row[name]) for name in _FILE_COLUMNS)
    path = VIDEO_PATH.format(video_key=VIDEO_KEY, chunk_index=chunk, file_index=file)
    return f"lerobot-{root.identity}/{path.removesuffix('.mp4')}"


def file_in_root(uid: str) -> str | None:
    """Return which file of its root a ``video_uid`` is, without ".mp4"; None for other names.

    >>> file_in_root("lerobot-1f0c22ab/videos/observation.images.ego/chunk-000/file-002")
    'videos/observation.images.ego/chunk-000/file-002'
    >>> file_in_root("P01_101")
    """
    found = _UID_IN_ROOT.fullmatch(uid)
    return found[1] if found else None


_UID_IN_ROOT: Final = re.compile(r"lerobot-[0-9a-f]{8}/(videos/.+)")


def _has_file(row: Mapping[str, Any]) -> bool:
    return all(row.get(name) is not None for name in _FILE_COLUMNS)


def origin_warnings(row: Mapping[str, Any]) -> list[str]:
    """Return what a user has to know of ``video_uid``; nothing where the root states it."""
    if stated_uid(row) is not None:
        return []
    return [_BY_FILE if _has_file(row) else _BY_NOTHING]


def attachment(
    row: Mapping[str, Any], info: Mapping[str, Any], source: str | None = None
) -> dict[str, Any]:
    """Return the entries of ``meta`` that a root states of an episode's video.

    The rate of the root's own video, from info.json, is that of the video only where no other is
    named. The participant is what a column says, else what the video's name does where ``source``
    names videos by participant.
    """
    facts: dict[str, Any] = {
        name: kind(row[name]) for name, kind in ATTACHMENT.items() if row.get(name) is not None
    }
    if (person := participant_of(source, stated_uid(row), facts.get("participant"))) is not None:
        facts["participant"] = person
    feature = info.get("features", {}).get(VIDEO_KEY, {})
    told = feature.get("info") or feature.get("video_info") or {}
    rate = told.get("video.fps")
    if stated_uid(row) is None and _has_file(row) and rate:
        facts.setdefault("native_fps", float(rate))
    return facts
