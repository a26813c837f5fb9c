"""What is known of the corpus and of the data sets it was made from, read from ``sources.json``.

The numbers are those that the release states; they are checked against one another when read. What
nobody has told us is null in the file, and "not stated" in the card.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Final, cast, get_args, get_type_hints

from mint_hub.loaders.location import PARTS

SOURCES: Final = "sources.json"
HOURS_TOLERANCE: Final = 5e-4
"""Published hours have three decimals."""


class CardError(ValueError):
    """A source of a card is missing or wrong."""


@dataclass(frozen=True)
class Release:
    """The corpus as its release counts it.

    ``raw_hours`` is what was labelled before filtering; ``cited`` says where the numbers stand.
    """

    cited: str
    hours: float
    raw_hours: float
    episodes: int
    frames: int
    fps: float
    labels_licence: str


@dataclass(frozen=True)
class Source:
    """A data set whose video was labelled: one config of the corpus.

    Attributes:
        config: its config.
        name: as its makers write it.
        home: where its makers publish it.
        hours: of labels, as the release counts them.
        episodes: the same; None where the release does not say.
        video_licence: terms of the video, and how sure we are of them.
        labels_licence: what that means for labels made from it.
        agreement: what users have to accept or sign before they take part, in the first person.
        access: who may have the video, and how.
        known: facts that matter to users.
        unknown: questions that are open.

    """

    config: str
    name: str
    home: str
    hours: float
    episodes: int | None
    video_licence: str
    labels_licence: str
    agreement: str
    access: str
    known: tuple[str, ...]
    unknown: tuple[str, ...]


@dataclass(frozen=True)
class Sources:
    """``sources.json``: the release, its sources in the order of ``location.PARTS``, and limits."""

    release: Release
    sources: tuple[Source, ...]

    @classmethod
    def load(cls, folder: Path) -> "Sources":
        """Read and check ``sources.json``.

        Raises:
            CardError: no such file, no JSON, a field is missing, unknown or of another type, the
                sources are not those of the corpus, or numbers contradict one another.

        """
        path = folder / SOURCES
        try:
            values = json.loads(path.read_text(encoding="utf-8"))
        except FileNotFoundError:
            raise CardError(f"{path}: expected this file, got none") from None
        except ValueError as error:
            raise CardError(f"{path}: expected JSON, got: {error}") from None
        entries = _entries(values, {"release", "sources"}, str(path))
        items = entries["sources"]
        if not isinstance(items, list):
            raise CardError(f"{path}, sources: expected a list, got {type(items).__name__}")
        several = enumerate(cast("list[Any]", items))
        made = cls(
            _record(entries["release"], Release, f"{path}, release"),
            tuple(_record(item, Source, f"{path}, sources[{i}]") for i, item in several),
        )
        made.check(str(path))
        return made

    def check(self, where: str) -> None:
        """Compare what the file says with itself and with the configs of the corpus.

        Raises:
            CardError: two statements contradict each other.

        """
        if (got := tuple(source.config for source in self.sources)) != PARTS:
            raise CardError(f"{where}, sources: expected configs {list(PARTS)}, got {list(got)}")
        release = self.release
        total = sum(source.hours for source in self.sources)
        if abs(total - release.hours) > HOURS_TOLERANCE * (1 + len(self.sources)):
            raise CardError(
                f"{where}, hours: expected {release.hours} over all sources, got {total:.3f}"
            )
        counted = release.frames / release.fps / 3600
        if abs(counted - release.hours) > 2 * HOURS_TOLERANCE:
            raise CardError(
                f"{where}, frames: expected {release.hours} h at {release.fps:g} a second, got "
                f"{counted:.3f} h"
            )


def _entries(values: Any, names: set[str], where: str) -> Mapping[str, Any]:
    if not isinstance(values, dict) or values.keys() != names:
        got = sorted(cast("dict[str, Any]", values)) if isinstance(values, dict) else repr(values)
        raise CardError(f"{where}: expected an object with {sorted(names)}, got {got}")
    return cast("dict[str, Any]", values)


def _record(values: Any, kind: type[Any], where: str) -> Any:
    entries = _entries(values, {field.name for field in fields(kind)}, where)
    types = get_type_hints(kind)
    return kind(**{n: _value(v, types[n], f"{where}, {n}") for n, v in entries.items()})


def _value(value: Any, kind: Any, where: str) -> Any:
    if kind == tuple[str, ...]:
        if isinstance(value, list) and all(isinstance(v, str) for v in cast("list[Any]", value)):
            return tuple(cast("list[str]", value))
        raise CardError(f"{where}: expected a list of texts, got {value!r}")
    if kind is float and type(value) is int:
        return float(value)
    if type(value) not in (get_args(kind) or (kind,)):
        wanted = " or ".join(k.__name__ for k in get_args(kind) or (kind,))
        raise CardError(f"{where}: expected {wanted}, got {value!r}")
    return value
