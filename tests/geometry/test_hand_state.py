"""The 109 numbers: packing, unpacking, and what an absent hand is."""

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal

from mint_hub.conventions import LEFT_MIRROR
from mint_hub.geometry.hand_state import (
    HAND_STATE_SIZE,
    HandState,
    absent,
    keep_in_picture,
    mirror_rotations,
    unpack,
)
from mint_hub.geometry.rotations import rotvec_to_matrix


def random_rotations(rng: np.random.Generator, *shape: int) -> np.ndarray:
    return rotvec_to_matrix(rng.normal(size=(*shape, 3)))


def test_layout_is_translation_orientation_joints_shape():
    x = np.arange(2 * HAND_STATE_SIZE, dtype=np.float32).reshape(2, HAND_STATE_SIZE)
    state = unpack(x)
    assert HAND_STATE_SIZE == 109
    assert_array_equal(state.translation[0], [0, 1, 2])
    assert_array_equal(state.orientation_rot6d_rows[0], np.arange(3, 9))
    assert_array_equal(state.joint_rot6d_rows[0, 0], np.arange(9, 15))
    assert_array_equal(state.joint_rot6d_rows[0, 14], np.arange(93, 99))
    assert_array_equal(state.shape_params[0], np.arange(99, 109))


@pytest.mark.parametrize("leading", [(), (4,), (3, 2), (0, 2)])
def test_pack_undoes_unpack(leading):
    x = np.random.default_rng(0).normal(size=(*leading, 109)).astype(np.float32)
    assert_array_equal(unpack(x).pack(), x)
    assert unpack(x).pack().dtype == np.float32
    t = torch.from_numpy(x)
    assert torch.equal(unpack(t).pack(), t)


def test_matrices_survive_the_round_trip():
    rng = np.random.default_rng(1)
    orientation, joints = random_rotations(rng, 5), random_rotations(rng, 5, 15)
    packed = HandState.from_matrices(
        rng.normal(size=(5, 3)), orientation, joints, rng.normal(size=(5, 10))
    ).pack()
    state = unpack(packed)
    assert_allclose(state.orientation(), orientation, atol=1e-12)
    assert_allclose(state.joint_rotations(), joints, atol=1e-12)
    assert_allclose(state.joint_rotations("right"), joints, atol=1e-12)


def test_one_shape_serves_a_batch_of_poses():
    rng = np.random.default_rng(2)
    state = HandState.from_matrices(
        np.zeros(3), random_rotations(rng, 6), random_rotations(rng, 6, 15), np.arange(10.0)
    )
    assert state.pack().shape == (6, 109)
    assert_array_equal(unpack(state.pack()).shape_params, np.tile(np.arange(10.0), (6, 1)))


def test_left_joint_rotations_are_conjugated_and_conjugating_twice_is_nothing():
    rng = np.random.default_rng(3)
    R = random_rotations(rng, 15)
    D = np.diag(LEFT_MIRROR)
    assert_allclose(mirror_rotations(R), D @ R @ D, atol=1e-15)
    assert_allclose(mirror_rotations(mirror_rotations(R)), R, atol=0)
    state = HandState.from_matrices(np.zeros(3), np.eye(3), R, np.zeros(10))
    assert_allclose(state.joint_rotations("left"), D @ R @ D, atol=1e-12)
    assert_allclose(mirror_rotations(torch.from_numpy(R)).numpy(), D @ R @ D, atol=1e-15)


def test_an_absent_hand_is_zeros_and_identities():
    x = absent((2, 3))
    state = unpack(x)
    assert x.shape == (2, 3, 109)
    assert x.dtype == np.float32
    assert not state.translation.any()
    assert not state.shape_params.any()
    assert_array_equal(state.orientation(), np.broadcast_to(np.eye(3), (2, 3, 3, 3)))
    assert_array_equal(state.joint_rotations(), np.broadcast_to(np.eye(3), (2, 3, 15, 3, 3)))
    like = absent((4,), like=torch.zeros(1, dtype=torch.float64))
    assert like.dtype == torch.float64
    assert_array_equal(like.numpy(), absent((4,)))


def test_errors_name_the_field_and_both_shapes():
    with pytest.raises(ValueError, match=r"hand_state.*109.*\(4, 218\)"):
        unpack(np.zeros((4, 218)))
    with pytest.raises(ValueError, match=r"joint_rotations.*15, 3, 3"):
        HandState.from_matrices(np.zeros(3), np.eye(3), np.zeros((16, 3, 3)), np.zeros(10))
    with pytest.raises(ValueError, match="shape_params"):
        HandState(np.zeros(3), np.zeros(6), np.zeros((15, 6)), np.zeros(9)).pack()


def test_zero_rotation_rows_raise_unless_unchecked():
    state = unpack(np.zeros(109))
    with pytest.raises(ValueError, match="rot6d"):
        state.orientation()
    assert np.isfinite(state.joint_rotations(check=False)).all()


def test_hands_keep_their_place_in_the_picture_under_another_view():
    """Pixels and depths stay; there and back again is where they were."""
    before, after = np.array([[1.0, 1.3]]), np.array([[0.8, 1.1]])
    hands = np.random.default_rng(3).normal(size=(4, 2, HAND_STATE_SIZE))
    moved = keep_in_picture(hands, before, after)
    for axis, angle in ((0, 1), (1, 0)):
        slope = [np.tan(fov[0, angle] / 2) for fov in (before, after)]
        assert_allclose(hands[..., axis] / slope[0], moved[..., axis] / slope[1])
    assert_array_equal(moved[..., 2:], hands[..., 2:])
    assert_allclose(keep_in_picture(moved, after, before), hands, rtol=1e-6)
    of_torch = keep_in_picture(*map(torch.from_numpy, (hands, before, after)))
    assert_allclose(of_torch.numpy(), moved, rtol=1e-6)
