"""Re-anchored poses, and how far cameras move."""

import numpy as np

from mint_hub.geometry.rigid import inverse
from mint_hub.training.normalisation import CameraSums, reanchored, window_starts
from tests.episodes import make_episode


def test_the_first_frame_becomes_the_world():
    poses = make_episode(20, seed=4).T_camera_from_world[5:]
    relative = reanchored(poses)
    assert (relative[0] == np.eye(4)).all()
    np.testing.assert_allclose(relative, poses @ inverse(poses[0]), atol=1e-12)
    assert np.linalg.det(relative[:, :3, :3]).round(12).tolist() == [1.0] * 15


def test_tails_are_dropped():
    assert list(window_starts(99, 32, 32)) == [0, 32, 64]
    assert list(window_starts(96, 32, 32)) == [0, 32, 64]
    assert list(window_starts(31, 32, 32)) == []
    assert list(window_starts(40, 32, 4)) == [0, 4, 8]


def test_scales_are_population_deviations_over_all_windows():
    episodes = [make_episode(23, seed=s) for s in range(3)]
    sums = sum((CameraSums.of(e, 8, 8) for e in episodes), CameraSums.none())
    windows = [
        reanchored(e.T_camera_from_world[s : s + 8])
        for e in episodes
        for s in window_starts(23, 8, 8)
    ]
    assert len(windows) == 6
    t = np.concatenate([w[:, :3, 3] for w in windows])
    steps = [w[1:] @ inverse(w[:-1]) for w in windows]  # an increment's translation is its velocity
    v = np.concatenate([s[:, :3, 3] for s in steps])
    a = np.concatenate([np.diff(w[:, :3, 3], n=2, axis=0) for w in windows])
    scales = CameraSums.from_list(sums.to_list()).scales()
    for mine, values in ((scales.translation, t), (scales.velocity, v), (scales.acceleration, a)):
        np.testing.assert_allclose(mine, values.std(0), rtol=1e-9)


def test_cameras_that_stand_still_have_the_floor():
    assert (CameraSums.none().scales().velocity == 1e-6).all()
