"""In which order samples are read: a law of (seed, epoch) alone, never of ranks or workers.

``Order`` is a permutation that is computed, not stored: no list of N indices, any position at once.
``ElasticSampler`` deals its positions out to ranks and workers so that after any number of steps
what has been read is a prefix of the order. The state of a run is therefore two numbers, epoch and
position, and says nothing about how many ranks or workers there were.

>>> Order(5, seed=0).permute(epoch=0, positions=[0, 1, 2, 3, 4]).tolist()
[0, 3, 2, 1, 4]
>>> left, right = (ElasticSampler(5, seed=0, rank=rank, world_size=2) for rank in (0, 1))
>>> list(left), list(right)
([0, 2, 4], [3, 1])
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

ROUNDS: Final = 6
"""Feistel rounds. Four already make a pseudo-random permutation (Luby and Rackoff 1988)."""

_GOLDEN: Final = np.uint64(0x9E3779B97F4A7C15)
_MIX_1: Final = np.uint64(0xBF58476D1CE4E5B9)
_MIX_2: Final = np.uint64(0x94D049BB133111EB)
_CHUNK: Final = 4096
"""Positions that an iterating sampler permutes at once."""


@dataclass(frozen=True)
class Order:
    """A permutation of ``range(num_samples)`` for every epoch, in O(1) memory.

    A position p is written in mixed radix as p = high * b + low with a * b >= N and a, b near the
    root of N; a Feistel network adds a hash of one digit to the other, turn by turn, which is a
    bijection of range(a * b). Results >= N are sent through again until they fall below ("cycle
    walking", Black and Rogaway 2002), which makes it one of range(N).

    Args:
        num_samples: N, at least 0 and at most 2**62.
        seed: any integer; None keeps the natural order in every epoch.

    Raises:
        ValueError: ``num_samples`` is out of range.

    """

    num_samples: int
    seed: int | None = 0

    def __post_init__(self) -> None:
        if not 0 <= self.num_samples <= 2**62:
            raise ValueError(f"num_samples: expected 0 .. 2**62, got {self.num_samples}")

    def permute(self, epoch: int, positions: ArrayLike) -> NDArray[np.int64]:
        """Return which sample is read at each position of an epoch: same shape, int64.

        Raises:
            ValueError: a position outside 0 .. N - 1, or one that is not an integer.

        """
        place = np.asarray(positions)
        if place.size and place.dtype.kind not in "iu":
            raise ValueError(f"positions: expected integers, got {place.dtype}")
        if place.size and (place.min() < 0 or place.max() >= self.num_samples):
            raise ValueError(
                f"positions: expected 0 .. {self.num_samples - 1}, "
                f"got {place.min()} .. {place.max()}"
            )
        if self.seed is None or not place.size:
            return place.astype(np.int64)
        keys = _round_keys(self.seed, epoch)
        result = self._feistel(place.astype(np.uint64).ravel(), keys)
        while (outside := np.flatnonzero(result >= np.uint64(self.num_samples))).size:
            result[outside] = self._feistel(result[outside], keys)
        return result.astype(np.int64).reshape(place.shape)

    def _feistel(self, values: NDArray[np.uint64], keys: list[np.uint64]) -> NDArray[np.uint64]:
        a = math.isqrt(max(self.num_samples - 1, 0)) + 1
        b = -(-self.num_samples // a)
        high, low = np.divmod(values, np.uint64(b))
        for turn, key in enumerate(keys):
            if turn % 2:
                low = (low + _hash(high, key)) % np.uint64(b)
            else:
                high = (high + _hash(low, key)) % np.uint64(a)
        return high * np.uint64(b) + low


class ElasticSampler:
    """The part of an order that one worker of one rank reads, and the state of the whole run.

    Steps count batches of ``batch_size`` samples a rank. In step s, rank r reads the positions
    from ``start + (s * world_size + r) * batch_size`` on; its worker w makes the steps with
    s % num_workers == w, which is how torch's DataLoader takes batches from its workers. So after s
    steps of every rank, exactly the first ``s * world_size * batch_size`` positions are read, and a
    run of another size goes on there. Every sample comes exactly once an epoch.

    A sampler is a cursor: iterating gives the rest of the epoch, one index at a time (``batches()``
    gives arrays), and at its end the cursor stands before the next epoch. Of one worker alone
    ``state_dict()`` holds for the moment when the other workers have come as far; a training loop
    counts the steps of its rank instead and asks for ``state_dict(steps=...)``.

    Args:
        num_samples: N.
        seed: of the order; None reads in natural order.
        rank: of ``world_size`` ranks.
        world_size: number of ranks, each of which takes the same number of steps.
        worker: of the rank's ``num_workers``.
        num_workers: 0 (the rank itself reads) is the same as 1.
        batch_size: samples that a rank reads in one step.
        drop_last: leave out, at the end of an epoch, the samples that do not fill a step of all
            ranks; otherwise the last batches are shorter, or missing on some ranks.

    Raises:
        ValueError: a count below its least value, or a rank or worker that does not exist.

    """

    def __init__(
        self,
        num_samples: int,
        seed: int | None = 0,
        rank: int = 0,
        world_size: int = 1,
        worker: int = 0,
        num_workers: int = 0,
        *,
        batch_size: int = 1,
        drop_last: bool = False,
    ) -> None:
        self.order = Order(num_samples, seed)
        self.batch_size = _at_least("batch_size", batch_size, 1)
        self.world_size = _at_least("world_size", world_size, 1)
        self.num_workers = max(_at_least("num_workers", num_workers, 0), 1)
        self.rank = _index("rank", rank, self.world_size)
        self.worker = _index("worker", worker, self.num_workers)
        self.drop_last = drop_last
        self.epoch = 0
        self._start = 0
        self._steps = 0

    @property
    def position(self) -> int:
        """How many samples of this epoch all ranks have read together."""
        return min(self._start + self._steps * self._stride, self.order.num_samples)

    @property
    def num_steps(self) -> int:
        """Steps of this rank from the cursor to the end of the epoch, of all its workers."""
        first = self.position + self.rank * self.batch_size
        return max(0, -(-(self._stop() - first) // self._stride))

    def __len__(self) -> int:
        """Samples that this worker still reads in this epoch."""
        first, stride, stop = self._first(), self._stride * self.num_workers, self._stop()
        batches = max(0, -(-(stop - first) // stride))
        last = first + (batches - 1) * stride
        return (batches - 1) * self.batch_size + min(self.batch_size, stop - last) if batches else 0

    def for_worker(self, worker: int, num_workers: int) -> "ElasticSampler":
        """Return a sampler for one of this rank's workers, from where this cursor stands."""
        mine = ElasticSampler(
            self.order.num_samples,
            self.order.seed,
            self.rank,
            self.world_size,
            worker,
            num_workers,
            batch_size=self.batch_size,
            drop_last=self.drop_last,
        )
        mine.load_state_dict(self.state_dict())
        return mine

    def set_epoch(self, epoch: int) -> None:
        """Go to the beginning of an epoch."""
        self.epoch, self._start, self._steps = _at_least("epoch", epoch, 0), 0, 0

    def __iter__(self) -> Iterator[int]:
        """Yield the indices of the rest of the epoch; a batch counts as read when it is begun."""
        for batch in self.batches():
            yield from batch.tolist()

    def batches(self) -> Iterator[NDArray[np.int64]]:
        """Yield the rest of the epoch as (batch_size,) int64 arrays; the last may be shorter."""
        ahead = max(1, _CHUNK // self.batch_size)
        spans = self._spans(ahead)
        while spans:
            where = np.concatenate([np.arange(start, stop) for start, stop in spans])
            indices = self.order.permute(self.epoch, where)
            cuts = np.cumsum([stop - start for start, stop in spans])[:-1]
            for batch in np.split(indices, cuts):
                self._steps += self.num_workers
                yield batch
            spans = self._spans(ahead)
        self.set_epoch(self.epoch + 1)

    def state_dict(self, steps: int | None = None) -> dict[str, Any]:
        """Return where the run stands, in plain values: the same for every rank and worker.

        Args:
            steps: batches that each rank has received since the cursor was last set (at the start
                of an epoch or by ``load_state_dict``); None: as many as this sampler has given,
                times its number of workers.

        """
        position = self.position
        if steps is not None:
            done = self._start + _at_least("steps", steps, 0) * self._stride
            position = min(done, self.order.num_samples)
        state = {"epoch": self.epoch, "position": position}
        return {**state, "num_samples": self.order.num_samples, "seed": self.order.seed}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go where a run stood, whatever its ranks, workers and batches were.

        Raises:
            ValueError: the state is of another number of samples or another seed, or is not one.

        """
        for name, mine in (("num_samples", self.order.num_samples), ("seed", self.order.seed)):
            if name not in state or state[name] != mine:
                raise ValueError(f"state {name}: expected {mine}, got {state.get(name)!r}")
        position = _at_least("state position", state.get("position", -1), 0)
        if position > self.order.num_samples:
            raise ValueError(
                f"state position: expected at most {self.order.num_samples}, got {position}"
            )
        self.set_epoch(state.get("epoch", -1))
        self._start = position

    @property
    def _stride(self) -> int:
        return self.world_size * self.batch_size

    def _stop(self) -> int:
        rest = self.order.num_samples - self._start
        return self._start + (rest - rest % self._stride if self.drop_last else rest)

    def _first(self) -> int:
        steps = self._steps + self.worker
        return self._start + steps * self._stride + self.rank * self.batch_size

    def _spans(self, most: int) -> list[tuple[int, int]]:
        """Positions (start, stop) of this worker's next batches, ``most`` of them at most."""
        first, stride, stop = self._first(), self._stride * self.num_workers, self._stop()
        starts = range(first, min(stop, first + most * stride), stride)
        return [(start, min(start + self.batch_size, stop)) for start in starts]


def uniform(seed: int, epoch: int, samples: ArrayLike) -> NDArray[np.float64]:
    """Return one number in [0, 1) for each sample, a function of (seed, epoch, sample) alone."""
    key = np.random.SeedSequence([*_words(seed), epoch, 1]).generate_state(1, np.uint64)[0]
    mixed = _hash(np.asarray(samples, np.int64).astype(np.uint64), key)
    return (mixed >> np.uint64(10)).astype(np.float64) * 2.0**-53


def _words(seed: int) -> tuple[int, int]:
    return abs(seed), int(seed < 0)


def _round_keys(seed: int, epoch: int) -> list[np.uint64]:
    sequence = np.random.SeedSequence([*_words(seed), epoch])
    return list(sequence.generate_state(ROUNDS, np.uint64))


def _hash(values: NDArray[np.uint64], key: np.uint64) -> NDArray[np.uint64]:
    """Mix 64 bits (the finaliser of SplitMix64, Steele et al. 2014); overflow wraps as meant."""
    x = (values + _GOLDEN) ^ key
    x = (x ^ (x >> np.uint64(30))) * _MIX_1
    x = (x ^ (x >> np.uint64(27))) * _MIX_2
    return (x ^ (x >> np.uint64(31))) >> np.uint64(1)


def _at_least(name: str, value: Any, least: int) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or value < least:
        raise ValueError(f"{name}: expected an integer of at least {least}, got {value!r}")
    return value


def _index(name: str, value: Any, count: int) -> int:
    if _at_least(name, value, 0) >= count:
        raise ValueError(f"{name}: expected 0 .. {count - 1}, got {value}")
    return value
