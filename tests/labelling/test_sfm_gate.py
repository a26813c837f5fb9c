"""The gate, splitting, pooled focals, and the reasons."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mint_hub.labelling.stages import sfm_gate as gate

GOOD = {"features": 1000.0, "matches": 400.0, "flow_px": 10.0, "turning": 0.1}


def test_frames_between_keyframes_share_what_the_keyframes_share() -> None:
    got = gate.covisibility(np.array([3, 5, 8]), np.array([100, 40]))
    assert got.tolist() == [100, 100, 40, 40, 40, 40]
    assert gate.covisibility(np.array([3]), np.zeros(0, np.int64)).tolist() == [0]


def test_a_clip_is_split_where_keyframes_share_too_little() -> None:
    covisible = gate.covisibility(np.array([0, 5, 10, 15]), np.array([200, 3, 150]))
    solved = np.ones(16, bool)
    assert gate.segments(covisible, solved) == [(0, 6), (10, 16)]
    assert gate.segments(covisible, solved, min_frames=7) == []
    assert gate.segments(covisible, solved, min_shared=2) == [(0, 16)]


def test_a_long_stretch_without_poses_splits_too() -> None:
    covisible = np.full(60, 200, np.float32)
    solved = np.ones(60, bool)
    solved[20:30] = False
    assert gate.segments(covisible, solved) == [(0, 60)]
    solved[20:40] = False
    assert gate.segments(covisible, solved) == [(0, 20), (40, 60)]


def test_a_stretch_begins_and_ends_with_a_solved_frame() -> None:
    solved = np.array([False, True, True, False, True, False])
    assert gate.segments(np.full(6, 99, np.float32), solved) == [(1, 5)]
    assert gate.segments(np.full(6, 99, np.float32), np.zeros(6, bool)) == []


@settings(deadline=None, max_examples=60)
@given(
    st.lists(st.tuples(st.integers(0, 60), st.booleans()), min_size=2, max_size=80),
    st.integers(0, 5),
)
def test_stretches_and_gaps_tile_the_clip(
    frames: list[tuple[int, bool]], max_unsolved: int
) -> None:
    covisible = np.array([shared for shared, _ in frames], np.float32)
    solved = np.array([ok for _, ok in frames])
    kept = gate.segments(covisible, solved, max_unsolved=max_unsolved)
    for start, stop in kept:
        assert (covisible[start : stop - 1] >= gate.MIN_SHARED).all()
        assert solved[[start, stop - 1]].all()
    covered = [t for a, b in [*kept, *gate.gaps(kept, len(frames))] for t in range(a, b)]
    assert sorted(covered) == list(range(len(frames)))


def test_of_overlapping_stretches_the_longest_stay() -> None:
    assert gate.disjoint([(0, 10), (5, 30), (30, 40)]) == [1, 2]
    assert gate.disjoint([]) == []


def test_the_reason_follows_from_what_there_was_to_see() -> None:
    still = {"angle_deg": 0.1, "images": 30}
    moving = {"angle_deg": 4.0, "images": 30}
    assert gate.reason({**GOOD, "features": 20}, []) == gate.FLAT
    assert gate.reason({**GOOD, "matches": 5}, []) == gate.UNMATCHED
    assert gate.reason({**GOOD, "flow_px": 0.1}, []) == gate.STILL
    assert gate.reason({**GOOD, "turning": 1.0}, [moving]) == gate.STILL
    assert gate.reason(GOOD, [still]) == gate.STILL
    assert gate.reason(GOOD, []) == gate.UNSOLVED
    assert gate.reason(GOOD, [moving]) == gate.UNLINKED


def test_one_wrong_window_does_not_move_the_focal() -> None:
    pooled = gate.pool_focals([221.0, 222.0, 221.5, 310.0], [10, 12, 9, 11])
    assert abs(pooled.focal / 221.5 - 1) < 0.002
    assert pooled.agreeing == 3
    alone = gate.pool_focals([221.0], [10])
    assert alone.focal == pytest.approx(221.0)
    together = gate.pool_focals([221.0, 222.0, 221.5], [10, 12, 9])
    assert 0 < pooled.confidence < together.confidence < 1
    assert alone.confidence < together.confidence


def test_heavier_windows_count_more() -> None:
    light, heavy = (gate.pool_focals([220.0, 224.0], w).focal for w in ([3, 1], [1, 3]))
    assert light == pytest.approx(np.exp(np.average(np.log([220, 224]), weights=[3, 1])))
    assert light < heavy


@pytest.mark.parametrize(
    ("focals", "weights"), [([], []), ([200.0], [0.0]), ([float("nan")], [1.0]), ([1.0, 2.0], [1])]
)
def test_focals_that_are_none_are_refused(focals: list[float], weights: list[float]) -> None:
    with pytest.raises(ValueError, match="focals: expected positive"):
        gate.pool_focals(focals, weights)
