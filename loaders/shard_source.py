"""What a split is written from: episodes in three kinds, encoded over processes, in one order.

Indexed episodes are read and encoded in the processes, in the order of ``order.Order``. A stream of
episodes is read here and encoded there. A source in slices (``Sliced``) is read there as well, a
slice at a time, and gives the samples that the stream of its episodes would give, in the same
order. Streams and slices are shuffled through a buffer.
"""

import hashlib
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from itertools import islice
from typing import Any, Final, Protocol, TypeVar, runtime_checkable

import numpy as np

from mint_hub.loaders.members import encode_all
from mint_hub.loaders.order import Order
from mint_hub.loaders.parallel import in_order
from mint_hub.loaders.schema import Episode
from mint_hub.loaders.tar_layout import CorpusError, pack_sample
from mint_hub.loaders.unfinished import ShardSpec

T = TypeVar("T")

ExtraMembers = Callable[[Episode], Mapping[str, bytes]]


@runtime_checkable
class Indexed(Protocol):
    """Episodes that can be counted and read in any order, such as a list or a corpus reader."""

    def __len__(self) -> int: ...

    def __getitem__(self, i: int, /) -> Episode: ...


@runtime_checkable
class Keyed(Protocol):
    """Indexed episodes whose keys are known without reading or making them."""

    def key(self, i: int, /) -> str:
        """Return the key of episode ``i``."""
        ...


@runtime_checkable
class Sliced(Protocol):
    """A stream of episodes in slices: iterates small descriptions, each read in any process.

    It travels to every process, which keeps it; the descriptions travel one by one.
    """

    def __iter__(self) -> Iterator[Any]: ...

    def read_slice(self, part: Any, /) -> Iterable[Episode]:
        """Yield the episodes of one slice."""
        ...


Made = Indexed | Sliced | Iterable[Episode]
Episodes = Made | Callable[[], Made]


@dataclass(frozen=True)
class EncodedSample:
    """An episode as bytes of a shard: headers, members and padding.

    ``lost_scores`` says that the episode has presence scores for which its members have no place.
    """

    key: str
    members: tuple[str, ...]
    data: bytes
    lost_scores: bool = False


def length_of(made: Made) -> int | None:
    """Return the number of episodes, where it is known beforehand."""
    return len(made) if isinstance(made, Indexed) else None


def encoded_samples(
    made: Made,
    spec: ShardSpec,
    extra_members: ExtraMembers | None = None,
    num_procs: int = 1,
    written: Sequence[str] = (),
) -> Generator[EncodedSample]:
    """Yield the samples of a split in its order, but those ``written`` already, over processes.

    The samples are the same for any number of processes. What is written is compared by key: all of
    it where the episodes are ``Keyed``, of others that are indexed only its ends, which are read;
    streams are read through it.

    Raises:
        CorpusError: what is written is not what these episodes begin with; a process died.
        EpisodeError: an episode cannot be encoded in this format.

    """
    encoder = _Encoder(spec, extra_members)
    if isinstance(made, Indexed):
        places = iter(Order(len(made), spec.seed).permute(0, np.arange(len(made))).tolist())
        ends = (0, len(written) - 1)
        for number, key in enumerate(written):
            place, got = next(places, None), key
            if place is None:
                got = None
            elif isinstance(made, Keyed):
                got = made.key(place)
            elif number in ends:
                got = made[place].key
            _check_written(number, key, got)
        yield from in_order(_ReadAndEncode(made, encoder), places, num_procs)
    elif isinstance(made, Sliced):
        with closing(in_order(_EncodeSlice(made, encoder), made, num_procs, 1)) as slices:
            samples = _shuffled((s for part in slices for s in part), spec)
            _pass_over(samples, written)
            yield from samples
    else:
        episodes = _shuffled(made, spec)
        _pass_over(episodes, written)
        yield from in_order(encoder, episodes, num_procs)


@dataclass(frozen=True)
class _Encoder:
    spec: ShardSpec
    extra_members: ExtraMembers | None

    def __call__(self, episode: Episode) -> EncodedSample:
        return self.together([episode])[0]

    def together(self, episodes: Sequence[Episode]) -> list[EncodedSample]:
        encoded = encode_all(episodes, self.spec.format, self.spec.extra)
        return [self._packed(*pair) for pair in zip(episodes, encoded, strict=True)]

    def _packed(self, episode: Episode, members: dict[str, bytes]) -> EncodedSample:
        if self.extra_members is not None:
            members.update(self.extra_members(episode))
        data = pack_sample(episode.key, members)
        lost = episode.presence_score is not None and not self.spec.extra
        return EncodedSample(episode.key, tuple(members), data, lost)


@dataclass(frozen=True)
class _ReadAndEncode:
    episodes: Indexed
    encoder: _Encoder

    def __call__(self, place: int) -> EncodedSample:
        return self.encoder(self.episodes[place])


@dataclass(frozen=True)
class _EncodeSlice:
    source: Sliced
    encoder: _Encoder

    def __call__(self, part: Any) -> list[EncodedSample]:
        samples: list[EncodedSample] = []
        waiting: list[Episode] = []
        frames = 0
        for episode in self.source.read_slice(part):
            waiting.append(episode)
            frames += episode.num_frames
            if frames >= _FRAMES_AT_ONCE:
                samples += self.encoder.together(waiting)
                waiting, frames = [], 0
        return samples + (self.encoder.together(waiting) if waiting else [])


_FRAMES_AT_ONCE: Final = 2048
"""Frames of a slice whose arrays are computed together: enough to hide what each call costs, few
enough to stay in the cache."""


def _pass_over(items: Iterator[Any], written: Sequence[str]) -> None:
    for number, key in enumerate(written):
        item = next(items, None)
        _check_written(number, key, None if item is None else item.key)


def _check_written(number: int, key: str, got: str | None) -> None:
    if got != key:
        raise CorpusError(
            f"episode {number} of an unfinished split: expected {key!r} as it was written, "
            f"got {got!r}: resume with the same episodes, or delete the .partial folder"
        )


def _shuffled(items: Iterable[T], spec: ShardSpec) -> Iterator[T]:
    """Yield all items, each drawn from a buffer by a hash of (seed, number of the draw)."""
    stream = iter(items)
    if spec.seed is None:
        yield from stream
        return
    buffer = list(islice(stream, spec.shuffle_buffer))
    draw = 0
    while buffer:
        digest = hashlib.sha256(f"{spec.seed}:{draw}".encode()).digest()
        place = int.from_bytes(digest[:8], "big") % len(buffer)
        buffer[place], buffer[-1] = buffer[-1], buffer[place]
        yield buffer.pop()
        buffer.extend(islice(stream, 1))
        draw += 1
