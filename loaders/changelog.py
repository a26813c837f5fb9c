"""The changelog of a corpus as data: what changed, and the tombstones of withdrawn videos.

``changelog.json`` lies beside the card and is what the card's changelog is rendered from. People
write changes into it; ``withdraw`` adds tombstones. A tombstone stays for ever.
"""

import datetime
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final, cast

from mint_hub.loaders.atomic import replacing
from mint_hub.loaders.tar_layout import CorpusError

CHANGELOG: Final = "changelog.json"


@dataclass(frozen=True)
class Change:
    """What changed on a day; ``date`` is YYYY-MM-DD, ``version`` that of the corpus or card."""

    date: str
    version: str
    text: str


@dataclass(frozen=True)
class Tombstone:
    """A video whose labels were taken out, and must not come back.

    Attributes:
        source: data set of the video; "" where its episodes named none.
        uid: name of the video within it.
        date: when it was withdrawn, YYYY-MM-DD.
        reason: why, in words that may be published.
        episodes: how many were taken out of each "config/split".

    """

    source: str
    uid: str
    date: str
    reason: str
    episodes: Mapping[str, int]


@dataclass(frozen=True)
class Changelog:
    """Changes, newest first, and tombstones in the order in which they were added."""

    changes: tuple[Change, ...] = ()
    withdrawn: tuple[Tombstone, ...] = ()

    @classmethod
    def load(cls, folder: Path) -> "Changelog":
        """Read ``changelog.json`` of a folder; an empty one where there is none.

        Raises:
            CorpusError: it is no JSON, or a field is missing, unknown or of another type.

        """
        path = folder / CHANGELOG
        if not path.exists():
            return cls()
        try:
            values = json.loads(path.read_text(encoding="utf-8"))
        except ValueError as error:
            raise CorpusError(f"{path}: expected JSON, got: {error}") from None
        names = {"changes": Change, "withdrawn": Tombstone}
        if not isinstance(values, dict) or values.keys() != names.keys():
            raise CorpusError(
                f"{path}: expected an object with {sorted(names)}, got {values!r:.80}"
            )
        parts = {name: _records(values[name], kind, path, name) for name, kind in names.items()}
        return cls(**parts)

    def save(self, folder: Path) -> Path:
        """Write ``changelog.json`` into a folder, whole or not at all; return its path."""
        text = json.dumps(asdict(self), indent=1, ensure_ascii=False)
        with replacing(folder / CHANGELOG) as temporary:
            temporary.write_text(f"{text}\n", encoding="utf-8")
        return folder / CHANGELOG

    def has(self, uid: str, source: str | None = None) -> bool:
        """Whether a video is withdrawn; ``source`` None means of any source."""
        return any(t.uid == uid and source in (None, t.source) for t in self.withdrawn)


def checked_date(value: object, where: str) -> str:
    """Return a date YYYY-MM-DD as it is.

    Raises:
        CorpusError: anything else.

    """
    try:
        if isinstance(value, str) and datetime.date.fromisoformat(value).isoformat() == value:
            return value
    except ValueError:
        pass
    raise CorpusError(f"{where}: expected a date such as 2026-01-31, got {value!r}")


def _records(values: Any, kind: type[Any], path: Path, name: str) -> tuple[Any, ...]:
    if not isinstance(values, list):
        raise CorpusError(f"{path}, {name}: expected a list, got {type(values).__name__}")
    items = cast("Sequence[Any]", values)
    return tuple(_record(v, kind, f"{path}, {name}[{i}]") for i, v in enumerate(items))


def _record(values: Any, kind: type[Any], where: str) -> Any:
    fields = set(kind.__dataclass_fields__)
    if not isinstance(values, dict) or values.keys() != fields:
        raise CorpusError(f"{where}: expected an object with {sorted(fields)}, got {values!r:.120}")
    entries = cast("dict[str, Any]", values)
    for name, value in entries.items():
        if name == "episodes":
            counts = value.values() if isinstance(value, dict) else [None]
            if not all(type(count) is int and count > 0 for count in counts):
                raise CorpusError(f"{where}, episodes: expected counts by split, got {value!r}")
        elif not isinstance(value, str):
            raise CorpusError(f"{where}, {name}: expected text, got {value!r}")
    checked_date(entries["date"], f"{where}, date")
    return kind(**entries)
