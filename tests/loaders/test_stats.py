import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mint_hub.conventions import SIDES
from mint_hub.geometry import hand_state
from mint_hub.loaders import members, stats
from mint_hub.loaders.stats import (
    QUANTILE_ABSOLUTE_ERROR,
    QUANTILE_RELATIVE_ERROR,
    QUANTILES,
    CorpusError,
    CorpusStats,
    Sketch,
    read_stats,
    write_stats,
)
from tests.episodes import make_episode

floats = st.floats(-1e4, 1e4, width=32)


def sketch_of(*parts: np.ndarray) -> Sketch:
    sketch = Sketch(parts[0].shape[1])
    for part in parts:
        sketch.add(part)
    return sketch


def assert_same(a: Sketch, b: Sketch) -> None:
    assert a.count == b.count
    np.testing.assert_allclose(a.mean, b.mean, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(a.squares, b.squares, rtol=1e-9, atol=1e-6)
    for name in ("min", "max", "histogram"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


@settings(deadline=None, max_examples=60)
@given(st.lists(floats, min_size=1, max_size=80), st.sampled_from([*QUANTILES, 0.0, 1.0]))
def test_quantiles_are_within_the_stated_error(values, q):
    rows = np.array(values, np.float32)[:, None]
    exact = np.quantile(rows[:, 0].astype(float), q, method="inverted_cdf")
    error = abs(sketch_of(rows).quantile(q)[0] - exact)
    assert error <= max(QUANTILE_RELATIVE_ERROR * abs(exact), QUANTILE_ABSOLUTE_ERROR)


@settings(deadline=None, max_examples=40)
@given(st.lists(floats, min_size=2, max_size=60), st.integers(0, 60))
def test_merging_parts_is_seeing_the_whole(values, cut):
    rows = np.array(values, np.float32)[:, None] * [1, -3]
    whole, first, second = sketch_of(rows), sketch_of(rows[:cut]), sketch_of(rows[cut:])
    first.merge(second)
    assert_same(first, whole)
    assert_same(sketch_of(rows[:cut], rows[cut:]), whole)


def test_moments_are_those_of_numpy():
    rows = np.random.default_rng(0).normal([0, 5, -2], [1, 0.1, 30], (4000, 3)).astype(np.float32)
    said = sketch_of(rows[:10], rows[10:]).to_dict()
    exact = rows.astype(float)
    np.testing.assert_allclose(said["mean"], exact.mean(axis=0), rtol=1e-9)
    np.testing.assert_allclose(said["variance"], exact.var(axis=0), rtol=1e-9)
    np.testing.assert_array_equal(said["min"], exact.min(axis=0))
    np.testing.assert_array_equal(said["max"], exact.max(axis=0))
    assert list(said["quantiles"]) == ["0.01", "0.1", "0.5", "0.9", "0.99"]


def test_nothing_seen_is_said_as_none():
    said = sketch_of(np.empty((0, 3))).to_dict()
    assert (said["count"], said["mean"], said["quantiles"]["0.5"]) == (0, None, None)


def test_far_values_share_a_bin_but_stay_within_the_extremes():
    rows = np.array([[1e30], [2e30], [-3e30]], np.float32)
    quantiles = [sketch_of(rows).quantile(q)[0] for q in (0.01, 0.5, 0.99)]
    assert all(rows.min() <= q <= rows.max() for q in quantiles)


@pytest.mark.parametrize("format", ["compact", "lossless"])
def test_a_hand_counts_where_it_is_present(format):
    episodes = [make_episode(30 + i, seed=i) for i in range(4)]
    seen = CorpusStats()
    for episode in episodes:
        parts = members.encode(episode, format)
        seen.add(members.decode_meta(parts["json"]), members.arrays_of(parts))
    said = seen.to_dict()["synthetic"]
    for hand, side in enumerate(SIDES):
        state = np.concatenate([e.hand_state[e.presence[:, hand], hand] for e in episodes])
        for name, where in stats.HAND_FIELDS.items():
            exact = state[:, where].astype(float)
            assert said[side][name]["count"] == len(state)
            np.testing.assert_allclose(said[side][name]["mean"], exact.mean(axis=0), atol=1e-3)
            np.testing.assert_allclose(said[side][name]["variance"], exact.var(axis=0), atol=1e-3)
    fov = np.concatenate([e.fov_vh_rad for e in episodes])
    assert said["camera"]["fov_vh"]["count"] == len(fov)
    np.testing.assert_allclose(said["camera"]["fov_vh"]["max"], fov.max(axis=0))
    assert sum(w.stop - w.start for w in stats.HAND_FIELDS.values()) == hand_state.HAND_STATE_SIZE


def test_sources_are_kept_apart_and_one_without_a_name_counts():
    seen, other = CorpusStats(), CorpusStats()
    for into, source in ((seen, "a"), (other, "b"), (other, None)):
        parts = members.encode(make_episode(8, meta={"source": source}))
        into.add(members.decode_meta(parts["json"]), members.arrays_of(parts))
    seen.merge(other)
    said = seen.to_dict()
    assert list(said) == ["a", "b", stats.UNKNOWN_SOURCE]
    assert {s["camera"]["fov_vh"]["count"] for s in said.values()} == {8}


def test_statistics_are_bound_to_the_shards(tmp_path):
    write_stats(tmp_path, "train", "aa", CorpusStats(), tmp_path / "x")
    write_stats(tmp_path, "validation", "bb", CorpusStats(), tmp_path / "x")
    assert read_stats(tmp_path, "train", "aa") == {}
    with pytest.raises(CorpusError, match=r"content bb2, got bb: the shards of 'validation'"):
        read_stats(tmp_path, "validation", "bb2")
    with pytest.raises(CorpusError, match=r"expected split 'test', got \['train', 'validation'\]"):
        read_stats(tmp_path, "test", "aa")
