"""Windows mirrored, cropped, turned, timed: labels stay exact, as are pictures."""

from dataclasses import replace

import numpy as np
import pytest

from mint_hub.geometry.camera import project
from mint_hub.geometry.hand_model import HandModel
from mint_hub.training.views import Tempo, View, ViewAugmentation
from tests.training.corpus import training_episode

HAND = HandModel.template()
MIRROR = np.diag([-1.0, 1.0, 1.0])


def episode():
    made = replace(training_episode("e0", 12), image_size_hw=(60, 90))
    filled = made.presence & (np.arange(12) % 3 == 0)[:, None]
    filled[:, 1] = False
    return replace(made, filled=filled)


def joints_of(ep):
    return np.asarray(HAND.keypoints(ep.hand_state.astype(float)))


def test_a_mirrored_window_is_the_mirrored_scene():
    before = episode()
    after = View(mirror=True).episode(before)
    np.testing.assert_allclose(joints_of(after), (joints_of(before) @ MIRROR)[:, ::-1], atol=1e-6)
    np.testing.assert_array_equal(after.presence, before.presence[:, ::-1])
    np.testing.assert_array_equal(after.presence_score, before.presence_score[:, ::-1])
    np.testing.assert_array_equal(after.filled, before.filled[:, ::-1])
    twice = View(mirror=True).episode(after)
    np.testing.assert_allclose(twice.T_camera_from_world, before.T_camera_from_world, atol=1e-12)
    np.testing.assert_allclose(twice.hand_state, before.hand_state, atol=1e-6)


def test_a_mirrored_camera_sees_the_mirrored_world():
    before = episode()
    after = View(mirror=True).episode(before)
    points = np.random.default_rng(0).normal(size=(7, 3))
    for old, new in zip(before.T_camera_from_world, after.T_camera_from_world, strict=True):
        seen = points @ old[:3, :3].T + old[:3, 3]
        mirrored = points @ MIRROR @ new[:3, :3].T + new[:3, 3]
        np.testing.assert_allclose(mirrored, seen @ MIRROR, atol=1e-9)
        assert np.linalg.det(new[:3, :3]) == pytest.approx(1)


TURN = (0.08, -0.06, 0.15)


@pytest.mark.parametrize(
    "view",
    [
        View(),
        View(True),
        View(zoom=0.7),
        View(True, 0.8),
        View(turn_rad=TURN),
        View(True, 0.8, TURN),
    ],
)
def test_a_point_of_the_scene_is_where_the_labels_project_it(view):
    """A spot that is drawn at a projected point is found, in the new picture, where it should."""
    before = episode()
    v, u = np.mgrid[:60, :90] + 0.5
    rng = np.random.default_rng(1)
    for _ in range(8):
        point = np.array([*rng.uniform(-0.12, 0.12, 2), 0.5])
        uv, _ = project(point, before.K[0])
        spot = 255 * np.exp(-((u - uv[0]) ** 2 + (v - uv[1]) ** 2) / 8)
        image = np.repeat(spot[..., None], 3, -1).astype(np.uint8)
        seen = view.images(image[None], before.fov_vh_rad[:1], (40, 50))[0, ..., 0].astype(float)
        rows, columns = np.mgrid[:40, :50] + 0.5
        found = np.array([(columns * seen).sum(), (rows * seen).sum()]) / seen.sum()
        after = replace(view.episode(before), image_size_hw=(40, 50))
        moved = point @ MIRROR if view.mirror else point
        expected, _ = project(moved @ view.turn.T, after.K[0])
        np.testing.assert_allclose(found, expected, atol=0.1)


@pytest.mark.parametrize("mirror", [False, True])
def test_a_turned_camera_sees_the_same_world_from_the_same_place(mirror):
    before, view = View(mirror=mirror).episode(episode()), View(mirror, turn_rad=TURN)
    after = view.episode(episode())
    centres = [np.linalg.inv(e.T_camera_from_world)[:, :3, 3] for e in (before, after)]
    np.testing.assert_allclose(centres[1], centres[0], atol=1e-9)
    world = [e.joints_world(HAND) for e in (before, after)]
    there = after.presence
    assert there.any()
    np.testing.assert_allclose(world[1][there], world[0][there], atol=1e-5)
    assert not (after.presence & ~before.presence).any()
    np.testing.assert_array_equal(after.fov_vh_rad, before.fov_vh_rad)


def test_another_tempo_takes_every_nth_frame_and_runs_back():
    before = episode()
    stretch = before.window(2, Tempo(3).span(3))
    forward, back = Tempo(3).episode(stretch), Tempo(3, backward=True).episode(stretch)
    assert forward.num_frames == back.num_frames == 3
    for name in ("T_camera_from_world", "hand_state", "presence", "fov_vh_rad", "filled"):
        np.testing.assert_array_equal(getattr(forward, name), getattr(before, name)[2:9:3])
        np.testing.assert_array_equal(getattr(back, name), getattr(before, name)[8:1:-3])
    np.testing.assert_array_equal(back.timestamps_s, before.timestamps_s[2:9:3])
    assert back.fps == pytest.approx(before.fps / 3)
    images = np.arange(7)[:, None, None, None] * np.ones((1, 2, 2, 3), np.uint8)
    assert Tempo(3, True).frames(images)[:, 0, 0, 0].tolist() == [6, 3, 0]
    with pytest.raises(ValueError, match="step: expected at least 1, got 0"):
        Tempo(0)


def test_hands_outside_a_crop_are_not_present():
    before = episode()
    state = before.hand_state.copy()
    state[..., :3] = [0.0, 0.0, 2.0]
    state[:, 1, 0] = 0.9 * 2.0 * np.tan(before.fov_vh_rad[0, 1] / 2)  # near the picture's border
    seen = np.ones_like(before.presence)
    score = seen * np.float32(0.9)
    before = replace(
        before, hand_state=state, presence=seen, presence_score=score, filled=seen.copy()
    )
    after = View(zoom=0.5).episode(before)
    assert after.presence[:, 0].all()
    assert not after.presence[:, 1].any()
    assert (after.presence_score[:, 1] == 0).all()
    np.testing.assert_array_equal(after.filled, after.presence)
    assert (after.presence_score[:, 0] == np.float32(0.9)).all()
    np.testing.assert_allclose(
        np.tan(after.fov_vh_rad / 2), 0.5 * np.tan(before.fov_vh_rad / 2), rtol=1e-5
    )


def test_hands_of_another_shape_space_are_looked_for_as_the_mean_hand():
    rng = np.random.default_rng(0)
    before = episode()
    shaped, mean = before.hand_state.copy(), before.hand_state.copy()
    shaped[..., -10:], mean[..., -10:] = rng.normal(size=10) * 6, 0.0
    made = [
        replace(before, hand_state=state, meta={**before.meta, "shape_space": space})
        for state, space in ((shaped, "mano"), (mean, "mint"), (shaped, "mint"))
    ]
    views = [View(zoom=zoom) for zoom in (0.3, 0.35, 0.4, 0.45, 0.5, 0.6, 0.7)]
    mano, template, read = (np.array([v.episode(e).presence for v in views]) for e in made)
    np.testing.assert_array_equal(mano, template)
    assert (read != template).any()  # what taking them for ours would give


def test_views_are_drawn_as_said_and_bad_ones_refused():
    rng = np.random.default_rng(0)
    drawn = [ViewAugmentation(mirror=0.3, zoom=0.6)(rng) for _ in range(600)]
    assert np.mean([v.mirror for v in drawn]) == pytest.approx(0.3, abs=0.06)
    assert np.mean([v.zoom == 1 for v in drawn]) == pytest.approx(0.5, abs=0.06)
    assert min(v.zoom for v in drawn) > 0.6
    turns = np.degrees([v.turn_rad for v in drawn])
    assert (np.abs(turns).max(0) <= [8.001, 8.001, 12.001]).all()
    np.testing.assert_allclose(turns.std(0), [3.9, 3.9, 5.8], rtol=0.15)
    tempi = [ViewAugmentation(steps=3, backward=0.5).tempo(rng) for _ in range(600)]
    assert np.mean([p.step == 1 for p in tempi]) == pytest.approx(0.5, abs=0.06)
    assert {p.step for p in tempi} == {1, 2, 3}
    assert np.mean([p.backward for p in tempi]) == pytest.approx(0.5, abs=0.06)
    with pytest.raises(ValueError, match="zoom: expected more than 0, at most 1, got 0"):
        View(zoom=0)
