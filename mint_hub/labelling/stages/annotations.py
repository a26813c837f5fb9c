"""What others have written about a video: Ego4D narrations, EPIC-KITCHENS segments, EgoDex text, or
a table of the user's. Readers return `Described`, in seconds from the video's first frame.
"""

import csv
import json
import math
import re
from bisect import bisect_right
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, Final, Literal, cast

from mint_hub.conventions import Side
from mint_hub.labelling.records import Video
from mint_hub.labelling.stage import NotReadyError

Who = Side | Literal["both"] | None
FORMATS: Final = ("auto", "ego4d", "epic", "egodex", "csv")
POINT_S: Final = 4.0
"""Longest stretch that a narration of a single moment is taken to be about."""

_HANDS: Final = re.compile(r"\b(left|right|both|two)(?:\s+and\s+(left|right))?\s+hands?\b", re.I)
_EGO4D_PASSES: Final = ("narration_pass_1", "narration_pass_2")
_EPIC_COLUMNS: Final = ("narration_id", "video_id", "start_timestamp", "stop_timestamp")
_CSV_COLUMNS: Final = ("start", "end", "text")


@dataclass(frozen=True)
class Described:
    """What somebody said of a stretch of video.

    Attributes:
        start_s, stop_s: seconds, 0 at the video's first frame; start < stop.
        text: in words.
        side: which hand, None where nobody said.
        id: of the annotation, as its source has it.
        rule: how the stretch was told: "interval" as annotated, "point" from a moment to the next
            one of the same annotator but POINT_S at most, "whole" the whole video.
        source: which annotation.

    """

    start_s: float
    stop_s: float
    text: str
    side: Who
    id: str
    rule: Literal["interval", "point", "whole"]
    source: str


def side_of(text: str) -> Who:
    """Which hand a text speaks of.

    >>> side_of("C moves the cup to his left hand"), side_of("uses both hands"), side_of("walks")
    ('left', 'both', None)
    """
    named = {word.lower() for match in _HANDS.findall(text) for word in match if word}
    if named & {"both", "two"} or {"left", "right"} <= named:
        return "both"
    return "left" if "left" in named else "right" if "right" in named else None


def described(
    video: Video, path: str, form: str = "auto", point_s: float = POINT_S
) -> list[Described]:
    """Return what is said of a video, by start; empty where its annotations do not know it.

    Args:
        video: joined by ``uid`` (EgoDex: by file).
        path: the file; of EgoDex a file, a folder, or "" for the file beside the video.
        form: one of FORMATS; "auto" goes by the file's name and header.
        point_s: longest stretch of a narration of a moment.

    Raises:
        NotReadyError: there is no such file, or what reads it is not installed.
        ValueError: names file, place, expected and got.

    """
    form = _form(video, path, form)
    if form == "":
        return []
    if form == "egodex":
        return _egodex(video, path)
    file = Path(path)
    if not file.is_file():
        raise NotReadyError(f"describe: expected annotations at {path or 'path'}, got no file")
    if form == "ego4d":
        found = read_ego4d(file, video.uid, video.duration_s, point_s)
    else:
        found = read_epic(file, video.uid) if form == "epic" else read_csv(file, video.uid)
    return sorted(found, key=lambda item: (item.start_s, item.stop_s, item.id))


def _form(video: Video, path: str, form: str) -> str:
    if form not in FORMATS:
        raise ValueError(f"format: expected one of {', '.join(FORMATS)}, got {form!r}")
    if form != "auto":
        return form
    if not path:
        return "egodex" if video.source == "egodex" else ""
    if video.source == "egodex" and (Path(path).is_dir() or not path.endswith(".csv")):
        return "egodex"
    if path.endswith(".json"):
        return "ego4d"
    if Path(path).is_file():
        with open(path, newline="", encoding="utf-8-sig") as file:
            return "epic" if "narration_id" in next(csv.reader(file), []) else "csv"
    return "csv"


# --- Ego4D ----------------------------------------------------------------------------------------


def read_ego4d(
    path: Path, uid: str, duration_s: float, point_s: float = POINT_S
) -> list[Described]:
    """Read ``narration.json``: by video, passes of narrations of single moments.

    The first pass that the video has is read. A narration lasts until the next moment of its pass,
    ``point_s`` at most. What other people do ("#O ...") is left out, marks are taken off the text.

    Raises:
        ValueError: names file, video, field.

    """
    videos = _json(str(path), path.stat().st_mtime_ns)
    entry: Any = videos.get(uid, {})
    name = next((n for n in _EGO4D_PASSES if entry.get(n, {}).get("narrations")), None)
    if name is None:
        return []
    moments: list[tuple[float, str, str]] = []
    for number, item in enumerate(entry[name]["narrations"]):
        where = f"{path}: {uid}, {name}, narration {number}"
        try:
            time_s, text = float(item["timestamp_sec"]), str(item["narration_text"])
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(
                f"{where}: expected timestamp_sec and narration_text, got {item!r:.80}"
            ) from error
        moments.append((time_s, text, str(item.get("annotation_uid") or f"{name}-{number}")))
    moments.sort(key=lambda moment: moment[0])
    times = [moment[0] for moment in moments]
    found: list[Described] = []
    for time_s, text, name_of in moments:
        words = [word for word in text.split() if not word.startswith("#")]
        if text.lstrip().lower().startswith("#o") or not words or not 0 <= time_s < duration_s:
            continue
        after = bisect_right(times, time_s)
        following = times[after] if after < len(times) else duration_s
        stop_s = min(following, time_s + point_s, duration_s)
        said = " ".join(words)
        found.append(
            Described(time_s, stop_s, said, side_of(said), name_of, "point", f"ego4d {name}")
        )
    return found


@lru_cache(maxsize=1)
def _json(path: str, mtime_ns: int) -> dict[str, Any]:
    """Parse once for all videos; ``mtime_ns`` tells versions of the file apart."""
    try:
        value = json.loads(Path(path).read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{path}: expected JSON, got {error}") from None
    if not isinstance(value, dict):
        raise ValueError(f"{path}: expected narrations by video, got {type(value).__name__}")
    return cast("dict[str, Any]", value)


# --- tables ---------------------------------------------------------------------------------------


def read_epic(path: Path, uid: str) -> list[Described]:
    """Read the segments of one video from an EPIC-KITCHENS csv.

    Raises:
        ValueError: names file, line, column.

    """
    found: list[Described] = []
    for number, row in _rows(path, _EPIC_COLUMNS):
        if row["video_id"] != uid:
            continue
        span = [_clock(row[c], path, number, c) for c in ("start_timestamp", "stop_timestamp")]
        text = row.get("narration") or f"{row.get('verb', '')} {row.get('noun', '')}".strip()
        start_s, stop_s = _span(span[0], span[1], path, number)
        name = row["narration_id"]
        found.append(Described(start_s, stop_s, text, side_of(text), name, "interval", "epic"))
    return found


def read_csv(path: Path, uid: str) -> list[Described]:
    """Read a table with columns start, end, text, and if there are such, side, video and id.

    Times are seconds or clock times; side is left, right, both or empty (then the text may tell).
    With a column video only rows of this video count.

    Raises:
        ValueError: names file, line, column.

    """
    found: list[Described] = []
    for number, row in _rows(path, _CSV_COLUMNS):
        if row.get("video", uid) != uid:
            continue
        span = [_clock(row[c], path, number, c) for c in ("start", "end")]
        start_s, stop_s = _span(span[0], span[1], path, number)
        text, side = row["text"].strip(), row.get("side", "").strip().lower()
        if side not in ("", "left", "right", "both"):
            raise ValueError(
                f"{path}, line {number}, side: expected left, right, both or nothing, got {side!r}"
            )
        who = side_of(text) if side == "" else side
        name = row.get("id") or f"{path.stem}-{number}"
        found.append(Described(start_s, stop_s, text, who, name, "interval", "csv"))
    return found


def _rows(path: Path, columns: Sequence[str]) -> list[tuple[int, dict[str, str]]]:
    """Rows with the number of the line they end on; missing cells are empty."""
    with path.open(newline="", encoding="utf-8-sig") as file:
        reader = csv.DictReader(file, restval="")
        names = [name.strip() for name in reader.fieldnames or ()]
        missing = [name for name in columns if name not in names]
        if missing:
            raise ValueError(f"{path}: expected the columns {', '.join(missing)}, got {names}")
        reader.fieldnames = names
        return [(reader.line_num, {k: v for k, v in row.items() if k}) for row in reader]


def _clock(text: str, path: Path, line: int, column: str) -> float:
    """Seconds of "12.5", "1:02.5" or "00:01:02.500"."""
    try:
        parts = [float(part) for part in text.split(":")]
        if len(parts) > 3 or any(part < 0 for part in parts[1:]):
            raise ValueError
    except ValueError:
        raise ValueError(
            f"{path}, line {line}, {column}: expected seconds or h:m:s, got {text!r}"
        ) from None
    return sum(part * 60**power for power, part in enumerate(reversed(parts)))


def _span(start_s: float, stop_s: float, path: Path, line: int) -> tuple[float, float]:
    if not (0 <= start_s < stop_s and math.isfinite(stop_s)):
        raise ValueError(
            f"{path}, line {line}: expected 0 <= start < end, got {start_s:g} and {stop_s:g}"
        )
    return start_s, stop_s


# --- EgoDex ---------------------------------------------------------------------------------------


def _egodex(video: Video, path: str) -> list[Described]:
    file = _egodex_file(video, path)
    if file is None:
        return []
    text = egodex_text(_attributes(file))
    if not text:
        return []
    return [Described(0.0, video.duration_s, text, side_of(text), video.uid, "whole", "egodex")]


def egodex_text(attributes: Mapping[str, Any]) -> str:
    """Text among an EgoDex file's attributes: of a reversible task the direction that was done.

    >>> both = {"llm_type": "reversible", "llm_description": "open", "llm_description2": "close"}
    >>> egodex_text({**both, "which_llm_description": "2"}), egodex_text({"text": "fold"})
    ('close', 'fold')
    """
    values = {k: v.decode() if isinstance(v, bytes) else str(v) for k, v in attributes.items()}
    if values.get("which_llm_description") == "2" and values.get("llm_description2"):
        return values["llm_description2"].strip()
    return (values.get("llm_description") or values.get("text") or "").strip()


def _egodex_file(video: Video, path: str) -> Path | None:
    """Find a json sidecar before the HDF5 file."""
    if Path(path).is_file():
        return Path(path)
    folder = Path(path) if path else video.path.parent
    names = [
        name for stem in (video.uid, video.path.stem) for name in (f"{stem}.json", f"{stem}.hdf5")
    ]
    return next((folder / name for name in names if (folder / name).is_file()), None)


def _attributes(file: Path) -> dict[str, Any]:
    if file.suffix == ".json":
        return _json(str(file), file.stat().st_mtime_ns)
    try:
        import h5py  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise NotReadyError(
            f"{file}: EgoDex files are HDF5: install h5py (pip install 'mint-hub[egodex]'), or put "
            "the attributes beside it as .json"
        ) from None
    package: Any = h5py
    with package.File(file, "r") as opened:
        return dict(opened.attrs)
