import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from mint_hub.geometry import camera

laws = settings(deadline=None, max_examples=60, derandomize=True)
angles = st.floats(0.05, 3.0)
sizes = st.tuples(st.integers(1, 4000), st.integers(1, 4000))


@laws
@given(st.tuples(angles, angles), sizes)
def test_fov_and_intrinsics_invert(fov: tuple[float, float], size: tuple[int, int]) -> None:
    K = camera.fov_vh_to_K(np.array(fov), size)
    np.testing.assert_allclose(camera.K_to_fov_vh(K, size), fov, rtol=1e-13)
    height, width = size
    edge = K @ [np.tan(fov[1] / 2), np.tan(fov[0] / 2), 1]
    np.testing.assert_allclose(edge, [width, height, 1], rtol=1e-13)
    tensor = camera.fov_vh_to_K(torch.tensor(fov, dtype=torch.float64), size)
    np.testing.assert_allclose(tensor.numpy(), K, rtol=1e-13)
    np.testing.assert_allclose(camera.K_to_fov_vh(tensor, size).numpy(), fov, rtol=1e-13)


def test_fov_order_is_vertical_then_horizontal() -> None:
    K = camera.fov_vh_to_K(np.array([np.pi / 2, 2 * np.arctan(0.5)], np.float32), (200, 300))
    np.testing.assert_allclose(K, [[300, 0, 150], [0, 100, 100], [0, 0, 1]], rtol=1e-6)
    assert K.dtype == np.float32


@laws
@given(st.integers(0, 2**31 - 1), st.floats(0.05, 50), st.sampled_from([0.0, 7.0]))
def test_project_and_unproject_invert(seed: int, depth: float, skew: float) -> None:
    rng = np.random.default_rng(seed)
    K = np.array([[500, skew, 320], [0, 480, 240], [0, 0, 1.0]])
    uv, z = rng.uniform(0, 600, size=(4, 5, 2)), depth * rng.uniform(0.5, 2, size=(4, 5))
    points = camera.unproject(uv, z, K)
    again, depth_again = camera.project(points, K)
    np.testing.assert_allclose(again, uv, rtol=1e-12, atol=1e-10)
    np.testing.assert_array_equal(depth_again, z)
    np.testing.assert_allclose((points @ K.T)[..., :2] / z[..., None], again, atol=1e-9)
    tensors = camera.project(torch.as_tensor(points), torch.as_tensor(K))
    np.testing.assert_allclose(tensors[0].numpy(), again, rtol=1e-14)


def test_intrinsics_match_first_axes() -> None:
    rng = np.random.default_rng(0)
    K = camera.fov_vh_to_K(rng.uniform(0.8, 1.2, size=(7, 2)), (480, 640))
    points = rng.normal(size=(7, 2, 21, 3)) + np.array([0, 0, 5])
    uv, depth = camera.project(points, K)
    assert uv.shape == (7, 2, 21, 2)
    assert depth.shape == (7, 2, 21)
    np.testing.assert_allclose(uv[3], camera.project(points[3], K[3])[0])


def test_points_not_in_front_are_nan_with_zero_gradient() -> None:
    points = np.array([[0.1, 0.2, 1], [0.1, 0.2, 0], [0.1, 0.2, -1]])
    K = camera.fov_vh_to_K(np.array([1.0, 1.0]), (100, 100))
    uv, depth = camera.project(points, K)
    np.testing.assert_array_equal(np.isnan(uv), [[False] * 2, [True] * 2, [True] * 2])
    np.testing.assert_array_equal(depth, points[:, 2])
    leaf = torch.tensor(points, requires_grad=True)
    uv_torch, depth_torch = camera.project(leaf, torch.as_tensor(K))
    torch.where(depth_torch[:, None] > 0, uv_torch, 0.0).sum().backward()
    assert torch.isfinite(leaf.grad).all()
    np.testing.assert_array_equal(leaf.grad[1:], np.zeros((2, 3)))


def test_gradients() -> None:
    fov = torch.tensor([[1.0, 1.2]], dtype=torch.float64, requires_grad=True)
    points = torch.tensor([[0.1, 0.2, 1.5]], dtype=torch.float64, requires_grad=True)
    project = lambda f, p: camera.project(p, camera.fov_vh_to_K(f, (100, 200), check=False))  # noqa: E731
    assert torch.autograd.gradcheck(project, (fov, points))


@pytest.mark.parametrize("fov", [[0.0, 1], [1, np.pi], [np.nan, 1], [-1, 1]])
def test_impossible_fields_of_view(fov: list[float]) -> None:
    with pytest.raises(ValueError, match="fov_vh_rad: expected"):
        camera.fov_vh_to_K(np.array(fov), (10, 10))


@pytest.mark.parametrize("size", [(0, 10), (10,), (10.5, 3), None, "ab", (1, 2, 3)])
def test_impossible_sizes(size: object) -> None:
    with pytest.raises(ValueError, match=r"image_size_hw: expected two positive integers"):
        camera.require_image_size(size)


def test_shapes_are_named() -> None:
    with pytest.raises(ValueError, match="points_camera: expected"):
        camera.project(np.zeros((4, 2)), np.eye(3))
    with pytest.raises(ValueError, match="K: expected"):
        camera.project(np.zeros((4, 3)), np.zeros((3, 4)))
