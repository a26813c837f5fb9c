"""Labels of videos that lie beside the shards of a corpus, which have to go when a video does.

Two verbs leave some. `mint-hub convert hot3d` without MANO's files keeps raw hands for those who
have them, as ``hand_annotations/<key>.npz``, since no hand state can be made of them. `mint-hub
label` keeps the episodes of each video, and pictures of them, in ``labelling``, to go on from.
They are a person's data as much as the shards are: ``withdraw`` takes them out, hand annotations
are not written again for a withdrawn video, and ``verify`` looks at them.
"""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final, NamedTuple

from mint_hub.loaders.atomic import clear_left_over
from mint_hub.loaders.changelog import Changelog
from mint_hub.loaders.fields import EpisodeError
from mint_hub.loaders.hot3d import SOURCE
from mint_hub.loaders.hot3d_hands import Hot3DHands
from mint_hub.loaders.tar_layout import CorpusError

HAND_ANNOTATIONS: Final = "hand_annotations"
LABELLING: Final = "labelling"
ACCOUNT: Final = "account.json"
"""What ``label_videos`` wrote of a video, ``labelling/videos/<key>/account.json``."""


class Beside(NamedTuple):
    """A file or folder with labels of a video."""

    path: Path
    source: str
    uid: str


def keep_annotation(root: Path, hands: Hot3DHands, key: str) -> Path | None:
    """Write the hand annotations of an episode into a corpus; None, and nothing, if withdrawn.

    The file appears whole or not at all, and what a killed try left is removed.
    """
    if Changelog.load(root).has(hands.uid, SOURCE):
        return None
    path = root / HAND_ANNOTATIONS / f"{key}.npz"
    clear_left_over(path)
    return hands.save(path)


def annotation_files(root: Path) -> list[Path]:
    """Return everything that lies in the folder of annotations, left overs included, sorted."""
    return sorted(p for p in (root / HAND_ANNOTATIONS).rglob("*") if p.is_file())


def read_annotation(path: Path) -> Beside:
    """Read a file of annotations, all of it, and return whose it is.

    Raises:
        CorpusError: it is not what was written.

    """
    try:
        return Beside(path, SOURCE, Hot3DHands.load(path).uid)
    except EpisodeError as error:
        raise CorpusError(
            f"{error}: nobody can say whose hands these are: delete it, and convert again"
        ) from None


def labels_beside(root: Path) -> list[Beside]:
    """Return what lies beside the shards of a corpus, with the video that it is of.

    Raises:
        CorpusError: of a file, nobody can say whose it is.

    """
    return [*map(read_annotation, annotation_files(root)), *_labelled(root / LABELLING)]


def _labelled(folder: Path) -> Iterator[Beside]:
    """Yield the episodes, intermediate files and pictures of labelled videos, not the accounts."""
    for path in sorted(folder.glob(f"videos/*/{ACCOUNT}")):
        try:
            account: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
            source, uid, keys = account["source"], account["uid"], account["episodes"]
        except (ValueError, TypeError, KeyError) as error:
            raise CorpusError(f"{path}: expected the account of a video, got: {error!r}") from None
        places = [path.parent / "episodes", folder / "work" / path.parent.name]
        places += [folder / "review" / key for key in keys]
        yield from (Beside(place, source, uid) for place in places if place.exists())
