import numpy as np
import pytest
import torch

from mint_hub.geometry import camera_state, rigid
from mint_hub.geometry.rotations import rotvec_to_matrix

RNG = np.random.default_rng(0)
STATE = np.concatenate([RNG.normal(size=(2, 5, 7)), RNG.uniform(0.5, 1.5, size=(2, 5, 2))], axis=-1)


@pytest.mark.parametrize("kind", [np.asarray, torch.as_tensor])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_pack_undoes_unpack(kind, dtype) -> None:
    x = kind(STATE.astype(dtype))
    state = camera_state.unpack(x)
    assert tuple(state.translation.shape) == (2, 5, 3)
    assert tuple(state.quat_xyzw.shape) == (2, 5, 4)
    assert tuple(state.fov_vh_rad.shape) == (2, 5, 2)
    packed = state.pack()
    assert packed.dtype == x.dtype
    np.testing.assert_array_equal(packed, x)


def test_order_is_translation_quaternion_fov() -> None:
    state = camera_state.unpack(np.arange(9.0))
    np.testing.assert_array_equal(state.translation, [0, 1, 2])
    np.testing.assert_array_equal(state.quat_xyzw, [3, 4, 5, 6])
    np.testing.assert_array_equal(state.fov_vh_rad, [7, 8])


def test_pose_is_world_to_camera_and_quaternion_is_normalised() -> None:
    half = np.sqrt(0.5)
    x = np.array([1, 2, 3, 0, 0, -5 * half, -5 * half, 1, 1])  # a quarter turn about z
    T = camera_state.unpack(x).T_camera_from_world()
    np.testing.assert_allclose(rigid.transform_points(T, np.array([1.0, 0, 0])), [1, 3, 3])


def test_matrices_round_trip() -> None:
    R = rotvec_to_matrix(RNG.normal(size=(6, 3)))
    T, fov = rigid.rigid(R, RNG.normal(size=(6, 3))), RNG.uniform(0.5, 1.5, size=(6, 2))
    state = camera_state.from_matrices(T, fov)
    assert (state.quat_xyzw[:, 3] >= 0).all()
    again = camera_state.unpack(state.pack())
    np.testing.assert_allclose(again.T_camera_from_world(), T, atol=1e-15)
    np.testing.assert_array_equal(again.fov_vh_rad, fov)
    as_torch = camera_state.from_matrices(torch.as_tensor(T), torch.as_tensor(fov)).pack()
    np.testing.assert_allclose(as_torch.numpy(), state.pack(), atol=1e-15)


def test_errors() -> None:
    with pytest.raises(
        ValueError, match=r"camera_state: expected shape \(\.\.\., 9\), got \(3, 8\)"
    ):
        camera_state.unpack(np.zeros((3, 8)))
    with pytest.raises(ValueError, match="quat_xyzw"):
        camera_state.unpack(np.zeros(9)).T_camera_from_world()
    zero = torch.zeros(9, requires_grad=True)
    T = camera_state.unpack(zero).T_camera_from_world(check=False)
    T.sum().backward()
    assert torch.isfinite(zero.grad).all()
