"""Masks, tracks and poses between keyframes, against a rigid scene that is known."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mint_hub.labelling.stages import sfm_tracking as tracking
from tests.labelling import sfm_scenes as scenes

FREE = np.full(scenes.SIZE_HW, 255, np.uint8)


def angle_deg(A: np.ndarray, B: np.ndarray) -> float:
    return float(np.degrees(Rotation.from_matrix(A[:3, :3].T @ B[:3, :3]).magnitude()))


def hand(wrist: tuple[float, float], towards: tuple[float, float], size: float) -> np.ndarray:
    """21 landmarks of an open hand."""
    along = np.array(towards) / np.linalg.norm(towards)
    across = np.array([-along[1], along[0]])
    uv = [np.array(wrist)]
    for finger in range(5):
        for joint in range(4):
            uv.append(wrist + along * size * (0.4 + 0.2 * joint) + across * size * (finger - 2) / 8)
    return np.array(uv)


def test_the_mask_hides_hand_and_forearm_and_little_else() -> None:
    uv = hand((160.0, 150.0), (0.0, -1.0), 60.0)
    mask = tracking.usable_mask(scenes.SIZE_HW, uv[None])
    at = np.rint(uv).astype(int)
    assert not mask[at[:, 1], at[:, 0]].any()
    assert not mask[[170, 200, 239], [160, 160, 160]].any()  # below the wrist, to the border
    assert mask[20, 20] == 255
    assert mask[20, 160] == 255  # beyond the fingers
    assert 0.4 < (mask > 0).mean() < 0.9


def test_landmarks_that_are_not_there_hide_nothing() -> None:
    nothing = np.full((2, 21, 2), np.nan)
    assert tracking.usable_mask((50, 60), nothing).all()
    assert tracking.usable_mask((50, 60), np.zeros((0, 21, 2))).all()


def test_a_frame_is_masked_by_its_neighbours_too() -> None:
    uv = hand((30.0, 40.0), (0.0, -1.0), 20.0)[None]
    frames = np.arange(10)
    masks = tracking.masks_of((60, 60), frames, np.array([4]), uv)
    hidden = [not mask.all() for mask in masks]
    assert hidden == [2 <= f <= 6 for f in frames]


@pytest.mark.parametrize("seed", range(5))
def test_a_pose_is_found_among_outliers(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.uniform([-1, -1, 1], [1, 1, 3], (80, 3))
    truth = np.eye(4)
    truth[:3, :3] = Rotation.from_rotvec(rng.normal(0, 0.3, 3)).as_matrix()
    truth[:3, 3] = rng.normal(0, 0.2, 3)
    uv, depth = tracking.reproject(points, scenes.K, truth)
    assert (depth > 0).all()
    uv = uv + rng.normal(0, 0.2, uv.shape)
    uv[:25] = rng.uniform(0, 300, (25, 2))
    pose = tracking.find_pose(points, uv, scenes.K, np.eye(4))
    assert pose.good
    assert pose.inlier[25:].mean() > 0.97
    assert angle_deg(pose.T_camera_from_world, truth) < 0.1
    assert np.linalg.norm(pose.T_camera_from_world[:3, 3] - truth[:3, 3]) < 0.005


def test_points_without_a_common_pose_give_none() -> None:
    rng = np.random.default_rng(0)
    points, uv = rng.uniform(-1, 1, (60, 3)) + np.array([0, 0, 3]), rng.uniform(0, 300, (60, 2))
    assert not tracking.find_pose(points, uv, scenes.K, np.eye(4)).good
    assert not tracking.find_pose(points[:3], uv[:3], scenes.K, np.eye(4)).good
    assert not tracking.find_pose(points - np.array([0, 0, 9]), uv, scenes.K, np.eye(4)).good


def test_points_are_followed_to_where_they_went() -> None:
    T = scenes.path(4)
    images = scenes.render(T)
    points = scenes.on_plane(scenes.grid(), T[0])
    positions, alive = tracking.follow(images, scenes.pixels(points, T[0]))
    assert alive[-1].mean() > 0.8
    miss = np.linalg.norm(positions[-1] - scenes.pixels(points, T[3]), axis=1)
    assert np.median(miss[alive[-1]]) < 0.1  # a half pixel's confusion would show


def test_frames_between_keyframes_get_their_poses() -> None:
    T = scenes.path(11)
    keyframes, points = scenes.keyframes(T, [0, 5, 10])
    dense = tracking.densify(scenes.render(T), [FREE] * 11, keyframes, points, scenes.K)
    assert dense.first == 0
    assert dense.solved.all()
    straight = tracking.between(T[0], T[5], 0.4)
    for t in range(11):
        got = dense.T_camera_from_world[t]
        assert angle_deg(got, T[t]) < 0.1
        assert np.linalg.norm(got[:3, 3] - T[t, :3, 3]) < 0.002
    assert angle_deg(straight, T[2]) > 0.5  # a straight line would not have done
    assert np.isnan(dense.residual_px[[0, 5, 10]]).all()
    assert np.nanmax(dense.residual_px) < 0.3


def test_a_frame_without_a_view_is_interpolated_and_says_so() -> None:
    T = scenes.path(6)
    keyframes, points = scenes.keyframes(T, [0, 5])
    hidden = [FREE, FREE, np.zeros_like(FREE), FREE, FREE, FREE]
    dense = tracking.densify(scenes.render(T), hidden, keyframes, points, scenes.K)
    assert dense.solved.tolist() == [True, True, False, True, True, True]
    np.testing.assert_allclose(
        dense.T_camera_from_world[2], tracking.between(T[0], T[5], 0.4), atol=1e-12
    )
