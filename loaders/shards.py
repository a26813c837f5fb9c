"""The writer: episodes in, a split of a corpus out, whole or not at all.

A split is made in a hidden folder, ``.<split>.partial``, and renamed into place when every file of
it is there, so that nothing reads as complete that is not. A writer that died is called again with
the same arguments: shards that were finished are checked by sha256 and kept, and work goes on at
the right episode. The same episodes and ShardSpec give the same bytes, over any number of processes
and interruptions.

Order within a split: episodes that can be indexed (``len`` and ``[i]``) are shuffled as a whole by
``order.Order(len, seed)``; a stream is shuffled through a buffer of ``shuffle_buffer`` episodes;
``seed=None`` keeps them as they come.
"""

import hashlib
import os
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass
from itertools import islice
from pathlib import Path
from typing import Any, BinaryIO, Final, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from mint_hub.loaders.index import ShardSummary, episodes_schema, summarise, write_rows
from mint_hub.loaders.manifest import (
    EPISODES,
    INDEX,
    MANIFEST,
    Manifest,
    read_manifest,
    record_of,
    write_sealed,
)
from mint_hub.loaders.members import Format, encode
from mint_hub.loaders.order import Order
from mint_hub.loaders.parallel import in_order
from mint_hub.loaders.schema import Episode
from mint_hub.loaders.stats import CorpusStats, write_stats
from mint_hub.loaders.tar_layout import END, CorpusError, pack_sample
from mint_hub.loaders.unfinished import SHARD_BYTES, ShardSpec, UnfinishedSplit

VALIDATION: Final = 0.02

ExtraMembers = Callable[[Episode], Mapping[str, bytes]]


@runtime_checkable
class Indexed(Protocol):
    """Episodes that can be counted and read in any order, such as a list or a corpus reader."""

    def __len__(self) -> int: ...

    def __getitem__(self, i: int, /) -> Episode: ...


Episodes = Indexed | Iterable[Episode] | Callable[[], Indexed | Iterable[Episode]]


@dataclass(frozen=True)
class CorpusReport:
    """What ``write_corpus`` wrote.

    ``kept_shards`` were finished by an earlier call; ``content`` is the hash over all shards.
    """

    folder: Path
    num_episodes: int
    num_frames: int
    num_bytes: int
    num_shards: int
    kept_shards: int
    content: str


def write_corpus(
    episodes: Episodes,
    folder: str | os.PathLike[str],
    config: str,
    split: str,
    *,
    format: Format = "compact",
    extra: bool = False,
    shard_bytes: int = SHARD_BYTES,
    seed: int | None = 0,
    num_procs: int = 1,
    progress: bool = False,
    extra_members: ExtraMembers | None = None,
    shuffle_buffer: int = 512,
) -> CorpusReport:
    """Write one split, ``folder/config/split``, or go on where an interrupted call stopped.

    Args:
        episodes: a list or anything else with ``len`` and ``[i]``; an iterable; or a function
            without arguments that returns either.
        folder: the corpus.
        config: name of the config.
        split: name of the split.
        format: "compact" or "lossless".
        extra: whether samples have ``extra.npy``, exact times and presence scores.
        shard_bytes: size that no shard exceeds, unless one episode alone does.
        seed: of the shuffle; None keeps the order.
        num_procs: processes that encode; indexed episodes are read in them as well.
        progress: show a bar, where there is a terminal.
        extra_members: gives further members of an episode, such as ``mp4``, by name.
        shuffle_buffer: episodes that a stream is shuffled through.

    Raises:
        CorpusError: the split exists; an unfinished one was begun with other arguments or episodes;
            two episodes have one key; samples differ in their members; there are no episodes.
        EpisodeError: an episode cannot be encoded in this format.
        OSError: a file could not be written. What was finished is kept for the next call.

    """
    spec = ShardSpec(config, split, format, extra, shard_bytes, seed, shuffle_buffer)
    final = Path(folder) / config / split
    work = UnfinishedSplit(final.with_name(f".{split}.partial"), spec)
    if final.exists():
        if work.folder.exists() and not work.files.exists():  # died after the very last step
            shutil.rmtree(work.folder)
            manifest = read_manifest(final)
            return _report(final, manifest, kept=len(manifest.shards))
        raise CorpusError(f"{final}: expected no such split yet; delete it to write it anew")
    made = episodes() if callable(episodes) else episodes
    source = _Source(made, spec)
    kept = work.resume(source.length)
    source.skip(work.keys())
    job = _Job(made if isinstance(made, Indexed) else None, spec, extra_members)
    with closing(in_order(job, source, num_procs)) as samples:
        _write_shards(work, samples, _bar(source, progress, len(work.keys())))
    return _report(final, _finish(work, final, num_procs), kept)


def split_of(uid: str, participant: str | None = None, *, validation: float = VALIDATION) -> str:
    """Return "train" or "validation": a law of the participant, or of the video where unknown.

    All episodes of a participant, and all of a video, are on one side; about ``validation`` of the
    groups are on the other. Nothing else matters: not the order, nor what else there is.

    >>> {split_of(f"video-{i}", participant="P01") for i in range(9)}
    {'train'}
    """
    group = f"uid:{uid}" if participant is None else f"participant:{participant}"
    number = int.from_bytes(hashlib.sha256(group.encode()).digest()[:8], "big")
    return "validation" if number < validation * 2**64 else "train"


# ------------------------------------------------------------- what to encode


class _Source:
    """Iterates what is to be encoded, in the order of the split: positions, or episodes."""

    def __init__(self, episodes: Indexed | Iterable[Episode], spec: ShardSpec) -> None:
        self._indexed = episodes if isinstance(episodes, Indexed) else None
        self.length = len(self._indexed) if self._indexed is not None else None
        self._items: Iterator[Any]
        if self._indexed is not None:
            self._items = iter(_permuted(len(self._indexed), spec.seed))
        else:
            assert isinstance(episodes, Iterable)
            buffered = _shuffled(episodes, spec.seed, spec.shuffle_buffer)
            self._items = iter(episodes) if spec.seed is None else buffered

    def __iter__(self) -> Iterator[Any]:
        return self._items

    def skip(self, keys: Sequence[str]) -> None:
        """Pass over what is written already; of indexed episodes only the ends are compared."""
        for number, key in enumerate(keys):
            item = next(self._items, None)
            if self._indexed is not None and item is not None:
                ends = number in (0, len(keys) - 1)
                got = self._indexed[item].key if ends else key
            else:
                got = None if item is None else item.key
            if got != key:
                raise CorpusError(
                    f"episode {number} of an unfinished split: expected {key!r} as it was written, "
                    f"got {got!r}: resume with the same episodes, or delete the .partial folder"
                )


def _permuted(length: int, seed: int | None) -> list[int]:
    return Order(length, seed).permute(0, np.arange(length)).tolist()


def _shuffled(episodes: Iterable[Episode], seed: int | None, size: int) -> Iterator[Episode]:
    """Yield all episodes, each drawn from a buffer by a hash of (seed, number of the draw)."""
    stream = iter(episodes)
    buffer = list(islice(stream, size))
    draw = 0
    while buffer:
        digest = hashlib.sha256(f"{seed}:{draw}".encode()).digest()
        place = int.from_bytes(digest[:8], "big") % len(buffer)
        buffer[place], buffer[-1] = buffer[-1], buffer[place]
        yield buffer.pop()
        buffer.extend(islice(stream, 1))
        draw += 1


@dataclass(frozen=True)
class _Sample:
    key: str
    members: tuple[str, ...]
    data: bytes


@dataclass(frozen=True)
class _Job:
    """Encodes one item; travels to every process once."""

    episodes: Indexed | None
    spec: ShardSpec
    extra_members: ExtraMembers | None

    def __call__(self, item: Any) -> _Sample:
        episode: Episode = item if self.episodes is None else self.episodes[item]
        members = encode(episode, self.spec.format, self.spec.extra)
        if self.extra_members is not None:
            members.update(self.extra_members(episode))
        return _Sample(episode.key, tuple(members), pack_sample(episode.key, members))


# -------------------------------------------------------------- shards on disk


def _write_shards(work: UnfinishedSplit, samples: Iterator[_Sample], bar: Any) -> None:
    seen = set(work.keys())
    sample = next(samples, None)
    with bar:
        while sample is not None:
            partial = work.folder / f"shard.{os.getpid()}.partial"
            try:
                with open(partial, "wb") as file:
                    sample = _fill(work, file, sample, samples, seen, bar)
            except BaseException:
                partial.unlink(missing_ok=True)
                raise


def _fill(
    work: UnfinishedSplit,
    file: BinaryIO,
    first: _Sample,
    samples: Iterator[_Sample],
    seen: set[str],
    bar: Any,
) -> _Sample | None:
    """Write one shard; return the sample that did not fit, or None at the end."""
    digest, size = hashlib.sha256(), 0
    keys: list[str] = []
    sample: _Sample | None = first
    room = work.spec.shard_bytes - len(END)
    while sample is not None and (not keys or size + len(sample.data) <= room):
        _check_sample(work, sample, seen)
        file.write(sample.data)
        digest.update(sample.data)
        size += len(sample.data)
        keys.append(sample.key)
        bar.update()
        sample = next(samples, None)
    file.write(END)
    digest.update(END)
    file.flush()
    os.fsync(file.fileno())
    work.finish_shard(Path(file.name), digest.hexdigest(), size + len(END), keys)
    return sample


def _check_sample(work: UnfinishedSplit, sample: _Sample, seen: set[str]) -> None:
    if sample.key in seen:
        raise CorpusError(f"key: expected every episode to have its own, got {sample.key!r} twice")
    seen.add(sample.key)
    work.members = work.members or sample.members
    if sample.members != work.members:
        raise CorpusError(
            f"episode {sample.key}: expected members {list(work.members)} like those before it, "
            f"got {list(sample.members)}"
        )


def _finish(work: UnfinishedSplit, final: Path, num_procs: int) -> Manifest:
    """Make index, table, statistics and manifest from the written shards; name the split."""
    from pyarrow import parquet

    if not work.shards:
        shutil.rmtree(work.folder)
        raise CorpusError(f"{final}: expected at least one episode, got none")
    spec, stats = work.spec, CorpusStats()
    rows: list[NDArray[np.void]] = []
    numbers = range(len(work.shards))
    summarised = in_order(_Summarise(work.files, spec, work.members), numbers, num_procs, 1)
    table = work.files / EPISODES
    with (
        closing(summarised) as summaries,
        parquet.ParquetWriter(table, episodes_schema(), compression="zstd") as writer,
    ):
        for summary in summaries:
            rows.append(summary.rows)
            stats.merge(summary.stats)
            writer.write_table(summary.episodes)
    write_rows(work.files / INDEX, np.concatenate(rows))
    manifest = Manifest(
        config=spec.config,
        split=spec.split,
        format=spec.format,
        members=work.members,
        num_frames=sum(int(r["num_frames"].sum()) for r in rows),
        shards=tuple(work.shards),
        files=tuple(record_of(work.files / name) for name in (INDEX, EPISODES)),
        spec=asdict(spec),
    )
    write_stats(final.parent, spec.split, manifest.content, stats, work.folder)
    write_sealed(work.files / MANIFEST, manifest.to_dict())
    os.replace(work.files, final)
    shutil.rmtree(work.folder)
    return manifest


def _report(final: Path, manifest: Manifest, kept: int) -> CorpusReport:
    return CorpusReport(
        folder=final,
        num_episodes=manifest.num_episodes,
        num_frames=manifest.num_frames,
        num_bytes=manifest.num_bytes,
        num_shards=len(manifest.shards),
        kept_shards=kept,
        content=manifest.content,
    )


@dataclass(frozen=True)
class _Summarise:
    files: Path
    spec: ShardSpec
    members: tuple[str, ...]

    def __call__(self, number: int) -> ShardSummary:
        return summarise(self.files / self.spec.shard_name(number), number, self.members)


def _bar(source: _Source, progress: bool, done: int) -> Any:
    from tqdm import tqdm

    total, disable = source.length, None if progress else True
    return tqdm(total=total, initial=done, unit="episode", disable=disable)
