"""Bytes of a shard: a plain ustar archive whose samples are whole, contiguous and reproducible.

A shard is a run of samples, then two zero blocks. A sample is its members, each a 512-byte header
and its data padded to 512 bytes; the name of a member is ``<key>.<member>``. Headers hold no date,
owner or machine (mtime 0, uid 0, mode 0644), so that equal samples are equal bytes. Nothing is
compressed: the data of a member can be memory-mapped.

>>> sample = pack_sample("a", {"json": b"{}", "traj.npy": b"12345"})
>>> len(sample)
2048
>>> [(m.name, m.offset, m.size) for m in members_at(sample, 0, len(sample))]
[('json', 512, 2), ('traj.npy', 1536, 5)]
"""

import os
import tarfile
from collections.abc import Iterator, Mapping
from functools import cache
from mmap import ACCESS_READ, mmap
from pathlib import Path
from typing import Final, NamedTuple

from mint_hub.loaders.fields import KEY_PATTERN

BLOCK: Final = 512
END: Final = bytes(2 * BLOCK)
"""What closes an archive; without it a shard was cut, even at the edge of a member."""

SUFFIX: Final = ".tar"
MAX_NAME: Final = 100
"""Longest ``<key>.<member>`` that fits a plain header."""

Buffer = bytes | mmap | memoryview


class CorpusError(ValueError):
    """Files of a corpus are missing, damaged, or not what was expected."""


class Member(NamedTuple):
    """Where the data of one member lies: ``buffer[offset : offset + size]``."""

    name: str
    offset: int
    size: int


class Sample(NamedTuple):
    """Where a sample lies: ``buffer[offset : offset + size]``, headers and padding included."""

    key: str
    offset: int
    size: int
    members: tuple[Member, ...]


def padded(size: int) -> int:
    """Return ``size`` rounded up to whole blocks."""
    return -(-size // BLOCK) * BLOCK


def pack_sample(key: str, members: Mapping[str, bytes]) -> bytes:
    """Return the bytes of one sample, members in the mapping's order.

    Raises:
        CorpusError: a key that is not [a-z0-9_-]+, or a name too long for a plain header.

    """
    if not KEY_PATTERN.fullmatch(key):
        raise CorpusError(f"key: expected only a-z, 0-9, '_' and '-', got {key!r}")
    parts: list[bytes] = []
    for name, data in members.items():
        parts += [_header(f"{key}.{name}", len(data)), data, bytes(padded(len(data)) - len(data))]
    return b"".join(parts)


def members_at(buffer: Buffer, offset: int, size: int, where: str = "") -> tuple[Member, ...]:
    """Return the members of the sample that fills ``buffer[offset : offset + size]``.

    Raises:
        CorpusError: the bytes there are not whole members of exactly that length.

    """
    members: list[Member] = []
    key: str | None = None
    at, stop = offset, offset + size
    while at < stop:
        entry = _entry(buffer, at, where)
        key = key if key is not None or entry is None else entry[0]
        if entry is None or entry[0] != key or at + BLOCK + padded(entry[2]) > stop:
            raise CorpusError(f"{where}: expected one sample of {size} bytes at {offset}")
        members.append(Member(entry[1], at + BLOCK, entry[2]))
        at += BLOCK + padded(entry[2])
    return tuple(members)


def key_at(buffer: Buffer, offset: int, where: str = "") -> str:
    """Return the key of the sample whose first header is at ``offset``.

    Raises:
        CorpusError: there is no header.

    """
    entry = _entry(buffer, offset, where)
    if entry is None:
        raise CorpusError(f"{where}: expected a sample at byte {offset}, got the end of the shard")
    return entry[0]


def samples_in(buffer: Buffer, where: str = "") -> Iterator[Sample]:
    """Yield the samples of a shard's bytes in order; raises where they stop making sense.

    Raises:
        CorpusError: a header is damaged, data is cut, or the two closing zero blocks are missing;
            whatever was whole before it has been yielded.

    """
    at, start, key = 0, 0, ""
    members: list[Member] = []
    while (entry := _entry(buffer, at, where)) is not None:
        stop = at + BLOCK + padded(entry[2])
        if stop > len(buffer):
            raise CorpusError(f"{where}: expected {stop} bytes, got {len(buffer)}, episode {key}")
        if members and entry[0] != key:
            yield Sample(key, start, at - start, tuple(members))
            members = []
        if not members:
            start, key = at, entry[0]
        members.append(Member(entry[1], at + BLOCK, entry[2]))
        at = stop
    if members:
        yield Sample(key, start, at - start, tuple(members))
    if len(buffer) != at + len(END) or bytes(buffer[at:]) != END:
        raise CorpusError(
            f"{where}: expected {len(END)} zero bytes after the last sample at byte {at} and "
            f"nothing more, got {len(buffer) - at} bytes"
        )


def map_file(path: str | os.PathLike[str]) -> Buffer:
    """Memory-map a file for reading; an empty one is ``b""``.

    Raises:
        CorpusError: there is no such file.

    """
    try:
        with Path(path).open("rb") as file:
            empty = os.fstat(file.fileno()).st_size == 0
            return b"" if empty else mmap(file.fileno(), 0, access=ACCESS_READ)
    except FileNotFoundError:
        raise CorpusError(f"{path}: expected this file, got none") from None


def _header(name: str, size: int) -> bytes:
    if len(name) > MAX_NAME:
        raise CorpusError(f"{name}: expected at most {MAX_NAME} characters, got {len(name)}")
    encoded, octal = name.encode("ascii"), b"%011o" % size
    if len(octal) > 11:
        raise CorpusError(f"{name}: expected at most 8 GiB, got {size} bytes")
    head, total = _blank_header()
    # The sum of all bytes, with the eight of the sum itself as spaces.
    total += sum(encoded) + sum(octal) - 11 * ord("0")
    name_field = encoded.ljust(MAX_NAME, b"\0")
    return b"".join(
        (name_field, head[MAX_NAME:124], octal, head[135:148], b"%06o\0 " % total, head[156:])
    )


@cache
def _blank_header() -> tuple[bytes, int]:
    """Return the header of an empty file without a name, and the sum that it states."""
    head = tarfile.TarInfo("").tobuf(tarfile.USTAR_FORMAT)
    return head, int(head[148:154], 8)


def _entry(buffer: Buffer, at: int, where: str) -> tuple[str, str, int] | None:
    """Return (key, member, size) of the header at ``at``; None at zeros, the end of the samples."""
    block = bytes(buffer[at : at + BLOCK])
    if len(block) < BLOCK:
        got = f"{len(block)} bytes"
        raise CorpusError(f"{where}: expected a header or zeros at byte {at}, got {got}")
    if block[0] == 0 and not any(block):
        return None
    try:
        size = int(block[124:135], 8)
        key, dot, member = block[:MAX_NAME].rstrip(b"\0").decode("ascii").partition(".")
    except ValueError as error:
        raise CorpusError(f"{where}: expected a header at byte {at}, got: {error}") from None
    if block[148:156] != b"%06o\0 " % (sum(block) - sum(block[148:156]) + 8 * 0x20) or not dot:
        raise CorpusError(f"{where}: the header at byte {at} is damaged")
    return key, member, size
