"""Teacher noise: what it must keep, what it must change, and by how much."""

from dataclasses import fields, replace

import numpy as np
import pytest

from mint_hub.conventions import SIDES
from mint_hub.geometry import hand_state as hands
from mint_hub.geometry.rotations import geodesic_angle
from mint_hub.synth.hand_anatomy import straight_axes
from mint_hub.synth.teacher_noise import TeacherNoise, teacher_noise
from tests.episodes import make_episode

NONE = TeacherNoise.none()


@pytest.fixture(scope="module")
def episode():
    made = make_episode(150, seed=3, key="e-3")
    state = made.hand_state.copy()
    state[..., 2] += 0.5
    presence = np.ones((150, 2), bool)
    presence[40:60, 0] = False
    state = np.where(presence[..., None], state, hands.absent((150, 2)))
    filled = np.zeros((150, 2), bool)
    filled[70:80, 1] = True
    return replace(
        made,
        hand_state=state,
        presence=presence,
        presence_score=np.where(presence, np.float32(0.8), 0),
        filled=filled,
    )


def test_no_noise_changes_nothing(episode):
    same = teacher_noise(episode, 5, NONE)
    assert same.meta["teacher_noise"]["scale"] == 1
    assert same.meta.get("scale_status") == episode.meta.get("scale_status")
    assert replace(same, meta=episode.meta).allclose(episode, atol=2e-6)


def test_the_same_seed_gives_the_same(episode):
    one, two, other = (teacher_noise(episode, seed) for seed in (5, 5, 6))
    assert one.allclose(two, atol=0)
    assert not one.allclose(other, atol=1e-3)


def test_scale_is_log_normal_with_median_1_8(episode):
    short = episode.window(0, 2)
    scales = [teacher_noise(short, s).meta["teacher_noise"]["scale"] for s in range(400)]
    assert np.median(scales) == pytest.approx(1.8, rel=0.06)
    assert np.log(scales).std() == pytest.approx(0.35, rel=0.15)


def test_scale_alone_scales_the_path_and_keeps_hands(episode):
    made = teacher_noise(episode, 1, replace(NONE, scale_median=2.5))
    assert made.path_length_m == pytest.approx(2.5 * episode.path_length_m)
    assert np.allclose(made.T_world_from_camera[0], episode.T_world_from_camera[0])
    assert np.allclose(made.T_camera_from_world[:, :3, :3], episode.T_camera_from_world[:, :3, :3])
    assert np.allclose(made.hand_state, episode.hand_state, atol=1e-6)
    assert made.meta["scale_status"] == "pseudo: path enlarged"


def test_drift_grows_from_nothing(episode):
    def turned(k):
        return [
            geodesic_angle(
                teacher_noise(episode, s, replace(NONE, drift_deg=1.0)).T_camera_from_world[
                    k, :3, :3
                ],
                episode.T_camera_from_world[k, :3, :3],
            )
            for s in range(30)
        ]

    assert np.max(turned(0)) < 1e-6
    early, late = np.median(turned(15)), np.median(turned(149))
    assert late > 2 * early > 0


def test_jitter_is_as_large_as_said(episode):
    made = teacher_noise(episode, 2, replace(NONE, jitter_deg=0.5, jitter_m=0.01))
    angle = geodesic_angle(
        made.T_camera_from_world[1:, :3, :3], episode.T_camera_from_world[1:, :3, :3]
    )
    assert np.rad2deg(angle).mean() == pytest.approx(0.5 * 1.6, rel=0.15)  # of three axes
    away = made.T_world_from_camera[1:, :3, 3] - episode.T_world_from_camera[1:, :3, 3]
    assert away.std() == pytest.approx(0.01, rel=0.15)


def test_hands_are_lost_but_never_invented(episode):
    made = teacher_noise(episode, 3, replace(NONE, missing_per_s=1.0, missing_frames=6.0))
    assert made.presence.sum() < episode.presence.sum()
    assert not (made.presence & ~episode.presence).any()
    lost = episode.presence & ~made.presence
    assert made.meta["teacher_noise"]["missing"] == lost.sum()
    assert np.array_equal(made.hand_state[lost], hands.absent((int(lost.sum()),)))
    assert not made.presence_score[lost].any()
    assert np.array_equal(made.presence_score[~lost], episode.presence_score[~lost])
    assert lost[episode.filled].any()
    assert np.array_equal(made.filled, episode.filled & ~lost)
    kept = made.presence
    assert np.allclose(made.hand_state[kept], episode.hand_state[kept], atol=1e-6)


def test_outliers_are_far_and_few(episode):
    made = teacher_noise(episode, 8, replace(NONE, outliers_per_s=0.5, outlier_m=0.4))
    away = np.linalg.norm(made.hand_state[..., :3] - episode.hand_state[..., :3], axis=-1)
    thrown = away > 1e-3
    assert thrown.sum() == made.meta["teacher_noise"]["outlying"] > 0
    assert thrown.mean() < 0.25
    assert np.median(away[thrown]) > 0.15


def test_a_swap_is_its_own_inverse_and_keeps_where_hands_point(episode):
    always = replace(NONE, swaps_per_s=30.0)
    made = teacher_noise(episode, 1, always)
    assert made.meta["teacher_noise"]["swapped"] == 150
    assert np.array_equal(made.presence, episode.presence[:, ::-1])
    assert np.array_equal(made.presence_score, episode.presence_score[:, ::-1])
    assert np.array_equal(made.filled, episode.filled[:, ::-1])
    both = episode.presence.all(1)
    before, after = (hands.unpack(e.hand_state[both].astype(float)) for e in (episode, made))
    assert np.allclose(after.translation, before.translation[:, ::-1])
    axes = np.stack([straight_axes(side) for side in SIDES])
    R = before.orientation() @ axes
    S = after.orientation()[:, ::-1] @ axes[::-1]
    assert np.allclose(S[..., 0], -R[..., 0], atol=1e-5)  # a left hand's fingers are at +x
    assert np.allclose(S[..., 1], R[..., 1], atol=1e-5)  # palms face -y on both
    assert teacher_noise(made, 1, always).allclose(
        replace(episode, meta=teacher_noise(made, 1, always).meta), atol=1e-5
    )


def test_a_hand_that_is_lost_and_swapped_has_no_score_on_the_other_side(episode):
    settings = replace(NONE, missing_per_s=1.0, missing_frames=6.0, swaps_per_s=30.0)
    made = teacher_noise(episode, 3, settings)
    lost = made.meta["teacher_noise"]["missing"]
    assert 0 < lost == episode.presence.sum() - made.presence.sum()
    assert np.array_equal(made.presence_score > 0, made.presence)
    assert not (made.filled & ~made.presence).any()


def test_the_default_is_as_wrong_as_a_cascade(episode):
    made = [teacher_noise(episode, s) for s in range(20)]
    assert all(e.meta["scale_status"].startswith("pseudo") for e in made)
    noted = [e.meta["teacher_noise"] for e in made]
    for name in ("outlying", "missing", "swapped"):
        assert 0 < sum(n[name] for n in noted) < 0.2 * 20 * 300, name


@pytest.mark.parametrize("name", [f.name for f in fields(TeacherNoise)])
def test_bad_settings_are_named(name):
    with pytest.raises(ValueError, match=f"{name}: expected 0 or more, got -1"):
        TeacherNoise(**{name: -1.0})
