"""Laws of the torch dataset: the elastic order, over real batches and real worker processes."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch

from mint_hub.loaders.reader import CorpusReader
from mint_hub.loaders.shards import write_corpus
from mint_hub.loaders.stream import ElasticLoader
from tests.episodes import make_episode

NUM, LENGTH = 53, 8


@pytest.fixture(scope="module")
def reader(tmp_path_factory):
    folder = tmp_path_factory.mktemp("corpus")
    made = [replace(make_episode(6 + i % 7, seed=i), key=f"ep-{i:02d}") for i in range(NUM)]
    write_corpus(made, folder, "sample", "train", shard_bytes=60_000)
    return CorpusReader(folder, "sample", "train")


@pytest.fixture(scope="module")
def long_enough(reader):
    return np.flatnonzero(reader.num_frames >= LENGTH).tolist()


def identity(batches):
    """(episode, start) of every window, in order."""
    return [pair for b in batches for pair in zip(b.index.tolist(), b.start.tolist(), strict=True)]


def test_an_epoch_has_one_window_of_every_episode(reader, long_enough):
    stream = reader.stream(5, LENGTH, seed=3)
    seen = []
    for epoch in range(3):
        assert stream.state_dict()["epoch"] == epoch
        batches = list(stream)
        assert all(b.arrays["traj.npy"].dtype == torch.float32 for b in batches)
        pairs = identity(batches)
        assert sorted(i for i, _ in pairs) == long_enough
        for i, start in pairs:
            assert 0 <= start <= reader.num_frames[i] - LENGTH
        seen.append(pairs)
    assert seen[0] != seen[1] != seen[2]
    assert dict(seen[0]) != dict(seen[1])  # other starts
    again = reader.stream(5, LENGTH, seed=3)
    again.set_epoch(1)
    assert identity(again) == seen[1]


def test_windows_hold_the_rows_they_name(reader):
    batch = next(iter(reader.stream(16, LENGTH, as_torch=False)))
    want = reader.windows(batch.index, batch.start, LENGTH)
    assert all(np.array_equal(batch.arrays[n], want.arrays[n]) for n in want.arrays)


def test_ranks_share_an_epoch(reader, long_enough):
    for ranks in (1, 2, 3, 5, 8):
        parts = [identity(reader.stream(4, LENGTH, rank=r, world_size=ranks)) for r in range(ranks)]
        assert sorted(i for i, _ in itertools.chain(*parts)) == long_enough


def test_whole_episodes_come_once_each(reader):
    batches = list(reader.stream(10, seed=1))
    assert [len(b) for b in batches] == [10, 10, 10, 10, 10, 3]
    assert {e.key for b in batches for e in b} == {reader.key(i) for i in range(NUM)}


def test_no_seed_reads_in_order_from_the_first_frame(reader, long_enough):
    assert identity(reader.stream(7, LENGTH, seed=None)) == [(i, 0) for i in long_enough]


def test_workers_change_nothing(reader):
    alone = identity(ElasticLoader(reader.stream(4, LENGTH)))
    assert identity(ElasticLoader(reader.stream(4, LENGTH), num_workers=2)) == alone


def test_a_run_resumes_with_other_ranks_and_workers(reader, long_enough):
    """Two ranks of two workers stop; three ranks, one of them with workers, read the rest."""
    before, states = [], []
    for rank in range(2):
        loader = ElasticLoader(
            reader.stream(3, LENGTH, rank=rank, world_size=2), num_workers=2 * rank
        )
        assert len(loader) == -(-(len(long_enough) - 3 * rank) // 6)
        before += identity(itertools.islice(loader, 3))
        states.append(loader.state_dict())
    assert states[0] == states[1]
    assert states[0]["position"] == 18 == len(before)
    after = []
    for rank in range(3):
        loader = ElasticLoader(
            reader.stream(2, LENGTH, rank=rank, world_size=3), num_workers=rank // 2
        )
        loader.load_state_dict(states[0])
        after += identity(loader)
        assert loader.state_dict()["epoch"] == 1
    assert sorted(before + after) == sorted(identity(reader.stream(9, LENGTH)))


def test_resuming_streams_at_random_steps(reader, long_enough):
    whole = identity(reader.stream(1, LENGTH))
    rng = np.random.default_rng(5)
    for _ in range(50):
        ranks, batch = (int(n) for n in rng.integers(1, 6, 2))
        steps = int(rng.integers(0, len(long_enough) // (ranks * batch) + 1))
        first = [reader.stream(batch, LENGTH, rank=r, world_size=ranks) for r in range(ranks)]
        read = [identity(itertools.islice(s, steps)) for s in first]
        state = first[0].state_dict()
        assert all(s.state_dict() == state for s in first)
        ranks, batch = (int(n) for n in rng.integers(1, 6, 2))
        rest = []
        for r in range(ranks):
            stream = reader.stream(batch, LENGTH, rank=r, world_size=ranks)
            stream.load_state_dict(state)
            rest += identity(stream)
        assert sorted(itertools.chain(*read, rest)) == sorted(whole)


def test_a_loader_goes_on_and_then_begins_the_next_epoch(reader):
    for workers in (0, 2):
        loader = ElasticLoader(reader.stream(4, LENGTH), num_workers=workers)
        first = identity(itertools.islice(loader, 2)) + identity(loader)
        assert first == identity(reader.stream(4, LENGTH))
        assert loader.state_dict()["epoch"] == 1
        second = reader.stream(4, LENGTH)
        second.set_epoch(1)
        assert identity(loader) == identity(second)
