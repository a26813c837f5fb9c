"""Take every episode of some videos out of a corpus, for good.

Tombstones are written first, so that nothing that was asked for is forgotten; then every split that
holds such an episode is made anew beside itself, in ``.<split>.withdrawing``, and takes the old
one's place by renaming. Shards without such episodes keep their bytes and names. A call that was
killed is called again and finishes; until then each split is the old one, the new one, or missing,
never a mixture, and statistics that are not yet, or no longer, of its shards are refused.
"""

import datetime
import hashlib
import os
import shutil
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mint_hub.loaders.beside import Beside, labels_beside
from mint_hub.loaders.card import write_card
from mint_hub.loaders.changelog import Changelog, Tombstone, checked_date
from mint_hub.loaders.index import Index
from mint_hub.loaders.manifest import (
    MANIFEST,
    STATS,
    FileRecord,
    ShardRecord,
    read_sealed,
    record_of,
    split_folders,
    write_sealed,
)
from mint_hub.loaders.shards import describe
from mint_hub.loaders.stats import write_stats
from mint_hub.loaders.tar_layout import END, CorpusError, map_file

_SUFFIX: Final = ".withdrawing"


@dataclass(frozen=True)
class WithdrawReport:
    """What ``withdraw`` took out.

    Attributes:
        episodes: how many, by "config/split".
        removed_splits: the splits that held no more.
        beside: files and folders beside the shards, relative to the corpus (see ``beside``).

    """

    episodes: Mapping[str, int]
    removed_splits: tuple[str, ...]
    beside: tuple[str, ...] = ()


def withdraw(
    folder: str | os.PathLike[str],
    uids: Iterable[str],
    reason: str,
    *,
    source: str | None = None,
    date: str | None = None,
    num_procs: int = 1,
) -> WithdrawReport:
    """Take all episodes of some videos out of every config of a corpus; leave tombstones.

    Tombstones go to ``changelog.json`` and the card; the ``spec`` of a split made anew lists the
    uids under "withdrawn". A split that would be empty is removed. Labels of the videos beside the
    shards go as well (``beside``); the accounts of `mint-hub label`, which hold no labels, stay.
    Calling again with the same videos changes nothing. Copies elsewhere, packed clips in other
    folders included, are not known here.

    Args:
        folder: the corpus, with ``<config>/<split>`` below it.
        uids: names of the videos (``uid`` of their episodes).
        reason: published in the changelog.
        source: their data set; needed where two sources have a video of that name.
        date: YYYY-MM-DD; default: today, UTC.
        num_procs: processes that read the shards made anew.

    Raises:
        CorpusError: no such video, or of several sources; nothing would remain; a split is
            unfinished or damaged, or nobody can say whose a file beside the shards is. Nothing is
            changed then.

    """
    root, names = Path(folder), _checked(uids)
    day = checked_date(date or datetime.datetime.now(datetime.UTC).date().isoformat(), "date")
    _recover(root)
    splits = [_Split.load(path, names, source) for path in _splits(root)]
    changelog = Changelog.load(root)
    beside = [b for b in labels_beside(root) if b.uid in names and source in (None, b.source)]
    _check(root, splits, beside, names, source, changelog)
    hit = [split for split in splits if split.hits.any()]
    for split in hit:
        split.check_shards()
    _bury(root, changelog, hit, beside, reason, day)
    for labels in beside:
        shutil.rmtree(labels.path) if labels.path.is_dir() else labels.path.unlink()
    removed = [split for split in hit if split.hits.all()]
    for split in hit:
        split.remove() if split in removed else split.rewrite(num_procs)
    write_card(root)
    taken = {split.name: int(split.hits.sum()) for split in hit}
    files = tuple(a.path.relative_to(root).as_posix() for a in beside)
    return WithdrawReport(taken, tuple(split.name for split in removed), files)


@dataclass(frozen=True, eq=False)
class _Split:
    """A split, and which of its episodes go: ``hits`` (N,), ``videos`` their (source, uid)."""

    path: Path
    index: Index
    hits: NDArray[np.bool_]
    videos: tuple[tuple[str, str], ...]

    @classmethod
    def load(cls, path: Path, uids: frozenset[str], source: str | None) -> "_Split":
        index = Index.load(path)
        table = index.episodes(["source", "uid"]).to_pydict()
        videos = [(s or "", u) for s, u in zip(table["source"], table["uid"], strict=True)]
        hits = np.array([u in uids and source in (None, s) for s, u in videos], bool)
        gone = tuple(video for video, hit in zip(videos, hits, strict=True) if hit)
        return cls(path, index, hits, gone)

    @property
    def name(self) -> str:
        return f"{self.path.parent.name}/{self.path.name}"

    def check_shards(self) -> None:
        """Read the shards of which a part will be copied: what is damaged must not pass as whole.

        Raises:
            CorpusError: one is not what was written.

        """
        ends = self.index.first_rows
        for number, record in enumerate(self.index.manifest.shards):
            part = self.hits[ends[number] : ends[number + 1]]
            if not part.any() or part.all():
                continue
            path = self.index.paths[number]
            if not path.is_file() or record_of(path) != _file(record):
                raise CorpusError(f"{path}: expected the bytes that were written: run verify")

    def rewrite(self, num_procs: int) -> None:
        """Make the split anew without the episodes that go, then put it in its own place."""
        work = _work(self.path)
        files, manifest = work / "files", self.index.manifest
        files.mkdir(parents=True)
        shards = tuple(filter(None, (self._shard(n, files) for n in range(len(manifest.shards)))))
        before: list[str] = manifest.spec.get("withdrawn", [])
        spec = {**manifest.spec, "withdrawn": sorted({*before, *(uid for _, uid in self.videos)})}
        draft = replace(manifest, shards=shards, spec=spec)
        anew, stats = describe(files, draft, num_procs)
        write_sealed(files / MANIFEST, anew.to_dict())
        write_stats(self.path.parent, self.path.name, anew.content, stats, work)
        os.replace(self.path, work / "old")
        os.replace(files, self.path)
        shutil.rmtree(work)

    def remove(self) -> None:
        """Remove the whole split, its statistics too."""
        work = _work(self.path)
        work.mkdir()
        os.replace(self.path, work / "old")
        _forget(self.path)
        shutil.rmtree(work)

    def _shard(self, number: int, files: Path) -> ShardRecord | None:
        """Put what stays of a shard into a folder; None where nothing does."""
        first, last = self.index.first_rows[number : number + 2]
        stay = ~self.hits[first:last]
        record, path = self.index.manifest.shards[number], self.index.paths[number].resolve()
        if not stay.any():
            return None
        if stay.all():
            _link(path, files / record.name)
            return record
        rows, buffer = self.index.rows[first:last][stay], map_file(path)
        digest, size = hashlib.sha256(), 0
        with open(files / record.name, "wb") as file:
            parts = (buffer[int(r["offset"]) : int(r["offset"] + r["size"])] for r in rows)
            for part in _then(parts, END):
                file.write(part)
                digest.update(part)
                size += len(part)
            file.flush()
            os.fsync(file.fileno())
        return ShardRecord(record.name, size, digest.hexdigest(), len(rows))


def _checked(uids: Iterable[str]) -> frozenset[str]:
    names = frozenset([uids] if isinstance(uids, str) else uids)
    if not names or "" in names:
        raise CorpusError(f"uids: expected names of videos, got {sorted(names)}")
    return names


def _splits(root: Path) -> list[Path]:
    """Return the splits of a corpus, all of them finished."""
    if unfinished := sorted(root.glob("*/.*.partial")):
        raise CorpusError(
            f"{unfinished[0]}: expected finished splits only, got an unfinished one, which would "
            "bring withdrawn videos back: finish it, or delete that folder"
        )
    found = split_folders(root)
    if not found or any(path.parent.parent != root for path in found):
        raise CorpusError(f"{root}: expected a corpus, with <config>/<split> below it")
    return found


def _check(
    root: Path,
    splits: list[_Split],
    beside: list[Beside],
    uids: frozenset[str],
    source: str | None,
    changelog: Changelog,
) -> None:
    videos = _videos(splits, beside)
    sources = {uid: sorted(s for s, u in videos if u == uid) for uid in sorted(uids)}
    for uid, of in sources.items():
        if len(of) > 1:
            raise CorpusError(f"source: expected one of {of}, which all have a video {uid!r}")
        if not of and not changelog.has(uid, source):
            where = f"{root}, source {source}" if source else str(root)
            raise CorpusError(f"uids: expected videos of {where}, got {uid!r}, which is none")
    if all(split.hits.all() for split in splits):
        raise CorpusError(f"{root}: expected an episode to remain, got none: delete the folder")


def _videos(splits: list[_Split], beside: list[Beside]) -> set[tuple[str, str]]:
    """Return the (source, uid) of all that goes."""
    return {v for split in splits for v in split.videos} | {(b.source, b.uid) for b in beside}


def _bury(
    root: Path,
    log: Changelog,
    hit: list[_Split],
    beside: list[Beside],
    reason: str,
    day: str,
) -> None:
    """Write tombstones; one that a killed call has written already stays as it is."""
    stones = list(log.withdrawn)
    for source, uid in sorted(_videos(hit, beside)):
        if log.has(uid, source):
            continue
        counts = {split.name: split.videos.count((source, uid)) for split in hit}
        found = {name: count for name, count in counts.items() if count}
        stones.append(Tombstone(source, uid, day, reason, found))
    if len(stones) > len(log.withdrawn):
        replace(log, withdrawn=tuple(stones)).save(root)


# ------------------------------------------------------------------------ one after the other


def _recover(root: Path) -> None:
    """Finish what a killed call left: a new split that is whole takes its place, all else goes."""
    for work in sorted(root.glob(f"*/.*{_SUFFIX}")):
        path = work.with_name(work.name.removeprefix(".").removesuffix(_SUFFIX))
        if not path.exists():
            if (work / "files" / MANIFEST).exists():
                os.replace(work / "files", path)
            else:
                _forget(path)
        shutil.rmtree(work)


def _work(path: Path) -> Path:
    return path.with_name(f".{path.name}{_SUFFIX}")


def _forget(path: Path) -> None:
    """Take a split out of the statistics of its config."""
    stats = path.parent / STATS
    if not stats.exists():
        return
    values = read_sealed(stats)
    values["splits"].pop(path.name, None)
    write_sealed(stats, values) if values["splits"] else stats.unlink()


def _file(record: ShardRecord) -> FileRecord:
    return FileRecord(record.name, record.bytes, record.sha256)


def _link(path: Path, to: Path) -> None:
    try:
        os.link(path, to)
    except OSError:  # a file system without links
        shutil.copyfile(path, to)


def _then(parts: Iterable[bytes | memoryview], last: bytes) -> Iterator[bytes | memoryview]:
    yield from parts
    yield last
