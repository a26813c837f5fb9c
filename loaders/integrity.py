"""Is a corpus what was written? Every file that is not, and every episode lost with it, by name.

``verify(folder, "size")`` hashes the small files, compares the sizes of shards and looks at the
first and last header and the end of each: that finds what is missing, cut, grown or swapped, but no
bit that changed within a shard. ``"full"`` reads everything and finds any changed bit. A damaged
shard is always read, to say which episodes are lost: those whose crc32 is no longer that of
``episodes.parquet``. What lies beside the shards (``beside``) is looked at as well.
"""

import os
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

from mint_hub.loaders.beside import annotation_files, read_annotation
from mint_hub.loaders.changelog import CHANGELOG, Changelog
from mint_hub.loaders.index import read_episodes
from mint_hub.loaders.manifest import (
    EPISODES,
    MANIFEST,
    STATS,
    FileRecord,
    Manifest,
    ShardRecord,
    read_manifest,
    read_sealed,
    record_of,
    split_folders,
)
from mint_hub.loaders.tar_layout import END, Buffer, CorpusError, key_at, map_file

if TYPE_CHECKING:
    import pyarrow as pa

__all__ = ["CorpusError", "FileReport", "Level", "Report", "Status", "verify"]

Level = Literal["size", "full"]
Status = Literal[
    "ok",
    "missing",
    "truncated",
    "longer",
    "swapped",
    "checksum",
    "extra",
    "unfinished",
]

_MEANINGS: Final[Mapping[str, str]] = {
    "missing": "is not there",
    "truncated": "was cut",
    "longer": "has bytes too many",
    "swapped": "holds something else",
    "checksum": "has changed",
    "extra": "is not of the corpus",
    "unfinished": "was never completed",
}


@dataclass(frozen=True)
class FileReport:
    """What was found about one file, or folder, of a corpus.

    Attributes:
        path: relative to the corpus that was verified.
        status: "ok", or what is wrong.
        detail: what was expected and what is there.
        samples: episodes that belong in it.
        num_lost: how many of them cannot be read from it.
        lost: their keys; empty, though ``num_lost`` is not, where the table that knows them is
            damaged as well.

    """

    path: str
    status: Status
    detail: str = ""
    samples: int = 0
    num_lost: int = 0
    lost: tuple[str, ...] = ()

    def __str__(self) -> str:
        if self.status == "ok":
            return f"{self.path}: ok"
        shown = ", ".join(self.lost[:5]) + (" ..." if len(self.lost) > 5 else "")
        lost = f"; lost {self.num_lost} of {self.samples} episodes" if self.samples else ""
        names = f": {shown}" if shown else ""
        return f"{self.path}: {self.status}, {_MEANINGS[self.status]}: {self.detail}{lost}{names}"


@dataclass(frozen=True)
class Report:
    """What ``verify`` found: one entry a file, in order."""

    folder: Path
    level: Level
    files: tuple[FileReport, ...]

    @property
    def ok(self) -> bool:
        """Whether everything is there, whole, and nothing more (as far as ``level`` looks)."""
        return not self.problems

    @property
    def problems(self) -> tuple[FileReport, ...]:
        """The entries that are not ok."""
        return tuple(file for file in self.files if file.status != "ok")

    @property
    def num_lost(self) -> int:
        """Episodes that cannot be read."""
        return sum(file.num_lost for file in self.files)

    @property
    def lost(self) -> tuple[str, ...]:
        """Keys of the lost episodes, as far as they are known."""
        return tuple(key for file in self.files for key in file.lost)

    def raise_for_problems(self) -> None:
        """Raise a CorpusError that names every problem, if there is any."""
        if not self.ok:
            raise CorpusError(str(self))

    def __str__(self) -> str:
        samples = sum(file.samples for file in self.files)
        head = (
            f"{self.folder}, level {self.level}: {len(self.files)} files, {samples} episodes, "
            f"{len(self.problems)} problems, {self.num_lost} episodes lost"
        )
        return "\n".join([head, *(str(file) for file in self.problems)])


def verify(folder: str | os.PathLike[str], level: Level = "size") -> Report:
    """Compare the files of a corpus, of one config or of one split with what was written.

    Nothing is changed and nothing raises because of damage: the report says it.

    Raises:
        CorpusError: there is no split at or below ``folder``, or another level.

    """
    if level not in ("size", "full"):
        raise CorpusError(f"level: expected 'size' or 'full', got {level!r}")
    root = Path(folder)
    splits = split_folders(root)
    files: list[FileReport] = []
    for split in splits:
        files += _Split(root, split, level).reports()
    known = {path.parent for pattern in (STATS, f"*/{STATS}") for path in root.glob(pattern)}
    for config in sorted(known | {path.parent for path in (*splits, *_unfinished(root))}):
        files += _config_reports(root, config)
    files += [FileReport(_name(p, root), "unfinished", _HOW_TO_GO_ON) for p in _unfinished(root)]
    files += _beside_reports(root)
    if not files:
        raise CorpusError(f"{root}: expected a corpus, a config or a split, got none")
    return Report(root, level, tuple(files))


_HOW_TO_GO_ON: Final = "write_corpus with the same arguments goes on, or delete it"


def _unfinished(root: Path) -> list[Path]:
    patterns = (".*.partial", "*/.*.partial")
    beside = [root.with_name(f".{root.name}.partial")]
    found = [*beside, *(path for pattern in patterns for path in root.glob(pattern))]
    return sorted(path for path in found if path.is_dir())


def _name(path: Path, root: Path) -> str:
    return os.path.relpath(path, root) if path != root else path.name


def _config_reports(root: Path, config: Path) -> Iterator[FileReport]:
    """Statistics: whole, and made from the shards that are there; every split they know is."""
    path = config / STATS
    name = _name(path, root)
    contents = {m.split: m.content for m in map(_manifest_of, config.glob("[!.]*/")) if m}
    if not path.exists():
        if contents:
            yield FileReport(name, "missing", f"expected statistics of {sorted(contents)}")
        return
    try:
        known = {s: str(v["content"]) for s, v in read_sealed(path)["splits"].items()}
    except (CorpusError, KeyError, TypeError, AttributeError) as error:
        yield FileReport(name, "checksum", str(error))
        return
    stale = sorted(s for s, content in contents.items() if known.get(s) != content)
    if stale:
        yield FileReport(name, "swapped", f"expected statistics of the shards of {stale}")
    else:
        yield FileReport(name, "ok")
    for split in sorted(known.keys() - {path.name for path in config.iterdir()}):
        if not (config / f".{split}.partial").exists():
            yield FileReport(_name(config / split, root), "missing", f"{name} knows this split")


def _beside_reports(root: Path) -> Iterator[FileReport]:
    """Changelog and hand annotations: whole, and none of a withdrawn video."""
    withdrawn = Changelog()
    if (root / CHANGELOG).exists():
        try:
            withdrawn = Changelog.load(root)
        except CorpusError as error:
            yield FileReport(CHANGELOG, "checksum", str(error))
        else:
            yield FileReport(CHANGELOG, "ok")
    for path in annotation_files(root):
        name = _name(path, root)
        try:
            read = read_annotation(path)
        except CorpusError as error:
            yield FileReport(name, "checksum", str(error))
            continue
        if withdrawn.has(read.uid, read.source):
            yield FileReport(name, "extra", f"the video {read.uid!r} is withdrawn: delete it")
        else:
            yield FileReport(name, "ok")


def _manifest_of(split: Path) -> Manifest | None:
    try:
        return read_manifest(split)
    except (CorpusError, OSError):
        return None


@dataclass(frozen=True)
class _Split:
    """One split while it is verified."""

    root: Path
    folder: Path
    level: Level

    def reports(self) -> Iterator[FileReport]:
        path = self.folder / MANIFEST
        try:
            manifest = self.manifest
        except CorpusError as error:
            status: Status = "checksum" if path.exists() else "missing"
            yield FileReport(self.name(MANIFEST), status, str(error))
            return
        place = Path(os.path.abspath(self.folder)).parts[-2:]
        if place != (manifest.config, manifest.split):
            detail = f"expected {place[0]}/{place[1]}, got {manifest.config}/{manifest.split}"
            yield FileReport(self.name(MANIFEST), "swapped", detail)
        else:
            yield FileReport(self.name(MANIFEST), "ok")
        for record in manifest.files:
            yield self.file(record)
        for number, record in enumerate(manifest.shards):
            yield self.shard(number, record)
        known = {MANIFEST, *(r.name for r in (*manifest.files, *manifest.shards))}
        for extra in sorted(p.name for p in self.folder.iterdir() if p.name not in known):
            yield FileReport(self.name(extra), "extra", "expected only what shards.json lists")

    def name(self, file: str) -> str:
        return os.path.relpath(self.folder / file, self.root)

    def file(self, record: FileRecord) -> FileReport:
        """Compare a small file by its hash."""
        found = self.size_of(record)
        if found is None:
            return FileReport(self.name(record.name), "missing", f"expected {record.bytes} bytes")
        if status := _size_status(found, record.bytes):
            detail = f"expected {record.bytes} bytes, got {found}"
            return FileReport(self.name(record.name), status, detail)
        if record_of(self.folder / record.name).sha256 != record.sha256:
            return FileReport(self.name(record.name), "checksum", f"expected {record.sha256}")
        return FileReport(self.name(record.name), "ok")

    def size_of(self, record: FileRecord) -> int | None:
        path = self.folder / record.name
        return path.stat().st_size if path.is_file() else None

    def shard(self, number: int, record: ShardRecord) -> FileReport:
        """Compare a shard; where it differs, find the episodes that are lost."""
        found = self.size_of(record)
        if found is None:
            lost = self.keys(number, None)
            return self.damaged(record, "missing", f"expected {record.bytes} bytes", lost)
        buffer = map_file(self.folder / record.name)
        differs = found != record.bytes
        if not differs and self.level == "full":
            differs = record_of(self.folder / record.name).sha256 != record.sha256
        if not differs and (self.level == "full" or self.edges_match(buffer, number)):
            return FileReport(self.name(record.name), "ok", samples=record.samples)
        if other := self.twin(number, found):
            return self.damaged(record, "swapped", f"holds {other}", self.keys(number, None))
        status = _size_status(found, record.bytes) or "checksum"
        detail = f"expected {record.bytes} bytes of sha256 {record.sha256[:12]}, got {found}"
        return self.damaged(record, status, detail, self.keys(number, buffer))

    def damaged(
        self, record: ShardRecord, status: Status, detail: str, lost: tuple[str, ...] | None
    ) -> FileReport:
        count = record.samples if lost is None else len(lost)
        name = self.name(record.name)
        return FileReport(name, status, detail, record.samples, count, lost or ())

    def twin(self, number: int, size: int) -> str | None:
        """Name the other shard whose bytes lie under the name of this one."""
        digest = None
        for other, record in enumerate(self.manifest.shards):
            if other != number and record.bytes == size:
                path = self.folder / self.manifest.shards[number].name
                digest = digest or record_of(path).sha256
                if record.sha256 == digest:
                    return record.name
        return None

    def edges_match(self, buffer: Buffer, number: int) -> bool:
        """Whether first and last sample are where they should be, and the end is an end."""
        rows = self.rows(number)
        if rows is None:
            return True  # the table is damaged, which is reported; sizes are all there is
        try:
            ends = (rows[0], rows[-1])
            same = all(key_at(buffer, r["offset"]) == r["key"] for r in ends)
        except CorpusError:
            return False
        return same and bytes(buffer[-len(END) :]) == END

    def keys(self, number: int, buffer: Buffer | None) -> tuple[str, ...] | None:
        """Keys of a shard that ``buffer`` (None: nothing) does not hold; None if none can say."""
        rows = self.rows(number)
        if rows is None:
            return None
        return tuple(str(r["key"]) for r in rows if buffer is None or not _holds(buffer, r))

    def rows(self, number: int) -> list[dict[str, Any]] | None:
        """Rows of one shard in ``episodes.parquet``; None where that file is damaged."""
        if self.table is None:
            return None
        samples = [shard.samples for shard in self.manifest.shards]
        return self.table.slice(sum(samples[:number]), samples[number]).to_pylist()

    @cached_property
    def manifest(self) -> Manifest:
        """What was written."""
        return read_manifest(self.folder)

    @cached_property
    def table(self) -> "pa.Table | None":
        """Where every episode should be; None where ``episodes.parquet`` is damaged."""
        record = next((r for r in self.manifest.files if r.name == EPISODES), None)
        if record is None or self.file(record).status != "ok":
            return None
        return read_episodes(self.folder, ["key", "offset", "size", "crc32"])


def _size_status(found: int, expected: int) -> Literal["truncated", "longer"] | None:
    if found == expected:
        return None
    return "truncated" if found < expected else "longer"


def _holds(buffer: Buffer, row: Mapping[str, Any]) -> bool:
    data = buffer[row["offset"] : row["offset"] + row["size"]]
    return len(data) == row["size"] and zlib.crc32(data) == row["crc32"]
