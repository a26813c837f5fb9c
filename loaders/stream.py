"""A corpus as a torch dataset: batches in elastic order, exact resume across ranks and workers.

    stream = reader.stream(256, length=16, seed=0, rank=rank, world_size=world_size)
    loader = ElasticLoader(stream, num_workers=2)
    for batch in loader:                  # Windows of tensors, (256, 16, C) by member
        ...
        state = loader.state_dict()       # save it anywhere; load it with any ranks and workers

With ``action_dataset``, the only module of the loaders that needs torch when it is imported.
"""

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from torch.utils.data import DataLoader, IterableDataset, get_worker_info

from mint_hub.loaders.order import ElasticSampler, uniform
from mint_hub.loaders.reader import CorpusReader, Windows
from mint_hub.loaders.schema import Episode

if TYPE_CHECKING:
    Base = IterableDataset[Any]
else:
    Base = IterableDataset


class ElasticStream(Base):
    """Batches of samples 0 .. N - 1 in elastic order: what they hold is up to ``batch_of``.

    Iterating goes on from the cursor, ``sampler``, and ends with the epoch. In a worker process of
    a DataLoader the stream deals out its own part; ``ElasticLoader`` keeps count of such a loader.
    Arguments and errors are those of ``ElasticSampler``; ``batch`` is its ``batch_size``.
    """

    def __init__(
        self,
        num_samples: int,
        batch: int,
        *,
        seed: int | None = 0,
        rank: int = 0,
        world_size: int = 1,
        drop_last: bool = False,
    ) -> None:
        super().__init__()
        self.sampler = ElasticSampler(
            num_samples, seed, rank, world_size, batch_size=batch, drop_last=drop_last
        )
        self._active = self.sampler

    def batch_of(self, samples: NDArray[np.int64], epoch: int) -> Any:
        """Return the batch of these samples, (batch,) numbers, in this epoch."""
        raise NotImplementedError

    def __iter__(self) -> Iterator[Any]:
        """Yield the batches of this rank, or of this worker's part of it, to the epoch's end."""
        info = get_worker_info()
        if info is not None:
            self._active = self.sampler.for_worker(info.id, info.num_workers)
        active = self._active
        for indices in active.batches():
            yield self.batch_of(indices, active.epoch)

    def set_epoch(self, epoch: int) -> None:
        """Go to the beginning of an epoch."""
        self.sampler.set_epoch(epoch)

    def state_dict(self) -> dict[str, Any]:
        """Return where the run stands; in a worker, once all workers have come as far."""
        return self._active.state_dict()

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go where a run stood; see ``ElasticSampler``."""
        self.sampler.load_state_dict(state)


class CorpusStream(ElasticStream):
    """Batches of a reader's episodes, each episode once an epoch over all ranks and workers.

    With ``length``, a batch is Windows: of every episode that is long enough one window, whose
    start follows from (seed, epoch, episode) alone. Without, it is a list of whole Episodes. What a
    batch holds never depends on the number of workers. With a reader that skips, a batch is shorter
    by the episodes that cannot be read.

    Args:
        reader: what to read.
        batch: episodes a step of one rank.
        length: frames of a window, or None for whole episodes.
        seed: of order and starts; None reads in the reader's order, windows at frame 0.
        rank: of ``world_size`` ranks.
        world_size: number of ranks.
        drop_last: see ``ElasticSampler``.
        as_torch: Windows of tensors rather than of arrays.

    Raises:
        ValueError: no episode has ``length`` frames, or an argument of ElasticSampler is wrong.

    """

    def __init__(
        self,
        reader: CorpusReader,
        batch: int,
        length: int | None = None,
        *,
        as_torch: bool = True,
        **options: Any,
    ) -> None:
        self.reader, self.length, self.as_torch = reader, length, as_torch
        self._samples = np.flatnonzero(reader.num_frames >= (length or 1))
        if length is not None and (length < 1 or not len(self._samples)):
            raise ValueError(f"length: expected an episode of {length} >= 1 frames, got none")
        super().__init__(len(self._samples), batch, **options)

    def batch_of(self, samples: NDArray[np.int64], epoch: int) -> Windows | list[Episode]:
        """Return windows, or whole episodes, of these of the episodes that are long enough."""
        episodes = self._samples[samples]
        return self._windows(episodes, epoch) if self.length else self._episodes(episodes)

    def _windows(self, samples: NDArray[np.int64], epoch: int) -> Windows:
        assert self.length is not None
        samples = samples[self.reader.usable(samples)]
        spare = self.reader.num_frames[samples] - self.length + 1
        seed = self.sampler.order.seed
        share = 0.0 if seed is None else uniform(seed, epoch, samples)
        starts = np.minimum((share * spare).astype(np.int64), spare - 1)
        return self.reader.windows(samples, starts, self.length, as_torch=self.as_torch)

    def _episodes(self, samples: NDArray[np.int64]) -> list[Episode]:
        return list(self.reader.read(samples.tolist()))


class ElasticLoader:
    """A DataLoader over a stream that knows how far its run has come.

    The state counts the batches that were handed out, not those that workers made ahead, so it is
    exact at any step. Iterating goes on where the run stands and ends with the epoch.

    Args:
        stream: what to read.
        num_workers: worker processes; 0 reads in this one, which is fastest for windows of rows.
        options: further arguments of ``torch.utils.data.DataLoader``.

    """

    def __init__(self, stream: ElasticStream, num_workers: int = 0, **options: Any) -> None:
        self.stream = stream
        self._loader: DataLoader[Any] = DataLoader(
            stream, batch_size=None, num_workers=num_workers, **options
        )
        self._steps = 0

    def __iter__(self) -> Iterator[Any]:
        """Yield the rest of the epoch."""
        sampler, in_process = self.stream.sampler, self._loader.num_workers == 0
        sampler.load_state_dict(self.state_dict())
        self._steps, epoch = 0, sampler.epoch
        for batch in self._loader:
            self._steps += not in_process
            yield batch
        sampler.set_epoch(epoch + 1)
        self._steps = 0

    def __len__(self) -> int:
        """Steps of this rank from the cursor to the end of the epoch."""
        return self.stream.sampler.num_steps - self._steps

    def set_epoch(self, epoch: int) -> None:
        """Go to the beginning of an epoch."""
        self.stream.set_epoch(epoch)
        self._steps = 0

    def state_dict(self) -> dict[str, Any]:
        """Return where the run stands, given that every rank has taken as many steps."""
        steps = self._steps if self._loader.num_workers else None
        return self.stream.sampler.state_dict(steps)

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go where a run stood, whatever its ranks, workers and batches were."""
        self.stream.load_state_dict(state)
        self._steps = 0
