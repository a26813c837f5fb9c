"""Who wears the camera: stated, or told by the video's name where a source names videos so.

Train and validation are told apart by participant where one is known, so everything that decides a
split asks here: ``group_of`` says what ``shards.split_of`` takes.
"""

import re
from collections.abc import Mapping
from typing import Any, Final

_NAMES: Final = {
    "epic": re.compile(r"(P\d{2,3})_\d{2,3}", re.IGNORECASE),
    "hot3d": re.compile(r"(P\d{4})_[0-9a-f]{8}", re.IGNORECASE),
}
"""How videos are named, by the beginning of the source's name: EPIC-KITCHENS' P01_101 is a video of
P01, HOT3D's P0003_c701bd11 one of P0003."""


def participant_of(source: str | None, uid: str | None, stated: str | None = None) -> str | None:
    """Return who wears the camera of a video; None where neither ``stated`` nor named so.

    Args:
        source: its data set.
        uid: its name there; folders before it and a suffix do not matter.
        stated: what the labels say, which goes before the name.

    >>> participant_of("epic", "P01_101"), participant_of("ego4d", "P01_101")
    ('P01', None)

    """
    if stated:
        return stated
    name = re.split(r"[/\\]", uid or "")[-1].partition(".")[0]
    for start, pattern in _NAMES.items():
        if (source or "").lower().startswith(start) and (found := pattern.fullmatch(name)):
            return found[1].upper()
    return None


def group_of(meta: Mapping[str, Any], key: str) -> tuple[str, str | None]:
    """Return video and participant of an episode, as ``shards.split_of`` takes them.

    Args:
        meta: ``Episode.meta``, or as much of it as is known: source, uid, participant.
        key: stands for the video of an episode that names none.

    """
    uid = meta.get("uid")
    participant = participant_of(meta.get("source"), uid, meta.get("participant"))
    return str(uid or key), participant
