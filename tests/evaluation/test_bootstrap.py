"""Draws of recordings: what is drawn together, and that sums over weights are what they were."""

import tracemalloc

import numpy as np
import pytest

from mint_hub.evaluation.bootstrap import (
    BLOCK_VALUES,
    RESAMPLES,
    Resamples,
    drawn_means,
    drawn_medians,
    drawn_metrics,
)
from mint_hub.evaluation.summary import pooled
from mint_hub.geometry.metrics import HandStatistics


def weights_of(recordings):
    return np.concatenate(list(Resamples.of(recordings).blocks()))


def test_clips_of_a_recording_are_drawn_together():
    weights = weights_of(["a", "b", "a", "c", "c", "c"])
    assert weights.shape == (RESAMPLES, 6)
    assert (weights[:, 0] == weights[:, 2]).all()
    assert (weights[:, 3:] == weights[:, 3:4]).all()
    assert (weights[:, [0, 1, 3]].sum(axis=1) == 3).all()
    assert weights[:, [0, 1, 3]].mean(axis=0) == pytest.approx([1, 1, 1], abs=0.1)
    assert np.array_equal(weights, weights_of(["x", "y", "x", "z", "z", "z"]))
    assert not list(Resamples.of(["a", "a"]).blocks())


def test_means_and_medians_are_those_of_the_drawn_clips():
    rng = np.random.default_rng(0)
    names = [f"r{k}" for k in rng.integers(0, 9, 25)]
    table = np.where(rng.random((25, 2)) < 0.3, np.nan, rng.normal(size=(25, 2)))
    draws = Resamples.of(names)
    weights = np.concatenate(list(draws.blocks())).astype(int)
    means, medians = drawn_means(table, draws), drawn_medians(table, draws)
    for k in range(2):
        drawn = [np.repeat(table[:, k], row) for row in weights]
        drawn = [values[np.isfinite(values)] for values in drawn]
        np.testing.assert_allclose(means[:, k], [v.mean() for v in drawn])
        np.testing.assert_allclose(medians[:, k], [np.median(v) for v in drawn])
    np.testing.assert_allclose(drawn_means(table[:, 0], draws), means[:, 0])
    nothing = np.full((25, 1), np.nan)
    assert np.isnan(drawn_means(nothing, draws)).all()
    assert np.isnan(drawn_medians(nothing, draws)).all()
    assert drawn_medians(table, Resamples.of(["a"] * 25)).shape == (0, 2)


def test_memory_does_not_grow_with_draws_times_clips():
    parts = [HandStatistics(tp=1 + i % 3, fn=1, ct_sum_m=0.1 * i) for i in range(2000)]
    draws = Resamples.of([str(i) for i in range(len(parts))])
    tracemalloc.start()
    drawn = drawn_metrics(parts, HandStatistics, draws)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert len(drawn) == RESAMPLES
    assert peak < 8 * (8 * BLOCK_VALUES)  # all draws at once: 1000 x 2000 x 20 numbers, 320 MB


def test_a_number_of_one_recording_has_no_interval():
    """However often its clips are drawn, they say nothing of other recordings."""
    with_hands, without = HandStatistics(tp=3, ct_sum_m=0.3), HandStatistics(negatives=5)
    for names in (["a", "b", "c"], ["a", "a", "c"]):
        parts = [with_hands, HandStatistics(tp=1, ct_sum_m=0.2), without]
        if names[1] == "b":
            parts[1] = without
        value, low, high = pooled(parts, HandStatistics, Resamples.of(names))["CT-p"]
        assert np.isfinite(value)
        assert np.isnan([low, high]).all()
    two = pooled([with_hands] * 2, HandStatistics, Resamples.of(["a", "b"]))["CT-p"]
    assert np.isfinite(two).all()
