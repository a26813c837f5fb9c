import itertools
from dataclasses import replace

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mint_hub.loaders.schema import TextSegment
from mint_hub.view import canvas, plots, strips
from tests.episodes import make_episode


def _count(image, color, rows=slice(None)):
    return int((np.abs(image[rows].astype(int) - color).max(axis=-1) < 24).sum())


def test_the_figure_is_written_as_it_is_drawn(tmp_path):
    episode = make_episode(40)
    path = plots.write_trajectory_plot(episode, tmp_path / "a" / "plot.png")
    back = cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB)
    np.testing.assert_array_equal(back, plots.trajectory_plot(episode))
    with pytest.raises(ValueError, match=r"ends in \.png"):
        plots.write_trajectory_plot(episode, tmp_path / "plot.jpg")


def test_a_hand_that_is_never_there_is_not_drawn():
    episode = make_episode(40, gaps=False)
    panels = slice(190, 730)
    for hand, color in enumerate(canvas.SIDE_COLORS):
        away = np.ones((40, 2), bool)
        away[:, hand] = False
        drawn = plots.trajectory_plot(replace(episode, text=()))
        without = plots.trajectory_plot(replace(episode, text=(), presence=away))
        assert _count(drawn, color, panels) > 500
        assert _count(without, color, panels) == 0


def test_gaps_break_the_lines():
    episode = replace(make_episode(60, gaps=False), text=(), presence_score=None)
    gap = np.ones((60, 2), bool)
    gap[10:50] = False
    panels = slice(190, 730)
    whole, broken = (
        plots.trajectory_plot(replace(episode, presence=presence))[panels]
        for presence in (np.ones((60, 2), bool), gap)
    )
    coloured = [int((np.ptp(im.astype(int), axis=-1) > 60).sum()) for im in (whole, broken)]
    assert coloured[1] < 0.75 * coloured[0]


@pytest.mark.parametrize("view", plots.VIEWS, ids=lambda view: view.title)
def test_metres_are_equal_along_both_axes_and_in_every_view(view):
    panels = plots._axes(plots._paths(make_episode(40)), 200)
    scales = {
        round(float(np.hypot(*(axes.pixels(np.array(step)) - axes.pixels(np.zeros(2))))), 6)
        for axes in panels
        for step in ((1.0, 0.0), (0.0, 1.0))
    }
    assert len(scales) == 1
    # What is further right or up for the view is further right or up on the page.
    right, up = np.zeros(3), np.zeros(3)
    right[view.right[0]], up[view.up[0]] = view.right[1], view.up[1]
    axes, here = panels[0], panels[0].pixels(view.flat(np.zeros(3)))
    assert axes.pixels(view.flat(right))[0] > here[0]
    assert axes.pixels(view.flat(up))[1] < here[1]


def test_everything_lies_inside_its_panel():
    paths = plots._paths(make_episode(90, seed=4))
    for view, axes in zip(plots.VIEWS, plots._axes(paths, 200), strict=True):
        for points, _, _ in paths:
            pixels = axes.pixels(view.flat(points))
            pixels = pixels[np.isfinite(pixels).all(axis=-1)]
            assert (pixels > (axes.left, axes.top)).all()
            assert (pixels < (axes.left + axes.size, axes.top + axes.size)).all()


@pytest.mark.parametrize(
    "episode",
    [
        make_episode(1),
        make_episode(2, gaps=False),
        replace(make_episode(20), presence=np.zeros((20, 2), bool), presence_score=None),
        replace(make_episode(20), T_camera_from_world=np.tile(np.eye(4), (20, 1, 1))),
        replace(
            make_episode(5), text=tuple(TextSegment(str(i), "x" * 99, None, 0, 5) for i in range(9))
        ),
    ],
    ids=["one frame", "two frames", "no hands", "still camera", "crowded text"],
)
def test_degenerate_episodes_have_a_figure(episode):
    image = plots.trajectory_plot(episode)
    assert image.shape[1] == plots.WIDTH
    assert _count(image, canvas.CAMERA) > 100


def test_facts_are_in_the_title():
    episode = make_episode(31)
    assert plots.facts(episode).split("  ·  ")[:2] == ["1.03 s", "31 frames at 30 fps"]
    speed = episode.path_length_m / 1.0
    assert f"mean speed {speed:.2f} m/s" in plots.facts(episode)


# ------------------------------------------------------------------ strips


@given(low=st.floats(-1e3, 1e3), span=st.floats(1e-3, 1e5), count=st.integers(2, 15))
@settings(deadline=None, max_examples=60)
def test_ticks_are_round_enough_and_inside(low, span, count):
    step = strips.nice_step(span, count)
    assert span / count * (1 - 1e-6) <= step <= 2.5 * span / count * (1 + 1e-6)
    ticks = strips.ticks(low, low + span, step)
    assert len(ticks) <= count + 1
    slack = 1e-6 * (abs(low) + span)
    assert all(low - slack <= tick <= low + span + slack for tick in ticks)
    labels = [strips.tick_label(tick, step) for tick in ticks]
    assert len(set(labels)) == len(labels)
    np.testing.assert_allclose([float(label) for label in labels], ticks, atol=1e-3 * step)


@given(st.lists(st.tuples(st.integers(0, 30), st.integers(1, 10)), max_size=12))
@settings(deadline=None, max_examples=60)
def test_text_rows_never_overlap(spans):
    text = tuple(TextSegment(str(i), "", None, a, a + n) for i, (a, n) in enumerate(spans))
    rows = strips.text_rows(text)
    assert len(rows) <= strips.MAX_TEXT_ROWS
    for row in rows:
        assert all(a.end <= b.start for a, b in itertools.pairwise(row))
    placed = [segment for row in rows for segment in row]
    assert len({s.id for s in placed}) == len(placed)
    if len(rows) < strips.MAX_TEXT_ROWS:
        assert len(placed) == len(text)


def test_presence_bars_cover_the_times_they_stand_for():
    presence = np.zeros((40, 2), bool)
    presence[10:30, 0] = True
    episode = replace(make_episode(40), presence=presence, text=(), presence_score=None)
    scale = 2
    image = canvas.blank(420 * scale, 1000 * scale)
    strips.draw_strips(image, episode, strips.Box(0, 30, 1000, 420), scale)
    bar = image[60 * scale]
    blue = np.flatnonzero((bar == canvas.SIDE_COLORS[0]).all(axis=-1))
    left, right = strips.LABEL_WIDTH * scale, 1000 * scale
    np.testing.assert_allclose(
        (blue[[0, -1]] - left) / (right - left), (0.25, 0.75), atol=3 / (right - left)
    )
    orange = (image == canvas.SIDE_COLORS[1]).all(axis=-1)
    assert not orange.any()
