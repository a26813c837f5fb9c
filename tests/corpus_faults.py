"""Faults done to a corpus and to its writer, and whether each was seen: rows of one table.

Every function does one kind of damage many times and returns a ``Row``. A case counts as detected
when the report names the damaged file and exactly the episodes that are lost with it, and as
resumed when a writer that was stopped, called again, gives the bytes of one that was not.
``python -m tests.corpus_faults`` prints the table, `benchmarks/faults.py` keeps it.
"""

import builtins
import errno
import multiprocessing
import os
import shutil
import signal
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mint_hub.loaders import shards
from mint_hub.loaders.index import Index
from mint_hub.loaders.integrity import verify
from mint_hub.loaders.manifest import split_folders
from mint_hub.loaders.reader import CorpusReader
from mint_hub.loaders.shards import write_corpus
from mint_hub.loaders.tar_layout import Sample, samples_in
from tests.episodes import make_episode

EPISODES = [
    replace(make_episode(6 + i % 3, seed=i, key=f"e-{i}"), presence_score=None) for i in range(9)
]
SHARD_BYTES = 24_000
BIT_FLIPS = 200
KILLS = 12
"""With one process, and as many with two."""


class Row(NamedTuple):
    """One line of the table; silent = cases - detected - resumed."""

    fault: str
    cases: int
    detected: int = 0
    resumed: int = 0

    @property
    def silent(self) -> int:
        return self.cases - self.detected - self.resumed


def write(folder: Path, num_procs: int = 1, episodes: object = EPISODES) -> Path:
    """Write the corpus of all faults, or go on writing it; return the split."""
    made = write_corpus(
        episodes, folder, "sample", "train", shard_bytes=SHARD_BYTES, num_procs=num_procs
    )
    return made.folder


def tree(folder: Path) -> dict[str, bytes]:
    """Every file below a folder."""
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def spans_of(path: Path) -> list[Sample]:
    return list(samples_in(path.read_bytes()))


def seen(root: Path, level: str, file: str, status: str, lost: list[str]) -> bool:
    """Whether the report names one problem, this one, with exactly these episodes."""
    report = verify(root, level)
    got = [(Path(p.path).name, p.status, list(p.lost), p.num_lost) for p in report.problems]
    return got == [(file, status, lost, len(lost))]


# ----------------------------------------------------------------- to a corpus


def cut_at_member_boundaries(root: Path, level: str) -> Row:
    """Cut a shard at every edge of every member, where other readers see a shorter shard."""
    path = Index.load(root / "sample/train").paths[1]
    data, spans = path.read_bytes(), spans_of(path)
    edges = {0, spans[-1].offset + spans[-1].size}
    for member in (m for s in spans for m in s.members):
        edges |= {member.offset - 512, member.offset, member.offset + member.size}
    hits = 0
    for edge in sorted(edges):
        path.write_bytes(data[:edge])
        lost = [s.key for s in spans if s.offset + s.size > edge]
        hits += seen(root, level, path.name, "truncated", lost)
    path.write_bytes(data)
    return Row(f"shard cut at a member boundary ({level})", len(edges), hits)


def flipped_bits(root: Path) -> Row:
    """Flip random bits anywhere in the config: shards, index, table, manifest, statistics."""
    files = sorted(p for p in (root / "sample").rglob("*") if p.is_file())
    sizes = np.array([p.stat().st_size for p in files])
    rng = np.random.default_rng(0)
    hits = 0
    for _ in range(BIT_FLIPS):
        path = files[int(rng.choice(len(files), p=sizes / sizes.sum()))]
        data = bytearray(path.read_bytes())
        clean = bytes(data)
        at = int(rng.integers(len(data)))
        spans = list(samples_in(clean)) if path.suffix == ".tar" else []
        lost = [s.key for s in spans if s.offset <= at < s.offset + s.size]
        data[at] ^= 1 << int(rng.integers(8))
        path.write_bytes(data)
        hits += seen(root, "full", path.name, "checksum", lost)
        path.write_bytes(clean)
    return Row("bit flipped in any file (full)", BIT_FLIPS, hits)


def flipped_bits_read(root: Path, verify: str) -> Row:
    """Flip random bits of samples and read all of them: detected where reading raises.

    A flip that reading survives is silent where an episode differs; bytes that say nothing (the
    padding of the archive) count as detected, since nothing is lost.
    """
    path = Index.load(root / "sample/train").paths[1]
    clean, span = path.read_bytes(), spans_of(path)
    episodes = list(CorpusReader(root, "sample"))
    rng = np.random.default_rng(1)
    hits = 0
    for _ in range(BIT_FLIPS):
        data = bytearray(clean)
        data[int(rng.integers(span[-1].offset + span[-1].size))] ^= 1 << int(rng.integers(8))
        path.write_bytes(data)
        try:
            read = list(CorpusReader(root, "sample", verify=verify))
        except ValueError as error:
            hits += path.name in str(error)
        else:
            hits += all(a.allclose(b, atol=0) for a, b in zip(read, episodes, strict=True))
    path.write_bytes(clean)
    return Row(f"bit flipped in a sample, read (verify={verify!r})", BIT_FLIPS, hits)


def missing_files(root: Path, level: str) -> Row:
    """Take away each file in turn."""
    files = sorted(p for p in (root / "sample").rglob("*") if p.is_file())
    hits = 0
    for path in files:
        lost = [s.key for s in spans_of(path)] if path.suffix == ".tar" else []
        away = root / "away"
        path.rename(away)
        hits += seen(root, level, path.name, "missing", lost)
        away.rename(path)
    return Row(f"file missing ({level})", len(files), hits)


def swapped_shards(root: Path, level: str) -> Row:
    """Exchange two shards."""
    pairs = list(combinations(Index.load(root / "sample/train").paths, 2))
    hits = 0
    for a, b in pairs:
        expected = [(p.name, "swapped", [s.key for s in spans_of(p)]) for p in (a, b)]
        _exchange(a, b)
        report = verify(root, level)
        hits += [(Path(p.path).name, p.status, list(p.lost)) for p in report.problems] == expected
        _exchange(a, b)
    return Row(f"shards swapped ({level})", len(pairs), hits)


def _exchange(a: Path, b: Path) -> None:
    a.rename(a.with_suffix(".x"))
    b.rename(a)
    a.with_suffix(".x").rename(b)


# --------------------------------------------------------------- to the writer


def killed_at_every_rename(folder: Path, whole: dict[str, bytes]) -> Row:
    """SIGKILL before and after each file gets its name, and before the split gets its own."""
    return _killed("writer killed at a rename", folder, whole, _die_at_rename, range(1000))


def killed_at_random_moments(folder: Path, whole: dict[str, bytes], num_procs: int) -> Row:
    """SIGKILL from outside at random moments of the time that a whole run takes."""
    began = time.monotonic()
    write(folder / "timed", num_procs)
    took = time.monotonic() - began
    moments = np.random.default_rng(num_procs).uniform(0, 0.8 * took, KILLS)

    def start(target: Path, moment: float) -> None:
        child = _child(write, target, num_procs)
        child.join(moment)
        child.kill()
        child.join()

    fault = f"writer killed at a random moment, {num_procs} processes"
    return _killed(fault, folder, whole, start, moments)


def _killed(fault: str, folder: Path, whole: dict[str, bytes], start: Callable, cases) -> Row:
    resumed = count = 0
    for number, case in enumerate(cases):
        target = folder / str(number)
        start(target, case)
        published = (target / "sample/train").exists()
        if published and not (target / "sample/.train.partial").exists():
            assert tree(target) == whole  # it was too late to kill it
            if isinstance(cases, range):
                break
            continue
        count += 1
        honest = published or not target.exists() or not split_folders(target)
        write(target)
        resumed += honest and tree(target) == whole
        shutil.rmtree(target)
    return Row(fault, count, resumed=resumed)


def _die_at_rename(target: Path, number: int) -> None:
    child = _child(_write_and_die, target, number)
    child.join()


def _write_and_die(target: Path, number: int) -> None:
    """Kill this process before (even numbers) or after (odd ones) the n-th rename."""
    rename, calls = os.replace, iter(range(10**9))

    def replace(a: os.PathLike, b: os.PathLike) -> None:
        call = next(calls)
        if call == number // 2 and number % 2 == 0:
            os.kill(os.getpid(), signal.SIGKILL)
        rename(a, b)
        if call == number // 2:
            os.kill(os.getpid(), signal.SIGKILL)

    os.replace = replace
    write(target)


def _child(function: Callable, *args: object) -> multiprocessing.Process:
    child = multiprocessing.get_context("fork").Process(target=function, args=args)
    child.start()
    return child


def full_disk(folder: Path, whole: dict[str, bytes]) -> Row:
    """Let the n-th write of a shard, or of a small file, say that no space is left."""
    resumed = cases = 0
    for number in range(0, 10**6, 2):
        target = folder / str(number)
        try:
            with _failing_writes(number):
                write(target)
            break
        except OSError as error:
            cases += 1
            silent = error.errno != errno.ENOSPC or bool(split_folders(target))
        write(target)
        resumed += tree(target) == whole and not silent
        shutil.rmtree(target)
    return Row("disk full at a write", cases, resumed=resumed)


class _failing_writes:  # noqa: N801
    """Within it, files opened for writing fail from the n-th write on."""

    def __init__(self, number: int) -> None:
        self.left = number
        self.open = builtins.open
        self.path_open = Path.open
        self.write_bytes = Path.write_bytes

    def __enter__(self) -> None:
        def opened(file, mode="r", *args, **kwargs):
            stream = self.open(file, mode, *args, **kwargs)
            return _Full(stream, self) if set(mode) & set("wax") else stream

        def path_opened(path, mode="r", *args, **kwargs):
            return opened(path, mode, *args, **kwargs)

        def wrote(path, data):
            with opened(path, "wb") as file:
                return file.write(data)

        shards.open = opened
        Path.open = path_opened
        Path.write_bytes = wrote

    def __exit__(self, *exception: object) -> None:
        del shards.open
        Path.open = self.path_open
        Path.write_bytes = self.write_bytes


class _Full:
    def __init__(self, stream, disk: _failing_writes) -> None:
        self._stream, self._disk = stream, disk

    def write(self, data: bytes) -> int:
        self._disk.left -= 1
        if self._disk.left < 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return self._stream.write(data)

    def __enter__(self):
        return self

    def __exit__(self, *exception: object) -> None:
        self._stream.close()

    def __getattr__(self, name: str):
        return getattr(self._stream, name)


# ------------------------------------------------------------------- the table


def table(folder: Path) -> list[Row]:
    """Do everything to corpora below an empty folder."""
    root = folder / "corpus"
    write(root)
    whole = tree(root)
    faults: list[Callable[[], Row]] = [
        *(lambda v=v: cut_at_member_boundaries(root, v) for v in ("size", "full")),
        lambda: flipped_bits(root),
        lambda: flipped_bits_read(root, "sample"),
        *(lambda v=v: missing_files(root, v) for v in ("size", "full")),
        *(lambda v=v: swapped_shards(root, v) for v in ("size", "full")),
        lambda: killed_at_every_rename(folder / "renames", whole),
        *(lambda n=n: killed_at_random_moments(folder / f"k{n}", whole, n) for n in (1, 2)),
        lambda: full_disk(folder / "full", whole),
    ]
    rows = [fault() for fault in faults]
    assert tree(root) == whole
    return rows


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as place:
        print(f"{'fault':52} {'cases':>6} {'detected':>9} {'resumed':>8} {'silent':>7}")  # noqa: T201
        for row in table(Path(place)):
            print(f"{row.fault:52} {row.cases:6} {row.detected:9} {row.resumed:8} {row.silent:7}")  # noqa: T201
