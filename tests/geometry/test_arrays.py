import subprocess
import sys

import numpy as np
import pytest
import torch

from mint_hub.geometry import arrays


def test_namespace_tells_numpy_from_torch() -> None:
    assert arrays.namespace(np.zeros(3), 1.0, None) is np
    assert arrays.namespace(np.float64(1.0)) is np
    assert arrays.namespace(torch.zeros(3), 2) is torch
    assert arrays.namespace(1.0) is np


@pytest.mark.parametrize("mix", [(np.zeros(3), torch.zeros(3)), ([1.0, 2.0],), ("K",)])
def test_namespace_refuses_mixes_and_strangers(mix: tuple[object, ...]) -> None:
    with pytest.raises(TypeError, match="expected"):
        arrays.namespace(*mix)


def test_numpy_users_never_import_torch() -> None:
    code = (
        "import sys, numpy as np\n"
        "from mint_hub.geometry import camera, camera_state, lenses, rigid, rotations\n"
        "rigid.robust_mean_rigid(np.eye(4)[None].repeat(3, 0))\n"
        "assert 'torch' not in sys.modules and 'cv2' not in sys.modules\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_require_shape_names_field_expected_and_got() -> None:
    with pytest.raises(ValueError, match=r"rows: expected shape \(\.\.\., 6\), got \(2, 5\)"):
        arrays.require_shape("rows", np.zeros((2, 5)), (6,))
    with pytest.raises(ValueError, match=r"got \(3,\)"):
        arrays.require_shape("R", np.zeros(3), (3, 3))
    arrays.require_shape("R", torch.zeros(5, 3, 3), (3, 3))


def test_require_finite_counts() -> None:
    with pytest.raises(ValueError, match="x: expected finite numbers, got 2 non-finite of 3"):
        arrays.require_finite("x", np.array([np.nan, 1.0, np.inf]))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_makers_keep_kind_and_dtype(dtype: type) -> None:
    like = np.zeros(2, dtype)
    tensor = torch.as_tensor(like)
    for made, expected in [
        (arrays.full((2, 3), 1.5, like), np.full((2, 3), 1.5)),
        (arrays.eye(3, like), np.eye(3)),
        (arrays.constant([[1, 2]], like), np.array([[1, 2]])),
    ]:
        assert made.dtype == dtype
        np.testing.assert_array_equal(made, expected)
    assert arrays.full((2,), 1.0, tensor).dtype == tensor.dtype
    assert arrays.eye(2, tensor).dtype == tensor.dtype
    assert arrays.constant([1], tensor).dtype == tensor.dtype
    assert arrays.as_dtype(tensor, torch.float16).dtype == torch.float16


def test_norm_equals_numpy_and_has_zero_gradient_at_zero() -> None:
    x = np.random.default_rng(0).normal(size=(4, 3))
    x[0] = 0
    np.testing.assert_allclose(arrays.norm(x), np.linalg.norm(x, axis=-1), rtol=1e-15)
    leaf = torch.tensor(x, requires_grad=True)
    arrays.norm(leaf).sum().backward()
    np.testing.assert_array_equal(leaf.grad[0], np.zeros(3))
    np.testing.assert_allclose(leaf.grad[1:], x[1:] / np.linalg.norm(x[1:], axis=-1, keepdims=True))


def test_products_equal_numpy() -> None:
    rng = np.random.default_rng(1)
    a, b, M = rng.normal(size=(5, 3)), rng.normal(size=(5, 3)), rng.normal(size=(5, 2, 3))
    np.testing.assert_allclose(arrays.cross(a, b), np.cross(a, b), rtol=1e-14)
    np.testing.assert_allclose(arrays.dot(a, b), (a * b).sum(-1))
    np.testing.assert_allclose(arrays.matvec(M, a), np.einsum("nij,nj->ni", M, a), rtol=1e-14)


def test_over_points_matches_first_axes() -> None:
    assert arrays.over_points(np.zeros((7, 4, 4)), np.zeros((7, 2, 21, 3))).shape == (7, 1, 1, 4, 4)
    assert arrays.over_points(np.zeros((4, 4)), np.zeros((5, 3))).shape == (1, 4, 4)
    assert arrays.over_points(np.zeros((7, 4, 4)), np.zeros(3)).shape == (7, 4, 4)
