"""Movements: they end where they should, exactly, and never jump."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from mint_hub.geometry.rigid import rigid
from mint_hub.geometry.rotations import geodesic_angle, rotvec_to_matrix
from mint_hub.synth.camera_motion import (
    QUICK_TURN_RAD_S,
    TURN_RAD_S,
    HeadStyle,
    camera_path,
    draw_style,
    median_steps,
)
from mint_hub.synth.motion import AngleTrack, PoseTrack, envelope, minimum_jerk, smooth_noise


def random_pose(rng: np.random.Generator) -> np.ndarray:
    return np.asarray(rigid(rotvec_to_matrix(rng.normal(size=3)), rng.normal(size=3)))


def test_minimum_jerk_starts_and_stops_at_rest():
    s = np.array([-1.0, 0.0, 0.5, 1.0, 2.0])
    assert np.allclose(minimum_jerk(s), [0, 0, 0.5, 1, 1])
    for edge in (0.0, 1.0):
        assert abs(minimum_jerk(np.array(edge + 1e-4)) - minimum_jerk(np.array(edge))) < 1e-9


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 1000), st.floats(0.0, 0.4))
def test_overlapping_moves_end_at_the_last_target(seed, overlap):
    rng = np.random.default_rng(seed)
    track, time = PoseTrack(random_pose(rng)), 0.0
    for _ in range(4):
        time = track.to(random_pose(rng), time - overlap, 0.5, rng.normal(size=3)) + 0.0
    assert np.allclose(track.at(np.array([track.end + 1.0]))[0], track.target, atol=1e-9)
    fine = track.at(np.arange(-0.5, track.end + 0.5, 0.002))
    assert np.linalg.norm(np.diff(fine[:, :3, 3], axis=0), axis=1).max() < 0.1
    assert geodesic_angle(fine[1:, :3, :3], fine[:-1, :3, :3]).max() < 0.15


def test_going_back_forgets():
    rng = np.random.default_rng(0)
    track = PoseTrack(random_pose(rng))
    track.to(random_pose(rng), 0.0, 1.0)
    times = np.linspace(0, 3, 7)
    before, mark = track.at(times), track.mark()
    track.to(random_pose(rng), 0.5, 1.0)
    track.back_to(*mark)
    assert np.array_equal(track.at(times), before)
    assert track.end == 1.0


def test_angles_add_up():
    track = AngleTrack(np.zeros(3))
    track.to(np.array([10.0, 20.0, 30.0]), 0.0, 1.0)
    track.to(np.array([0.0, 5.0, 0.0]), 0.5, 1.0)
    assert np.allclose(track.at(np.array([-1.0, 2.0])), [[0, 0, 0], [0, 5, 0]])


def test_noise_has_deviation_one_and_no_high_frequencies():
    times = np.arange(0, 200, 1 / 30)
    noise = smooth_noise(np.random.default_rng(3), times, 4, 2.0)
    assert np.allclose(noise.std(0), 1, atol=0.15)
    power = np.abs(np.fft.rfft(noise, axis=0)) ** 2
    frequency = np.fft.rfftfreq(len(times), 1 / 30)
    assert power[frequency > 2.1].sum() < 0.02 * power.sum()


def test_envelopes_are_zero_at_both_ends():
    times = np.array([0.9, 1.0, 1.5, 2.0, 2.1])
    assert np.allclose(envelope(times, 1.0, 2.0), [0, 0, 1, 0, 0])


def test_the_head_looks_where_the_hands_work():
    """A shift of gaze to the right turns the camera to the right, and roll stays small."""
    rng, times = np.random.default_rng(5), np.arange(120) / 30
    style = draw_style(rng, np.array([0.0, -0.05, 0.5]), 0.3, 1.0, 4.0)
    path = camera_path(style, [(0.5, np.array([0.5, 0.4, 0.0]))], times)
    ahead = path[:, 2, :3]
    assert ahead[45, 0] > ahead[0, 0] + 0.1
    assert np.rad2deg(np.abs(np.arcsin(path[:, 0, 2]))).max() < 25
    still, lively = (median_steps(camera_path(style, [], times, s)) for s in (0.2, 2.0))
    assert lively[0] > 3 * still[0]


@settings(deadline=None, max_examples=40)
@given(st.floats(-1.2, 1.2), st.floats(0.1, 0.9), st.floats(-0.2, 0.3), st.booleans())
def test_heads_turn_no_faster_than_heads_do(x, y, z, quick):
    """One shift of gaze by a head that does nothing else, wherever it goes."""
    goal = np.array([x, y, z])
    style = HeadStyle(
        eye=np.array([0.0, -0.1, 0.5]),
        lift=0.0,
        follow=1.0,
        lean=np.zeros(3),
        bob=0.0,
        step_hz=1.5,
        jitter=0.0,
        away=((1.5, goal, 0.5),) if quick else (),
        seed=3,
    )
    gaze = [] if quick else [(1.5, goal)]
    times = np.arange(0, 6, 1 / 120)
    R = camera_path(style, gaze, times, strength=0.0)[:, :3, :3]
    speed = np.asarray(geodesic_angle(R[1:], R[:-1])) * 120
    limit = QUICK_TURN_RAD_S if quick else TURN_RAD_S
    assert speed.max() < 1.02 * limit + np.deg2rad(12)  # roll drifts beside it
    if np.linalg.norm(goal - [0.0, 0.26, 0.03]) > 0.1:
        assert speed.max() > 0.05  # it did turn
