"""Laws of the windowing."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mint_hub.windows import Window, WindowPlanner, ramp, windows

LAWS = settings(deadline=None, max_examples=150, derandomize=True)


@st.composite
def cuts(draw: st.DrawFn) -> tuple[int, int, int]:
    length = draw(st.integers(1, 40))
    return draw(st.integers(1, 300)), length, draw(st.integers(0, length - 1))


@LAWS
@given(cuts())
def test_windows_cover_every_frame_fully_and_overlap(cut: tuple[int, int, int]):
    num_frames, length, overlap = cut
    cover = windows(num_frames, length, overlap)
    seen = np.zeros(num_frames, int)
    for w in cover:
        seen[w.frames] += 1
        assert w.num_frames == min(length, num_frames)
    assert (seen >= 1).all()
    assert (cover[0].start, cover[-1].stop) == (0, num_frames)
    for a, b in pairwise(cover):
        assert a.start < b.start <= a.start + length - overlap
        assert a.stop < b.stop
        assert a.overlap_with(b) >= overlap


@LAWS
@given(cuts())
def test_only_the_last_window_leaves_the_step_and_none_is_spare(cut: tuple[int, int, int]):
    num_frames, length, overlap = cut
    cover = windows(num_frames, length, overlap)
    stride = length - overlap
    assert [w.start for w in cover[:-1]] == [stride * i for i in range(len(cover) - 1)]
    if len(cover) > 1:
        assert cover[-2].stop < num_frames


@LAWS
@given(cuts(), st.lists(st.integers(0, 50), max_size=30))
def test_the_stream_gives_the_same_windows(cut: tuple[int, int, int], chunks: list[int]):
    num_frames, length, overlap = cut
    planner = WindowPlanner(length, overlap)
    got: list[Window] = []
    for count in [*chunks, num_frames]:
        count = min(count, num_frames - planner.num_frames)
        needed = planner.needed_from
        ready = planner.push(count)
        assert all(w.start >= needed for w in ready)
        assert all(w.stop <= planner.num_frames for w in ready)
        assert planner.num_frames - planner.needed_from <= length
        got += ready
    needed = planner.needed_from
    last = planner.finish()
    assert all(w.start >= needed for w in last)
    assert got + last == windows(num_frames, length, overlap)
    assert planner.needed_from == num_frames


def test_a_window_is_ready_with_its_last_frame():
    planner = WindowPlanner(32, 8)
    ready_at = {w: i + 1 for i in range(100) for w in planner.push()}
    assert ready_at == {w: w.stop for w in windows(100)[:-1]}
    assert planner.finish() == [Window(68, 100)]


def test_default_cut_of_known_lengths():
    assert windows(1) == [Window(0, 1)]
    assert windows(32) == [Window(0, 32)]
    assert windows(56) == [Window(0, 32), Window(24, 56)]
    assert windows(57) == [Window(0, 32), Window(24, 56), Window(25, 57)]


@pytest.mark.parametrize("count", [0, 1, 2, 7, 8, 31])
def test_ramp_is_linear_inside_and_fair(count: int):
    weights = np.array(ramp(count))
    assert weights.shape == (count,)
    assert ((weights > 0) & (weights < 1)).all()
    np.testing.assert_allclose(weights, 1 - weights[::-1], atol=1e-15)
    np.testing.assert_allclose(np.diff(weights), 1 / (count + 1))


@pytest.mark.parametrize(
    ("arguments", "field"),
    [
        ((0, 32, 8), "num_frames"),
        ((9, 8, 8), "overlap"),
        ((9, 8, -1), "overlap"),
        ((9, 0, 0), "length"),
    ],
)
def test_errors_name_the_field(arguments: tuple[int, int, int], field: str):
    with pytest.raises(ValueError, match=field):
        windows(*arguments)


def test_planner_refuses_an_empty_or_a_finished_stream():
    planner = WindowPlanner()
    with pytest.raises(ValueError, match="num_frames"):
        planner.finish()
    planner.push(3)
    assert planner.finish() == [Window(0, 3)]
    with pytest.raises(ValueError, match="finished"):
        planner.push()
    with pytest.raises(ValueError, match="finished"):
        planner.finish()
    with pytest.raises(ValueError, match="count"):
        WindowPlanner().push(-1)


def test_window_and_ramp_refuse_nonsense():
    with pytest.raises(ValueError, match="start"):
        Window(3, 3)
    with pytest.raises(ValueError, match="overlap"):
        ramp(-1)
