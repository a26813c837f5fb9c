"""The writer: episodes in, a split of a corpus out, whole or not at all.

A split is made in a hidden folder, ``.<split>.partial``, and renamed into place when every file of
it is there, so that nothing reads as complete that is not. A writer that died is called again with
the same arguments: shards that were finished are checked by sha256 and kept, and work goes on at
the right episode. The same episodes and ShardSpec give the same bytes, over any number of processes
and interruptions.

Order within a split: episodes that can be indexed (``len`` and ``[i]``) are shuffled as a whole by
``order.Order(len, seed)``; a stream, in slices or not, is shuffled through a buffer of
``shuffle_buffer`` episodes; ``seed=None`` keeps them as they come.
"""

import hashlib
import logging
import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO, Final

import numpy as np
from numpy.typing import NDArray

from mint_hub.loaders.action_stats import halvings_for
from mint_hub.loaders.index import (
    ShardSummary,
    build_index,
    episodes_schema,
    summarise,
    write_rows,
)
from mint_hub.loaders.manifest import (
    EPISODES,
    INDEX,
    MANIFEST,
    Manifest,
    read_manifest,
    record_of,
    write_sealed,
)
from mint_hub.loaders.members import Format
from mint_hub.loaders.parallel import in_order
from mint_hub.loaders.shard_source import (
    EncodedSample,
    Episodes,
    ExtraMembers,
    Indexed,
    encoded_samples,
    length_of,
)
from mint_hub.loaders.stats import CorpusStats, write_stats
from mint_hub.loaders.tar_layout import END, CorpusError
from mint_hub.loaders.unfinished import SHARD_BYTES, ShardSpec, UnfinishedSplit

__all__ = [
    "VALIDATION",
    "CorpusError",
    "CorpusReport",
    "Episodes",
    "ExtraMembers",
    "Indexed",
    "ShardSpec",
    "describe",
    "split_of",
    "write_corpus",
]

VALIDATION: Final = 0.02

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class CorpusReport:
    """What ``write_corpus`` wrote.

    ``kept_shards`` were finished by an earlier call; ``content`` is the hash over all shards.
    ``lost_scores`` episodes, of those that this call wrote, had presence scores that are not in the
    shards, as these have no ``extra.npy``.
    """

    folder: Path
    num_episodes: int
    num_frames: int
    num_bytes: int
    num_shards: int
    kept_shards: int
    content: str
    lost_scores: int = 0


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
    made_with: Mapping[str, Any] | None = None,
) -> CorpusReport:
    """Write one split, ``folder/config/split``, or go on where an interrupted call stopped.

    Args:
        episodes: a list or anything else with ``len`` and ``[i]``; a source in slices, such as
            ``LeRobotSlices``; an iterable; or a function without arguments that returns one.
        folder: the corpus.
        config: name of the config.
        split: name of the split.
        format: "compact" or "lossless".
        extra: whether samples have ``extra.npy``, exact times and presence scores. Without it, in
            either format, episodes lose their scores: they are counted in the report and one
            logged warning says so. Times that would be lost are refused.
        shard_bytes: size that no shard exceeds, unless one episode alone does.
        seed: of the shuffle; None keeps the order.
        num_procs: processes that encode; indexed episodes and slices are read in them as well.
        progress: show a bar, where there is a terminal.
        extra_members: gives further members of an episode, such as ``mp4``, by name.
        shuffle_buffer: episodes that a stream is shuffled through.
        made_with: arguments, by name and JSON-able, that the episodes are made with and their keys
            do not tell: an unfinished split that was begun with others is refused.

    Raises:
        CorpusError: the split exists; an unfinished one was begun with other arguments or episodes;
            two episodes have one key; samples differ in their members; there are no episodes.
        EpisodeError: an episode cannot be encoded in this format.
        OSError: a file could not be written. What was finished is kept for the next call.
        ValueError: ``num_procs`` is not at least 1.

    """
    if type(num_procs) is not int or num_procs < 1:
        raise ValueError(f"num_procs: expected a whole number of at least 1, got {num_procs!r}")
    spec = ShardSpec(config, split, format, extra, shard_bytes, seed, shuffle_buffer)
    final = Path(folder) / config / split
    work = UnfinishedSplit(final.with_name(f".{split}.partial"), spec, made_with or {})
    if final.exists():
        if work.folder.exists() and not work.files.exists():  # died after the very last step
            shutil.rmtree(work.folder)
            manifest = read_manifest(final)
            return _report(final, manifest, kept=len(manifest.shards))
        raise CorpusError(f"{final}: expected no such split yet; delete it to write it anew")
    made = episodes() if callable(episodes) else episodes
    length = length_of(made)
    kept = work.resume(length)
    written = work.keys()
    with closing(encoded_samples(made, spec, extra_members, num_procs, written)) as samples:
        lost_scores = _write_shards(work, samples, _bar(length, progress, len(written)))
    if lost_scores:
        _LOG.warning(
            "%s/%s: presence scores of %d episodes are not in the shards, which have no extra.npy: "
            "write them with extra=True (--extra) to keep scores",
            *(config, split, lost_scores),
        )
    report = _report(final, _finish(work, final, num_procs), kept)
    return replace(report, lost_scores=lost_scores)


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


# -------------------------------------------------------------- shards on disk


def _write_shards(work: UnfinishedSplit, samples: Iterator[EncodedSample], bar: Any) -> int:
    """Write all samples; return how many had presence scores that they do not hold."""
    lost_scores = 0

    def counted() -> Iterator[EncodedSample]:
        nonlocal lost_scores
        for sample in samples:
            lost_scores += sample.lost_scores
            yield sample

    samples_left, seen = counted(), set(work.keys())
    sample = next(samples_left, None)
    with bar:
        while sample is not None:
            partial = work.folder / f"shard.{os.getpid()}.partial"
            try:
                with open(partial, "wb") as file:
                    sample = _fill(work, file, sample, samples_left, seen, bar)
            except BaseException:
                partial.unlink(missing_ok=True)
                raise
    return lost_scores


def _fill(
    work: UnfinishedSplit,
    file: BinaryIO,
    first: EncodedSample,
    samples: Iterator[EncodedSample],
    seen: set[str],
    bar: Any,
) -> EncodedSample | None:
    """Write one shard; return the sample that did not fit, or None at the end."""
    digest, size = hashlib.sha256(), 0
    keys: list[str] = []
    sample: EncodedSample | None = first
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


def _check_sample(work: UnfinishedSplit, sample: EncodedSample, seen: set[str]) -> None:
    if sample.key in seen:
        raise CorpusError(
            f"key: expected every episode to have its own, got {sample.key!r} twice: leave out the "
            "input that comes a second time, or write the two to configs of their own"
        )
    seen.add(sample.key)
    work.members = work.members or sample.members
    if sample.members != work.members:
        raise CorpusError(
            f"episode {sample.key}: expected members {list(work.members)} like those before it, "
            f"got {list(sample.members)}"
        )


def _finish(work: UnfinishedSplit, final: Path, num_procs: int) -> Manifest:
    """Make index, table, statistics and manifest from the written shards; name the split."""
    if not work.shards:
        shutil.rmtree(work.folder)
        raise CorpusError(f"{final}: expected at least one episode, got none")
    spec = work.spec
    draft = Manifest(
        config=spec.config,
        split=spec.split,
        format=spec.format,
        members=work.members,
        num_frames=0,
        shards=tuple(work.shards),
        files=(),
        spec=asdict(spec),
    )
    manifest, stats = describe(work.files, draft, num_procs)
    write_stats(final.parent, spec.split, manifest.content, stats, work.folder)
    write_sealed(work.files / MANIFEST, manifest.to_dict())
    os.replace(work.files, final)
    shutil.rmtree(work.folder)
    return manifest


def describe(files: Path, draft: Manifest, num_procs: int) -> tuple[Manifest, CorpusStats]:
    """Write index and table of the shards in a folder; return its manifest and statistics.

    Args:
        files: where the shards are, all of them whole.
        draft: the manifest but for its ``files`` and ``num_frames``, which are found here.
        num_procs: processes that read.

    """
    from pyarrow import parquet

    rows: list[NDArray[np.void]] = []
    halvings = _halvings(files, draft)
    stats = CorpusStats(halvings)
    names = tuple(shard.name for shard in draft.shards)
    job = _Summarise(files, names, draft.members, halvings)
    summarised = in_order(job, range(len(draft.shards)), num_procs, 1)
    table = files / EPISODES
    with (
        closing(summarised) as summaries,
        parquet.ParquetWriter(table, episodes_schema(), compression="zstd") as writer,
    ):
        for summary in summaries:
            rows.append(summary.rows)
            stats.merge(summary.stats)
            writer.write_table(summary.episodes)
    write_rows(files / INDEX, np.concatenate(rows))
    manifest = replace(
        draft,
        num_frames=sum(int(r["num_frames"].sum()) for r in rows),
        files=tuple(record_of(files / name) for name in (INDEX, EPISODES)),
    )
    return manifest, stats


def _halvings(files: Path, draft: Manifest) -> int:
    """How few chunks of actions to look at, by the frames that the first shard makes expect."""
    first = draft.shards[0]
    frames = int(build_index(files / first.name)["num_frames"].sum())
    return halvings_for(frames * draft.num_bytes // first.bytes)


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
    shards: tuple[str, ...]
    members: tuple[str, ...]
    halvings: int

    def __call__(self, number: int) -> ShardSummary:
        path = self.files / self.shards[number]
        return summarise(path, number, self.members, self.halvings)


def _bar(length: int | None, progress: bool, done: int) -> Any:
    from tqdm import tqdm

    disable = None if progress else True
    return tqdm(total=length, initial=done, unit="episode", disable=disable)
