"""Statistics of actions are those of the chunks that are looked at, and normalise what they say."""

import doctest
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from mint_hub.conventions import LEFT, SIDES
from mint_hub.loaders import action_stats, shards
from mint_hub.loaders.action_normaliser import ActionNormaliser
from mint_hub.loaders.action_stats import (
    STATE,
    ActionStats,
    chosen_starts,
    definition,
    halvings_for,
)
from mint_hub.loaders.actions import DEFINITIONS, action_chunks
from mint_hub.loaders.manifest import read_manifest, read_sealed, write_sealed
from mint_hub.loaders.reader import CorpusReader
from mint_hub.loaders.stats import read_action_stats, write_stats
from mint_hub.loaders.tar_layout import CorpusError
from tests.episodes import make_episode

SOURCES = ("one", "two")
EPISODES = [
    make_episode(50 + i, seed=i, key=f"e-{i}", meta={"source": SOURCES[i % 2], "uid": f"v-{i}"})
    for i in range(6)
]


@pytest.fixture(scope="module")
def corpus(tmp_path_factory):
    folder = tmp_path_factory.mktemp("corpus")
    shards.write_corpus(EPISODES, folder, "c", "train", shard_bytes=60_000, num_procs=2)
    return folder


def stats_of(corpus):
    return read_action_stats(corpus / "c", "train", read_manifest(corpus / "c/train").content)


def rows_of(episodes, words, halvings=0):
    """Actions (rows, 51) and states (rows, 61) of each hand, from the chunks looked at."""
    actions, states = ([], []), ([], [])
    for episode in episodes:
        starts = chosen_starts(episode.key, episode.num_frames, halvings)
        chunks = action_chunks(episode, starts, relative=words[0], fingers=words[1])
        for hand in range(2):
            numbers = chunks.action.reshape(len(chunks), 16, 2, 51)[:, :, hand]
            actions[hand].append(numbers[chunks.mask[..., hand]])
            each = chunks.state.reshape(len(chunks), 2, 61)[:, hand]
            states[hand].append(each[chunks.state_mask[:, hand]])
    return [np.concatenate(a) for a in actions], [np.concatenate(s) for s in states]


def assert_said(said, rows):
    assert said["count"] == len(rows)
    exact = rows.astype(float)
    assert_allclose(said["mean"], exact.mean(axis=0), atol=1e-6)
    assert_allclose(said["variance"], exact.var(axis=0), atol=1e-6)
    assert_allclose(said["min"], exact.min(axis=0), atol=1e-6)
    assert_allclose(said["max"], exact.max(axis=0), atol=1e-6)


def test_doctests():
    assert doctest.testmod(action_stats).failed == 0


@pytest.mark.parametrize("words", DEFINITIONS)
def test_statistics_of_a_corpus_are_those_of_its_chunks(corpus, words):
    stats = stats_of(corpus)
    assert stats["share"] == 1.0
    for source in SOURCES:
        own = [e for e in CorpusReader(corpus, "c", "train") if e.meta["source"] == source]
        said = stats["sources"][source]
        assert said["chunks"] == sum(e.num_frames for e in own)
        actions, states = rows_of(own, words)
        for hand, side in enumerate(SIDES):
            assert 0 < len(actions[hand]) < 16 * said["chunks"]
            assert_said(said[definition(*words)][side], actions[hand])
            assert_said(said[STATE][side], states[hand])


@pytest.mark.parametrize("halvings", [1, 3])
def test_statistics_of_a_sample_are_those_of_the_chunks_in_it(halvings):
    stats = ActionStats(halvings)
    for episode in EPISODES:
        add(stats, episode)
    said = stats.to_dict()
    assert said["share"] == 0.5**halvings
    starts = [chosen_starts(e.key, e.num_frames, halvings) for e in EPISODES]
    assert said["sources"]["s"]["chunks"] == sum(map(len, starts))
    for words in DEFINITIONS:
        actions, states = rows_of(EPISODES, words, halvings)
        for hand, side in enumerate(SIDES):
            assert_said(said["sources"]["s"][definition(*words)][side], actions[hand])
            assert_said(said["sources"]["s"][STATE][side], states[hand])


def add(stats, episode, source="s"):
    """Take in an episode's exact numbers."""
    from mint_hub.loaders import members

    traj = members.arrays_of(members.encode(episode, "lossless"))["traj.npy"]
    stats.add(source, episode.key, traj, episode.hand_state)


@pytest.mark.parametrize("length", [255, 256, 257, 512])
def test_no_number_of_chunks_is_special(length):
    episode = make_episode(length, gaps=False)
    stats = ActionStats()
    add(stats, episode)
    said = stats.to_dict()["sources"]["s"]
    assert said["chunks"] == said[STATE]["left"]["count"] == length
    steps = sum(min(16, length - 1 - start) for start in range(length))
    assert said["step, absolute fingers"]["right"]["count"] == steps


def test_an_episode_without_a_chosen_chunk_counts_as_none():
    key = next(f"k-{i}" for i in range(100) if not len(chosen_starts(f"k-{i}", 9, 6)))
    stats = ActionStats(6)
    add(stats, replace(make_episode(9), key=key))
    said = stats.to_dict()["sources"]["s"]
    assert said["chunks"] == said[STATE]["left"]["count"] == 0


def test_the_chosen_chunks_are_a_share_that_only_key_and_frame_decide():
    for halvings in range(7):
        counts = [len(chosen_starts(f"k-{i}", 500, halvings)) for i in range(100)]
        expected = 50_000 / 2**halvings
        assert abs(sum(counts) - expected) <= 4 * np.sqrt(expected)
    few, many = chosen_starts("k", 4000, 5), chosen_starts("k", 4000, 4)
    assert set(few) < set(many)
    assert_array_equal(chosen_starts("k", 900, 4), many[many < 900])
    assert not np.array_equal(chosen_starts("other", 4000, 5), few)
    assert halvings_for(110_323_558) == action_stats.MOST_HALVINGS


def test_parts_merge_to_the_whole_and_processes_do_not_matter(corpus, tmp_path):
    whole, parts = ActionStats(1), [ActionStats(1), ActionStats(1)]
    for i, episode in enumerate(EPISODES):
        add(whole, episode)
        add(parts[i // 3], episode)
    parts[0].merge(parts[1])
    a, b = (s.to_dict()["sources"]["s"]["anchor, absolute fingers"] for s in (whole, parts[0]))
    for side in SIDES:
        assert_allclose(a[side]["variance"], b[side]["variance"], rtol=1e-9)
        assert a[side]["quantiles"] == b[side]["quantiles"]
    shards.write_corpus(EPISODES, tmp_path, "c", "train", shard_bytes=60_000)
    assert (tmp_path / "c/stats.json").read_bytes() == (corpus / "c/stats.json").read_bytes()


@pytest.mark.parametrize("words", DEFINITIONS)
def test_normalised_chunks_have_mean_0_and_variance_1(corpus, words):
    normaliser = ActionNormaliser.from_corpus(corpus, "c", "train", *words)
    count, total, squares = np.zeros(102), np.zeros(102), np.zeros(102)
    for episode in CorpusReader(corpus, "c", "train"):
        chunks = action_chunks(episode, relative=words[0], fingers=words[1], dtype=np.float64)
        made = normaliser.normalise(chunks)
        assert not made.action.reshape(-1, 16, 2, 51)[~chunks.mask].any()
        assert not made.state.reshape(-1, 2, 61)[~chunks.state_mask].any()
        count += np.repeat(chunks.mask, 51, axis=-1).sum((0, 1))
        total += made.action.sum((0, 1))
        squares += np.square(made.action).sum((0, 1))
        back = normaliser.denormalise(made)
        assert_allclose(back.action, chunks.action, atol=1e-12)
        assert_allclose(back.state, chunks.state, atol=1e-12)
    assert_allclose(total / count, 0, atol=1e-5)
    varies = normaliser.action_std != 1.0
    assert varies.sum() > 90
    assert_allclose((squares / count)[varies], 1, atol=1e-4)


def test_states_are_normalised_over_the_chosen_sources(corpus):
    normaliser = ActionNormaliser.from_stats(stats_of(corpus), sources=["two"])
    both = ActionNormaliser.from_stats(stats_of(corpus))
    assert not np.allclose(normaliser.state_mean, both.state_mean)
    own = [e for e in CorpusReader(corpus, "c", "train") if e.meta["source"] == "two"]
    made = [normaliser.normalise(action_chunks(e, dtype=np.float64)) for e in own]
    state = np.concatenate([m.state.reshape(-1, 2, 61)[m.state_mask[:, LEFT], LEFT] for m in made])
    assert_allclose(state.mean(axis=0), 0, atol=1e-5)
    varies = normaliser.state_std[:61] != 1.0
    assert_allclose(state.var(axis=0)[varies], 1, atol=1e-4)


def test_absent_hands_never_count():
    there = [True, False]
    episode = make_episode(40, gaps=False)
    one = replace(episode, presence=np.tile(there, (40, 1)), presence_score=None, filled=None)
    stats = ActionStats()
    add(stats, one)
    said = stats.to_dict()["sources"]["s"]
    for name in (STATE, *(definition(*d) for d in DEFINITIONS)):
        assert said[name]["left"]["count"] > 0
        assert said[name]["right"] == {**said[name]["right"], "count": 0, "mean": None}
    normaliser = ActionNormaliser.from_stats(stats.to_dict())
    assert_array_equal(normaliser.action_mean[51:], 0)
    assert_array_equal(normaliser.state_std[61:], 1)
    other = action_chunks(episode)
    assert_array_equal(normaliser.normalise(other).action[..., 51:], other.action[..., 51:])


def test_what_cannot_be_normalised_is_told(corpus):
    stats = stats_of(corpus)
    with pytest.raises(CorpusError, match=r"expected some of \['one', 'two'\], got \['three'\]"):
        ActionNormaliser.from_stats(stats, sources=["one", "three"])
    with pytest.raises(CorpusError, match="expected some of"):
        ActionNormaliser.from_stats(ActionStats().to_dict())
    with pytest.raises(ValueError, match="relative, fingers: expected one of"):
        ActionNormaliser.from_stats(stats, "first", "absolute")
    anchored = action_chunks(EPISODES[0], relative="anchor")
    with pytest.raises(ValueError, match="expected 'step, absolute fingers', got 'anchor, abs"):
        ActionNormaliser.from_stats(stats).normalise(anchored)


def test_a_file_without_statistics_of_actions_is_told(tmp_path):
    from mint_hub.loaders.stats import CorpusStats

    write_stats(tmp_path, "train", "aa", CorpusStats(), tmp_path / "x")
    values = read_sealed(tmp_path / "stats.json")
    del values["splits"]["train"]["actions"]
    write_sealed(tmp_path / "stats.json", values)
    with pytest.raises(CorpusError, match="expected statistics of actions of 'train', got none"):
        read_action_stats(tmp_path, "train", "aa")
