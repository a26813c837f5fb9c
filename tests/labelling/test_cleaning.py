"""Cleaning exact motion that was spoilt: what goes, what stays, what is bridged."""

import numpy as np
import pytest

from mint_hub.geometry import hand_state, rigid
from mint_hub.geometry.rotations import geodesic_angle, rotvec_to_matrix
from mint_hub.geometry.smoothing import smooth_hands
from mint_hub.labelling.cleaning import CleaningSettings, clean_hands
from mint_hub.labelling.stages.clean import one_shape
from tests.labelling.motion import exact_motion

FRAMES = 330


def shifted(state, frames, side, metres):
    state[frames, side, :3] += np.asarray(metres, np.float32)


def turned(state, frames, side, degrees):
    hand = hand_state.unpack(state[frames, side].astype(float))
    turn = rotvec_to_matrix(np.radians([0.0, 0.0, degrees]))
    changed = hand_state.HandState.from_matrices(
        hand.translation, hand.orientation() @ turn, hand.joint_rotations(), hand.shape_params
    )
    state[frames, side] = np.asarray(changed.pack())


def world_wrist(state, T_camera_from_world):
    hand = hand_state.unpack(state.astype(float))
    wrist = rigid.rigid(hand.orientation(), hand.translation)
    return rigid.inverse(T_camera_from_world)[:, None] @ wrist


def errors(state, truth, T_camera_from_world):
    """Wrist errors in metres and degrees, (T, 2)."""
    got, exact = (world_wrist(s, T_camera_from_world) for s in (state, truth))
    metres = np.linalg.norm(got[..., :3, 3] - exact[..., :3, 3], axis=-1)
    return metres, np.degrees(geodesic_angle(got[..., :3, :3], exact[..., :3, :3]))


def spoilt(seed):
    """Return (truth, poses, spoilt state, presence, wrong (T, 2), hidden (T, 2))."""
    rng = np.random.default_rng(seed)
    truth, T_camera_from_world = exact_motion(FRAMES, seed)
    state, presence = truth.copy(), np.ones((FRAMES, 2), bool)
    wrong = np.zeros((FRAMES, 2), bool)
    for side in range(2):  # blocks, single outliers, and gaps, apart from each other
        places = 12 + 28 * rng.permutation(10)
        for place in places[:2]:
            block = slice(place, place + int(rng.integers(2, 12)))
            shifted(state, block, side, rng.choice([-1, 1], 3) * rng.uniform(0.2, 0.5, 3))
            wrong[block, side] = True
        block = slice(places[2], places[2] + int(rng.integers(2, 12)))
        turned(state, block, side, rng.uniform(70, 150))
        wrong[block, side] = True
        for place in places[3:6]:
            shifted(state, place, side, [0, 0, rng.uniform(0.2, 0.4)])
            wrong[place, side] = True
        for place in places[6:8]:
            presence[place : place + int(rng.integers(2, 25)), side] = False
    swap = 12 + 28 * 10 + 20
    state[swap : swap + 6] = state[swap : swap + 6, ::-1]
    wrong[swap : swap + 6] = presence[swap : swap + 6]
    return truth, T_camera_from_world, state, presence, wrong & presence, ~presence


@pytest.mark.parametrize("seed", range(10))
def test_outliers_go_and_gaps_are_bridged(seed):
    truth, poses, state, presence, wrong, hidden = spoilt(seed)
    cleaned = clean_hands(state, presence, poses)
    removed = cleaned.spikes | cleaned.outliers
    assert (removed & wrong).sum() / removed.sum() >= 0.98
    assert (removed & wrong).sum() / wrong.sum() >= 0.98
    assert cleaned.presence.all()  # every gap here is short enough
    np.testing.assert_array_equal(cleaned.filled, removed | hidden)
    metres, degrees = errors(cleaned.hand_state, truth, poses)
    before_m, before_deg = errors(state, truth, poses)
    seen = presence
    assert metres[seen].mean() < 0.1 * before_m[seen].mean()
    assert degrees[seen].mean() < 0.5 * before_deg[seen].mean()
    assert metres[hidden].max() < 0.08
    assert np.all(metres[seen & ~wrong & ~removed] < 1e-6)  # good samples are not touched


@pytest.mark.parametrize("seed", range(5))
def test_clean_input_comes_back_as_it_was(seed):
    truth, poses = exact_motion(FRAMES, seed)
    cleaned = clean_hands(truth, np.ones((FRAMES, 2), bool), poses)
    np.testing.assert_array_equal(cleaned.hand_state, truth)
    assert not (cleaned.filled | cleaned.spikes | cleaned.outliers).any()


@pytest.mark.parametrize("seed", range(5))
def test_smoothing_after_cleaning_takes_jitter_not_truth(seed):
    rng = np.random.default_rng(seed)
    truth, poses = exact_motion(FRAMES, seed)
    state = truth.copy()
    state[..., :3] += rng.normal(0, 0.004, state[..., :3].shape).astype(np.float32)
    presence = np.ones((FRAMES, 2), bool)
    cleaned = clean_hands(state, presence, poses)
    smooth = np.asarray(smooth_hands(cleaned.hand_state, cleaned.presence))

    def jitter(x):
        return np.linalg.norm(np.diff(world_wrist(x, poses)[..., :3, 3], 2, axis=0), axis=-1).mean()

    excess_before, excess_after = jitter(state) - jitter(truth), jitter(smooth) - jitter(truth)
    assert excess_after < 0.25 * excess_before
    assert errors(smooth, truth, poses)[0].mean() < errors(state, truth, poses)[0].mean()


def test_a_jump_that_never_returns_stays():
    truth, poses = exact_motion(FRAMES)
    state = truth.copy()
    shifted(state, slice(150, None), 0, [0.5, 0, 0])
    cleaned = clean_hands(state, np.ones((FRAMES, 2), bool), poses)
    assert not cleaned.spikes.any()
    assert cleaned.presence.all()


@pytest.mark.parametrize(("frames", "bridged"), [(30, True), (31, False)])
def test_gaps_beyond_the_limit_stay_open(frames, bridged):
    truth, poses = exact_motion(FRAMES)
    presence = np.ones((FRAMES, 2), bool)
    presence[100 : 100 + frames, 1] = False
    cleaned = clean_hands(truth, presence, poses)
    assert cleaned.filled[100 : 100 + frames, 1].all() == bridged
    assert cleaned.presence[100 : 100 + frames, 1].any() == bridged
    if not bridged:
        absent = np.asarray(hand_state.absent(), np.float32)
        np.testing.assert_array_equal(cleaned.hand_state[100, 1], absent)


@pytest.mark.parametrize(("frames", "gone"), [(15, True), (16, False)])
def test_blocks_beyond_the_limit_stay(frames, gone):
    truth, poses = exact_motion(FRAMES)
    state = truth.copy()
    shifted(state, slice(100, 100 + frames), 0, [0.4, 0, 0])
    cleaned = clean_hands(state, np.ones((FRAMES, 2), bool), poses)
    assert cleaned.spikes[100 : 100 + frames, 0].all() == gone


def test_head_motion_is_not_hand_motion():
    """A hand that rests in the world, seen by a head that turns fast, is no outlier."""
    truth, poses = exact_motion(FRAMES)
    turn = rotvec_to_matrix(np.linspace([0, 0, 0], [0, 0, 20], FRAMES))  # 3.8 degrees a frame
    fast = rigid.rigid(turn, np.zeros((FRAMES, 3))) @ poses
    wrist = world_wrist(truth, poses)[:1].repeat(FRAMES, axis=0)
    seen = fast[:, None] @ wrist
    hand = hand_state.unpack(truth.astype(float))
    state = hand_state.HandState.from_matrices(
        seen[..., :3, 3], seen[..., :3, :3], hand.joint_rotations(), hand.shape_params
    ).pack()
    settings = CleaningSettings(spike_step_m=0.01, spike_step_deg=1.0, outlier_floor_m=0.01)
    presence = np.ones((FRAMES, 2), bool)
    cleaned = clean_hands(np.asarray(state, np.float32), presence, fast, settings)
    assert not (cleaned.spikes | cleaned.outliers).any()


def test_one_hand_has_one_shape():
    state, _ = exact_motion(20)
    state = state.copy()
    state[:, 0, 99:] = np.arange(20)[:, None]
    presence = np.ones((20, 2), bool)
    observed = presence.copy()
    observed[10:, 0] = False
    shape = hand_state.unpack(one_shape(state, presence, observed)).shape_params
    np.testing.assert_allclose(shape[:, 0], 4.5)


def test_nobody_there():
    state = np.asarray(hand_state.absent((5, 2)), np.float32)
    cleaned = clean_hands(state, np.zeros((5, 2), bool), np.tile(np.eye(4), (5, 1, 1)))
    assert not cleaned.presence.any()
    with pytest.raises(ValueError, match=r"expected hand_state \(T, 2, 109\)"):
        clean_hands(state, np.zeros((4, 2), bool), np.tile(np.eye(4), (5, 1, 1)))
