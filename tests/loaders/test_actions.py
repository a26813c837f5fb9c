"""Actions: VITRA's definition on a real annotation, and poses back from actions."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from mint_hub.conventions import LEFT, RIGHT
from mint_hub.geometry import hand_state as hands
from mint_hub.geometry import rigid
from mint_hub.geometry.plain_pickle import load_plain_npy
from mint_hub.geometry.rotations import matrix_to_rot6d_rows
from mint_hub.loaders import actions
from mint_hub.loaders.actions import action_chunks, euler_xyz_to_matrix, integrate
from mint_hub.loaders.vitra import from_vitra
from tests.episodes import make_episode

MODES = [(r, f) for r in ("step", "anchor") for f in ("absolute", "relative")]


def states_in_first_camera(episode, start: int, length: int) -> np.ndarray:
    """Hand states (L + 1, 2, 109) of a chunk's frames in the camera of its first, by the names."""
    frames = slice(start, start + length + 1)
    T_camera_from_world = episode.T_camera_from_world[start]
    state = hands.unpack(episode.hand_state[frames].astype(np.float64))
    wrist = rigid.rigid(state.orientation(), state.translation)
    moved = T_camera_from_world @ episode.T_world_from_camera[frames, None] @ wrist
    return replace(
        state,
        translation=moved[..., :3, 3],
        orientation_rot6d_rows=matrix_to_rot6d_rows(moved[..., :3, :3]),
        joint_rot6d_rows=matrix_to_rot6d_rows(state.joint_rotations()),
    ).pack()


def test_sizes_are_vitras():
    chunks = action_chunks(make_episode(40))
    assert chunks.action.shape == (40, 16, 102)
    assert chunks.mask.shape == (40, 16, 2)
    assert chunks.state.shape == (40, 122)
    assert chunks.action.dtype == np.float32
    assert (actions.PADDED_ACTION_SIZE, actions.PADDED_STATE_SIZE) == (192, 212)


@pytest.mark.parametrize(("relative", "fingers"), MODES)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_integrating_actions_gives_the_poses_back(relative, fingers, dtype):
    episode = make_episode(60, seed=3)
    chunks = action_chunks(episode, relative=relative, fingers=fingers, dtype=dtype)
    poses = integrate(chunks)
    assert 0.4 < poses.known.mean() < 1
    for start in range(episode.num_frames):
        expected = states_in_first_camera(episode, start, 16)
        known = poses.known[start, : len(expected)]
        got = poses.hand_state[start, : len(expected)]
        assert_allclose(got[known], expected[known], atol=1e-6)
        assert not poses.known[start, len(expected) :].any()
    unknown = poses.hand_state[~poses.known]
    assert_array_equal(unknown, hands.absent((len(unknown),)))


def test_poses_are_known_as_far_as_every_step_counts():
    episode = make_episode(60, seed=3)
    reach = integrate(action_chunks(episode)).known
    anchored = integrate(action_chunks(episode, relative="anchor")).known
    for start in range(60):
        there = np.zeros((17, 2), bool)
        there[: 60 - start] = episode.presence[start : start + 17]
        assert_array_equal(reach[start], np.logical_and.accumulate(there))
        assert_array_equal(anchored[start], there & there[0])


@pytest.mark.parametrize("relative", ["step", "anchor"])
def test_the_last_frame_has_no_action_and_masked_steps_are_zero(relative):
    episode = make_episode(40, gaps=False)
    chunks = action_chunks(episode, relative=relative)
    assert not chunks.mask[-1].any()
    assert chunks.state_mask[-1].all()
    for start in range(40):
        steps = min(16, 39 - start)
        assert chunks.mask[start, :steps].all()
        assert not chunks.mask[start, steps:].any()
    numbers = chunks.action.reshape(40, 16, 2, 51)
    assert not numbers[~chunks.mask].any()
    assert numbers[chunks.mask].any(axis=-1).all()


def test_an_absent_hand_has_no_action_and_no_state():
    episode = make_episode(60, seed=1)
    chunks = action_chunks(episode)
    assert_array_equal(chunks.state_mask, episode.presence)
    assert not chunks.state.reshape(60, 2, 61)[~episode.presence].any()
    first = chunks.mask[:-1, 0]
    assert_array_equal(first, episode.presence[:-1] & episode.presence[1:])


def test_actions_do_not_depend_on_the_choice_of_world():
    episode = make_episode(40, seed=2)
    T_world_from_other = np.eye(4)
    T_world_from_other[:3, :3] = Rotation.from_rotvec([0.3, -1.2, 2.0]).as_matrix()
    T_world_from_other[:3, 3] = [3.0, -2.0, 1.0]
    moved = replace(episode, T_camera_from_world=episode.T_camera_from_world @ T_world_from_other)
    a, b = (action_chunks(e, dtype=np.float64) for e in (episode, moved))
    assert_allclose(a.action, b.action, atol=1e-9)
    assert_allclose(a.state, b.state, atol=1e-9)


def vitra_by_hand(raw: dict, side: str, start: int, k: int) -> np.ndarray:
    """One hand's action (51,) from VITRA's own arrays, in the words of its definition."""
    R_w2c, t_w2c = raw["extrinsics"][start, :3, :3], raw["extrinsics"][start, :3, 3]
    hand = raw[side]

    def pose(frame: int):
        place = R_w2c @ hand["transl_worldspace"][frame] + t_w2c
        return place, R_w2c @ hand["global_orient_worldspace"][frame]

    (x0, R0), (x1, R1) = pose(k), pose(k + 1)
    fingers = Rotation.from_matrix(hand["hand_pose"][k + 1]).as_euler("xyz")
    return np.concatenate(
        [x1 - x0, Rotation.from_matrix(R1 @ R0.T).as_euler("xyz"), fingers.ravel()]
    )


def test_vitras_definition_is_reproduced_on_the_real_annotation(real_dir: Path):
    (path,) = (real_dir / "ego4d").glob("*.npy")
    raw, episode = load_plain_npy(path), from_vitra(path)
    chunks = action_chunks(episode)
    numbers = chunks.action.reshape(25, 16, 2, 51)
    assert not chunks.mask[..., LEFT].any()
    for start in range(25):
        for k in range(16):
            inside = start + k + 1 < 25
            assert chunks.mask[start, k, RIGHT] == inside
            if inside:
                expected = vitra_by_hand(raw, "right", start, start + k)
                assert_allclose(numbers[start, k, RIGHT], expected, atol=1e-6)
    wrist = episode.hand_state[:, RIGHT, hands.TRANSLATION]
    state = chunks.state.reshape(25, 2, 61)
    assert_allclose(state[:, RIGHT, :3], wrist, atol=1e-6)
    assert_allclose(state[:, RIGHT, 51:], np.tile(raw["right"]["beta"], (25, 1)), atol=1e-6)
    poses = integrate(chunks)
    for start in range(25):
        expected = states_in_first_camera(episode, start, 16)
        got = poses.hand_state[start, : len(expected), RIGHT]
        assert_allclose(got, expected[:, RIGHT], atol=1e-6)


def test_windows_of_a_reader_give_the_same_chunks():
    episode = make_episode(50, seed=4)
    starts = np.array([0, 7, 30, 33])
    frames = starts[:, None] + np.arange(17)
    windows = actions.window_actions(
        episode.T_camera_from_world[frames], episode.hand_state[frames], episode.presence[frames]
    )
    chunks = action_chunks(episode, starts)
    assert len(windows) == 4
    for name in ("action", "mask", "state", "state_mask"):
        assert_array_equal(getattr(windows, name), getattr(chunks, name))


def test_padding_puts_every_number_where_vitra_wants_it():
    chunks = action_chunks(make_episode(60, seed=1))
    action, mask = actions.pad_action(chunks.action, chunks.mask)
    assert action.shape == mask.shape == (60, 16, 192)
    assert_array_equal(action[..., :102], chunks.action)
    assert not action[..., 102:].any()
    assert_array_equal(mask[..., [0, 50, 51, 101]], chunks.mask[..., [0, 0, 1, 1]])
    assert not mask[..., 102:].any()
    state, state_mask = actions.pad_state(chunks.state, chunks.state_mask)
    assert state.shape == state_mask.shape == (60, 212)
    assert_array_equal(state[:, :51], chunks.state[:, :51])
    assert_array_equal(state[:, 51:102], chunks.state[:, 61:112])
    assert not state[:, 102:].any()
    full, full_mask = actions.pad_state(chunks.state, chunks.state_mask, with_shape=True)
    assert_array_equal(full[:, 192:202], chunks.state[:, 51:61])
    assert_array_equal(full[:, 202:], chunks.state[:, 112:])
    assert_array_equal(full_mask[:, [192, 202]], chunks.state_mask)


@settings(deadline=None, max_examples=50)
@given(st.integers(0, 2**32 - 1))
def test_euler_angles_are_scipys_and_come_back(seed):
    R = Rotation.random(20, random_state=seed)
    angles = actions.matrix_to_euler_xyz(R.as_matrix())
    assert_allclose(angles, R.as_euler("xyz"), atol=1e-9)
    assert_allclose(euler_xyz_to_matrix(angles), R.as_matrix(), atol=1e-12)


@settings(deadline=None, max_examples=50)
@given(
    st.floats(-3, 3),
    st.sampled_from([-np.pi / 2, np.pi / 2]),
    st.floats(-1e-6, 1e-6),
    st.floats(-3, 3),
)
def test_a_locked_gimbal_keeps_the_rotation(a, b, off, c):
    R = euler_xyz_to_matrix(np.array([a, b + off, c]))
    assert_allclose(euler_xyz_to_matrix(actions.matrix_to_euler_xyz(R)), R, atol=2e-7)


def test_bad_input_says_what_was_expected():
    episode = make_episode(10)
    with pytest.raises(ValueError, match=r"0 <= start <= 9, got 10 \(episode synthetic-0\)"):
        action_chunks(episode, [3, 10])
    with pytest.raises(ValueError, match="starts: expected whole numbers"):
        action_chunks(episode, np.array([0.5]))
    with pytest.raises(ValueError, match="length: expected at least 1"):
        action_chunks(episode, length=0)
    with pytest.raises(ValueError, match="got 'first' and 'absolute'"):
        action_chunks(episode, relative="first")
    with pytest.raises(ValueError, match=r"hand_state: expected \(N, L \+ 1 >= 2, 2, 109\)"):
        actions.window_actions(np.zeros((1, 3, 4, 4)), np.zeros((1, 3, 2, 9)), np.ones((1, 3, 2)))
    chunks = action_chunks(episode)
    with pytest.raises(ValueError, match=r"state: expected \(10, 122\) beside action"):
        integrate(replace(chunks, state=chunks.state[:, :51]))
