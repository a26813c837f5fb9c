"""In which order windows come: laws of (seed, position)."""

from collections import Counter

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mint_hub.training.order import MixtureOrder, group_weights

SIZES = st.lists(st.integers(1, 12), min_size=1, max_size=3)


@settings(deadline=None, max_examples=8)
@given(SIZES, st.integers(0, 100), st.integers(0, 3))
def test_every_window_once_an_epoch(sizes, seed, epoch):
    order = MixtureOrder(sizes, seed=seed)
    positions = range(epoch * order.epoch_length, (epoch + 1) * order.epoch_length)
    assert sorted(order.window(p) for p in positions) == list(range(sum(sizes)))


@settings(deadline=None, max_examples=8)
@given(SIZES, st.data())
def test_a_mixture_is_kept_and_spreads_alike_within_a_group(sizes, data):
    weights = data.draw(st.lists(st.integers(0, 3), min_size=len(sizes), max_size=len(sizes)))
    if not any(weights):
        weights[0] = 1
    order = MixtureOrder(sizes, weights, seed=5)
    epochs = 3
    read = Counter(order.window(p) for p in range(epochs * order.epoch_length))
    first = 0
    for size, quota in zip(sizes, order.quotas, strict=True):
        counts = [read[first + k] for k in range(size)]
        assert sum(counts) == epochs * quota
        assert max(counts) - min(counts) <= 1
        first += size


def test_another_seed_is_another_order():
    one, other = (
        [MixtureOrder([50, 20], seed=seed).window(p) for p in range(70)] for seed in (1, 2)
    )
    assert one != other


def test_weights_by_name():
    assert group_weights(["a", "b"], None) is None
    assert group_weights(["a", "b", "c"], {"c": 2.0, "a": 1.0}) == [1.0, 0.0, 2.0]
    with pytest.raises(ValueError, match=r"\['a', 'b'\], got 'd'"):
        group_weights(["a", "b"], {"d": 1.0})


@pytest.mark.parametrize(
    ("sizes", "weights"), [([], None), ([3, 0], None), ([3], [1.0, 1.0]), ([3], [0.0])]
)
def test_mixtures_of_nothing_are_refused(sizes, weights):
    with pytest.raises(ValueError, match=r"sizes|weights"):
        MixtureOrder(sizes, weights)
