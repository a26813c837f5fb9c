"""Known lenses and poses: corrections keep what was seen, and say what was wrong with the input."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mint_hub.geometry import hand_state as hands
from mint_hub.geometry import rigid
from mint_hub.geometry.camera import fov_vh_to_K, project
from mint_hub.geometry.rotations import rotvec_to_matrix
from mint_hub.inference.known_camera import KnownCamera, correct_translation, poses_at

SIZE = (480, 640)
angles = st.floats(0.5, 2.2)


def states(xyz):
    state = hands.absent((1, 2)).astype(np.float64)
    state[..., hands.TRANSLATION] = xyz
    return state


def wrist(state):
    return state[0, 0, hands.TRANSLATION]


@given(
    angles, angles, angles, angles, st.floats(-0.3, 0.3), st.floats(-0.3, 0.3), st.floats(0.2, 1)
)
def test_correction_keeps_the_wrist_in_its_pixel(pv, ph, tv, th, x, y, z):
    predicted, true = np.array([[pv, ph]]), np.array([tv, th])
    before = states([x, y, z])
    after = correct_translation(before, predicted, true)
    uv_before, _ = project(wrist(before), fov_vh_to_K(predicted[0], SIZE))
    uv_after, _ = project(wrist(after), fov_vh_to_K(true, SIZE))
    np.testing.assert_allclose(uv_after, uv_before, atol=1e-6)


@given(angles, st.floats(1.01, 2.0), st.floats(0.2, 1))
def test_correction_keeps_the_apparent_size(fov, longer, z):
    """With a focal length k times the predicted one, a hand of the same size is k times as far."""
    predicted = np.full((1, 2), fov)
    true = 2 * np.arctan(np.tan(predicted[0] / 2) / longer)
    after = correct_translation(states([0.1, 0.05, z]), predicted, true)
    np.testing.assert_allclose(wrist(after), [0.1, 0.05, z * longer], rtol=1e-9)


@given(angles, angles)
def test_a_true_prediction_is_not_corrected(v, h):
    before = states([0.1, -0.2, 0.5])
    after = correct_translation(before, np.array([[v, h]]), np.array([v, h]))
    np.testing.assert_allclose(after, before, atol=1e-12)


def test_only_translations_change():
    before = states([0.1, -0.2, 0.5])
    after = correct_translation(before, np.array([[1.0, 1.3]]), np.array([0.8, 1.0]))
    np.testing.assert_array_equal(after[..., 3:], before[..., 3:])


def test_centred_pinhole_needs_no_resampling():
    known = KnownCamera.from_user([[500, 0, 320], [0, 500, 240], [0, 0, 1]], SIZE)
    assert known.rectification is None
    image = np.zeros((*SIZE, 3), np.uint8)
    assert known.apply(image) is image
    np.testing.assert_allclose(known.fov_vh_rad, 2 * np.arctan([240 / 500, 320 / 500]))


@pytest.mark.parametrize("offset", [0, -0.5])
def test_the_middle_may_be_counted_from_corners_or_centres(offset):
    K = [[500, 0, 320 + offset], [0, 500, 240 + offset], [0, 0, 1]]
    assert KnownCamera.from_user(K, SIZE).rectification is None
    K[0][2] += 3
    assert KnownCamera.from_user(K, SIZE).rectification is not None


def test_distorted_lens_is_rectified():
    spec = {"model": "opencv", "f": 400, "distortion": [-0.3, 0.1, 0, 0]}
    known = KnownCamera.from_user(spec, SIZE)
    assert known.rectification is not None
    image = np.random.default_rng(0).integers(0, 255, (*SIZE, 3), np.uint8)
    assert known.apply(image).shape == image.shape
    assert not np.array_equal(known.apply(image), image)


def test_a_malformed_camera_is_refused_by_name():
    with pytest.raises(ValueError, match="K"):
        KnownCamera.from_user(np.eye(4), SIZE)
    with pytest.raises(ValueError, match="model"):
        KnownCamera.from_user({"model": "lensbaby", "f": 1}, SIZE)


# --- poses ----------------------------------------------------------------------------------------


def path(times):
    twist = np.stack([0.3 * times, 0.1 * times, 0.2 * times], -1)
    return rigid.inverse(rigid.rigid(rotvec_to_matrix(twist), twist * 2))


def test_poses_by_frame_are_taken_as_they_are():
    times = np.arange(10) / 30
    np.testing.assert_array_equal(poses_at(path(times), times), path(times))


def test_poses_by_time_are_interpolated_where_the_camera_is():
    fine, times = np.arange(0, 2, 1e-3), np.arange(40) / 30
    given_poses = {"timestamps_s": fine, "T_camera_from_world": path(fine)}
    np.testing.assert_allclose(poses_at(given_poses, times), path(times), atol=1e-6)


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        (np.zeros((10, 3, 4)), r"expected \(T, 4, 4\)"),
        (np.full((10, 4, 4), np.nan), "finite"),
        (np.tile(2 * np.eye(4), (10, 1, 1)), "rigid"),
        (np.tile(np.eye(4), (9, 1, 1)), "expected 10 poses"),
        ({"timestamps_s": [0, 1]}, "T_camera_from_world"),
        (
            {"timestamps_s": [1, 0], "T_camera_from_world": np.tile(np.eye(4), (2, 1, 1))},
            "increasing",
        ),
        (
            {"timestamps_s": [5, 6], "T_camera_from_world": np.tile(np.eye(4), (2, 1, 1))},
            "cover the video",
        ),
        (
            {"timestamps_s": [0, 1e9], "T_camera_from_world": np.tile(np.eye(4), (2, 1, 1))},
            "in seconds",
        ),
        ("poses.npy", "expected numbers"),
    ],
)
def test_malformed_poses_are_refused(spec, message):
    with pytest.raises(ValueError, match=message):
        poses_at(spec, np.arange(10) / 30)
