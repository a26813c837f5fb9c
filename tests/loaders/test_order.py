"""Laws of the order: a permutation of (seed, epoch) that ranks and workers only deal out."""

import doctest
import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mint_hub.loaders import order as order_module
from mint_hub.loaders.order import ElasticSampler, Order, uniform


def team(num_samples, ranks, workers, **options):
    """Every sampler of a run: for each rank, one a worker."""
    return [
        [
            ElasticSampler(num_samples, 7, rank, ranks, worker, workers, **options)
            for worker in range(max(workers, 1))
        ]
        for rank in range(ranks)
    ]


def everyone(samplers):
    return np.array([i for rank in samplers for sampler in rank for i in sampler])


@given(st.integers(0, 3000), st.integers(-(2**70), 2**70), st.integers(0, 2**40))
@settings(max_examples=60, deadline=None)
def test_order_is_a_permutation(num_samples, seed, epoch):
    samples = Order(num_samples, seed).permute(epoch, np.arange(num_samples))
    assert samples.dtype == np.int64
    assert np.array_equal(np.sort(samples), np.arange(num_samples))


def test_any_position_alone_is_the_same_as_in_company():
    order = Order(1013, seed=3)
    whole = order.permute(5, np.arange(1013))
    assert all(order.permute(5, i) == whole[i] for i in range(0, 1013, 7))
    assert np.array_equal(order.permute(5, np.arange(1000).reshape(10, 100)).ravel(), whole[:1000])


def test_order_scatters():
    """No trace of the natural order: neighbours, fixed points and places look like chance."""
    n = 20_000
    first, again, other = (
        Order(n, seed).permute(epoch, np.arange(n)) for seed, epoch in ((0, 0), (0, 1), (1, 0))
    )
    for samples in (first, again, other):
        assert abs(np.corrcoef(np.arange(n), samples)[0, 1]) < 0.03
        assert abs(np.corrcoef(samples[1:], samples[:-1])[0, 1]) < 0.03
        assert (samples == np.arange(n)).sum() < 12
    assert (first == again).sum() < 12
    assert (first == other).sum() < 12


def test_small_orders_reach_every_permutation():
    seen = {tuple(Order(4, seed).permute(0, np.arange(4)).tolist()) for seed in range(2000)}
    assert seen == set(itertools.permutations(range(4)))


def test_no_seed_is_the_natural_order():
    assert Order(9, None).permute(4, np.arange(9)).tolist() == list(range(9))


def test_a_huge_order_needs_no_memory():
    order = Order(2**62, seed=1)
    positions = np.array([0, 1, 2**61, 2**62 - 1])
    samples = order.permute(0, positions)
    assert len(set(samples.tolist())) == 4
    assert samples.min() >= 0
    assert samples.max() < 2**62


@pytest.mark.parametrize("workers", range(5))
@pytest.mark.parametrize("ranks", range(1, 9))
def test_every_sample_exactly_once(ranks, workers):
    for num_samples, batch_size in ((211, 1), (96, 4), (5, 3), (0, 1)):
        samplers = team(num_samples, ranks, workers, batch_size=batch_size)
        for epoch in range(3):
            assert all(sampler.epoch == epoch for rank in samplers for sampler in rank)
            promised = sum(len(sampler) for rank in samplers for sampler in rank)
            read = everyone(samplers)
            assert promised == num_samples
            assert np.array_equal(np.sort(read), np.arange(num_samples))


def test_resuming_anywhere_with_other_ranks_and_workers_gives_exactly_the_rest():
    rng = np.random.default_rng(11)
    for _ in range(50):
        n = int(rng.integers(1, 400))
        ranks, workers, batch = (int(rng.integers(*lohi)) for lohi in ((1, 9), (0, 5), (1, 6)))
        samplers = team(n, ranks, workers, batch_size=batch)
        epoch = int(rng.integers(0, 4))
        streams = []
        for rank in samplers:
            for sampler in rank:
                sampler.set_epoch(epoch)
            streams.append([sampler.batches() for sampler in rank])
        steps = int(rng.integers(0, -(-n // (ranks * batch)) + 1))
        read = []
        for step, rank in itertools.product(range(steps), range(ranks)):
            read.extend(next(streams[rank][step % max(workers, 1)], np.zeros(0, int)))
        state = ElasticSampler(n, 7, world_size=ranks, batch_size=batch)
        state.set_epoch(epoch)
        state = state.state_dict(steps=steps)
        assert state["position"] == len(read)

        ranks, workers, batch = (int(rng.integers(*lohi)) for lohi in ((1, 9), (0, 5), (1, 6)))
        resumed = team(n, ranks, workers, batch_size=batch)
        for sampler in itertools.chain(*resumed):
            sampler.load_state_dict(state)
        rest = everyone(resumed)
        whole = Order(n, 7).permute(epoch, np.arange(n))
        assert np.array_equal(read, whole[: len(read)])
        assert np.array_equal(np.sort([*read, *rest]), np.arange(n))
        assert set(rest) == set(whole[len(read) :])
        assert all(sampler.epoch == epoch + 1 for sampler in itertools.chain(*resumed))


def test_a_lone_sampler_knows_its_own_state():
    sampler = ElasticSampler(100, 7)
    stream = iter(sampler)
    read = [next(stream) for _ in range(37)]
    fresh = ElasticSampler(100, 7)
    fresh.load_state_dict(sampler.state_dict())
    assert read + list(fresh) == list(ElasticSampler(100, 7))


def test_a_cursor_goes_on_where_it_stands():
    whole = list(ElasticSampler(50, 7))
    sampler = ElasticSampler(50, 7)
    first = list(itertools.islice(sampler, 20))
    assert first + list(sampler) == whole
    assert sampler.state_dict() == {"epoch": 1, "position": 0, "num_samples": 50, "seed": 7}


def test_workers_in_turn_are_the_rank_without_workers():
    alone = list(ElasticSampler(103, 7, 1, 3, batch_size=4).batches())
    workers = [ElasticSampler(103, 7, 1, 3, w, 3, batch_size=4).batches() for w in range(3)]
    turns = [next(workers[step % 3]) for step in range(len(alone))]
    assert all(np.array_equal(a, b) for a, b in zip(alone, turns, strict=True))


def test_drop_last_gives_every_rank_the_same_number_of_full_batches():
    samplers = team(103, 4, 2, batch_size=5, drop_last=True)
    sizes = [[len(b) for sampler in rank for b in sampler.batches()] for rank in samplers]
    assert sizes == [[5] * 5] * 4


def test_num_steps_counts_the_batches_of_the_rank():
    for rank in range(3):
        steps = len(list(ElasticSampler(103, 7, rank, 3, batch_size=4).batches()))
        assert ElasticSampler(103, 7, rank, 3, 1, 2, batch_size=4).num_steps == steps


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"rank": 2, "world_size": 2}, "rank: expected 0 .. 1, got 2"),
        ({"worker": 1}, "worker: expected 0 .. 0, got 1"),
        ({"batch_size": 0}, "batch_size: expected an integer of at least 1, got 0"),
        ({"world_size": True}, "world_size"),
        ({"num_samples": -1}, "num_samples"),
    ],
)
def test_wrong_arguments_are_named(options, message):
    with pytest.raises(ValueError, match=message):
        ElasticSampler(**{"num_samples": 10, **options})


def test_a_state_of_another_corpus_is_refused():
    state = ElasticSampler(10, 7).state_dict()
    with pytest.raises(ValueError, match="state num_samples: expected 11, got 10"):
        ElasticSampler(11, 7).load_state_dict(state)
    with pytest.raises(ValueError, match="state seed: expected 8, got 7"):
        ElasticSampler(10, 8).load_state_dict(state)
    with pytest.raises(ValueError, match="state position"):
        ElasticSampler(10, 7).load_state_dict({**state, "position": 11})
    with pytest.raises(ValueError, match="state seed"):
        ElasticSampler(10, 7).load_state_dict({"num_samples": 10})


def test_positions_outside_are_refused():
    with pytest.raises(ValueError, match=r"positions: expected 0 \.\. 9, got 3 \.\. 10"):
        Order(10).permute(0, [3, 10])
    with pytest.raises(ValueError, match="positions: expected integers"):
        Order(10).permute(0, [0.5])


def test_uniform_draws_are_uniform_and_of_their_sample_alone():
    draws = uniform(3, 1, np.arange(20_000))
    counts = np.histogram(draws, 20, (0, 1))[0]
    assert counts.sum() == 20_000
    assert np.abs(counts - 1000).max() < 160
    assert uniform(3, 1, [77])[0] == draws[77]
    assert (uniform(3, 2, np.arange(20_000)) != draws).all()


def test_documentation_tells_the_truth():
    result = doctest.testmod(order_module)
    assert result.failed == 0 < result.attempted
