from collections.abc import Callable
from math import pi
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from mint_hub.geometry import rotations as rot

Floats = NDArray[np.float64]
laws = settings(deadline=None, max_examples=60, derandomize=True)
EPS = {np.dtype(np.float64): 1e-14, np.dtype(np.float32): 2e-6}


def random_rotations(seed: int, *shape: int) -> Floats:
    count = int(np.prod(shape))
    R = Rotation.random(count, random_state=np.random.RandomState(seed)).as_matrix()
    return R.reshape(*shape, 3, 3)


@st.composite
def rotvecs(draw: st.DrawFn, longest: float = pi) -> Floats:
    """Axis times angle; the angles favour 0, tiny ones, and those next to a half turn."""
    axis = np.array(draw(st.tuples(*[st.floats(-1, 1)] * 3)))
    length = np.linalg.norm(axis)
    axis = axis / length if length > 1e-3 else np.array([0.0, 0.0, 1.0])
    edges = [0.0, 1e-12, 1e-8, 1e-4, 0.2236, longest - 1e-4, longest - 1e-8]
    return axis * draw(st.one_of(st.sampled_from(edges), st.floats(0, longest - 1e-9)))


seeds = st.integers(0, 2**31 - 1)
dtypes = pytest.mark.parametrize("dtype", [np.float32, np.float64])


def both(function: Callable[..., Any], *inputs: Any) -> Any:
    """Result on numpy, after checking that torch gives the same, of the same dtype."""
    expected = function(*inputs)
    got = function(*(torch.as_tensor(x) if isinstance(x, np.ndarray) else x for x in inputs))
    assert isinstance(got, torch.Tensor)
    assert got.numpy().dtype == expected.dtype == inputs[0].dtype
    tolerance = EPS[np.dtype(expected.dtype)] * 20
    np.testing.assert_allclose(got.numpy(), expected, rtol=tolerance, atol=tolerance)
    return expected


@laws
@given(rotvecs(), st.sampled_from([np.float32, np.float64]))
def test_decode_encode_is_identity(rotvec: Floats, dtype: type) -> None:
    R = Rotation.from_rotvec(rotvec).as_matrix().astype(dtype)
    tolerance = EPS[np.dtype(dtype)]
    encoded = both(rot.matrix_to_rot6d_rows, R)
    np.testing.assert_array_equal(encoded, R[:2].reshape(6))
    assert np.abs(both(rot.rot6d_rows_to_matrix, encoded) - R).max() < tolerance
    quat = both(rot.matrix_to_quat_xyzw, R)
    assert quat[3] >= 0
    assert np.abs(both(rot.quat_xyzw_to_matrix, quat) - R).max() < tolerance
    assert np.abs(rot.quat_xyzw_to_matrix(-3 * quat) - R).max() < tolerance


@laws
@given(rotvecs())
def test_exp_and_log_agree_with_scipy_and_invert(rotvec: Floats) -> None:
    R = both(rot.rotvec_to_matrix, rotvec)
    np.testing.assert_allclose(R, Rotation.from_rotvec(rotvec).as_matrix(), atol=2e-15)
    back = both(rot.matrix_to_rotvec, R)
    np.testing.assert_allclose(back, rotvec, rtol=1e-14, atol=5e-15)


def test_log_at_exact_half_turns() -> None:
    for axis in [(1, 0, 0), (0, 1, 0), (0, 0, 1), (0.6, -0.8, 0), (2 / 3, 2 / 3, -1 / 3)]:
        n = np.array(axis, float)
        R = 2 * np.outer(n, n) - np.eye(3)
        rotvec = both(rot.matrix_to_rotvec, R)
        assert np.linalg.norm(rotvec) == pytest.approx(pi, abs=1e-15)
        np.testing.assert_allclose(np.abs(rotvec @ n), pi, atol=1e-14)
    np.testing.assert_allclose(rot.matrix_to_rotvec(np.diag([1.0, -1, -1])), [pi, 0, 0])


@dtypes
def test_batches_and_dtypes(dtype: type) -> None:
    R = random_rotations(0, 4, 5).astype(dtype)
    for function, tail in [
        (rot.matrix_to_rot6d_rows, (6,)),
        (rot.matrix_to_quat_xyzw, (4,)),
        (rot.matrix_to_rotvec, (3,)),
        (rot.nearest_rotation, (3, 3)),
    ]:
        assert both(function, R).shape == (4, 5, *tail)
    assert both(rot.geodesic_angle, R, R[:, :1]).shape == (4, 5)
    assert both(rot.slerp, R, R[:, :1], R[..., 0, 0]).shape == (4, 5, 3, 3)


@laws
@given(seeds)
def test_geodesic_angle_is_a_metric(seed: int) -> None:
    A, B, C = random_rotations(seed, 3)
    d = rot.geodesic_angle
    assert both(d, A, A) < 1e-15
    assert both(d, A, B) == pytest.approx(d(B, A), abs=1e-15)
    assert 0 < d(A, B) <= pi
    assert d(A, C) <= d(A, B) + d(B, C) + 1e-14
    np.testing.assert_allclose([d(C @ A, C @ B), d(A @ C, B @ C)], d(A, B), atol=1e-14)


@laws
@given(rotvecs(), seeds)
def test_geodesic_angle_is_exact_near_zero_and_pi(rotvec: Floats, seed: int) -> None:
    A = random_rotations(seed, 1)[0]
    B = A @ rot.rotvec_to_matrix(rotvec)
    assert rot.geodesic_angle(A, B) == pytest.approx(np.linalg.norm(rotvec), abs=4e-15)


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([0, 0, 0, 0, 1, 0], "two independent rows"),
        ([1, 0, 0, 0, 0, 0], "two independent rows"),
        ([1, 2, 3, -2, -4, -6], "two independent rows"),
        ([1, 0, 0, np.nan, 1, 0], "finite"),
        ([1, 0, 0, 0, 1], "shape"),
    ],
)
@pytest.mark.parametrize("kind", [np.array, torch.tensor])
def test_degenerate_6d_raises(rows: list[float], message: str, kind: Any) -> None:
    with pytest.raises(ValueError, match=message):
        rot.rot6d_rows_to_matrix(kind([float(x) for x in rows]))


def test_degenerate_6d_unchecked_is_finite_with_finite_gradient() -> None:
    rows = torch.zeros(2, 6, dtype=torch.float64)
    rows[1] = torch.tensor([1.0, 2, 3, 2, 4, 6])
    rows.requires_grad_()
    R = rot.rot6d_rows_to_matrix(rows, check=False)
    R.square().sum().backward()
    assert torch.isfinite(R).all()
    assert torch.isfinite(rows.grad).all()


def test_zero_quaternion_raises_and_large_scales_do_not_matter() -> None:
    with pytest.raises(ValueError, match="quat_xyzw: expected quaternions of nonzero length"):
        rot.quat_xyzw_to_matrix(np.zeros((2, 4)))
    q = np.array([0.1, -0.2, 0.3, -0.9])
    np.testing.assert_allclose(rot.quat_xyzw_to_matrix(1e6 * q), rot.quat_xyzw_to_matrix(q))
    np.testing.assert_allclose(rot.quat_xyzw_to_matrix(q), Rotation.from_quat(q).as_matrix())


@laws
@given(seeds, st.floats(0.01, 1.2), st.integers(1, 7))
def test_mean_is_equivariant_from_both_sides(seed: int, spread: float, count: int) -> None:
    rng = np.random.default_rng(seed)
    A, B, center = random_rotations(seed, 3)
    tangent = rng.normal(size=(count, 3))
    tangent *= spread / np.linalg.norm(tangent, axis=-1, keepdims=True).clip(min=1)
    R, w = center @ rot.rotvec_to_matrix(tangent), rng.uniform(0.1, 1, count)
    mean = rot.mean_rotation(R, w)
    np.testing.assert_allclose(rot.mean_rotation(A @ R, w), A @ mean, atol=1e-13)
    np.testing.assert_allclose(rot.mean_rotation(R @ B, w), mean @ B, atol=1e-13)
    np.testing.assert_allclose(rot.mean_rotation(R[::-1], w[::-1]), mean, atol=1e-13)
    gradient = (w[:, None] * rot.matrix_to_rotvec(mean.T @ R)).sum(0)
    assert np.abs(gradient).max() < 1e-13 * count


def test_mean_known_answers() -> None:
    R = random_rotations(3, 2)
    np.testing.assert_allclose(rot.mean_rotation(R[:1]), R[0], atol=1e-15)
    np.testing.assert_allclose(rot.mean_rotation(R), rot.slerp(R[0], R[1], 0.5), atol=1e-14)
    weights = np.array([0.7, 0.3])
    np.testing.assert_allclose(
        rot.mean_rotation(R, weights), rot.slerp(R[0], R[1], 0.3), atol=1e-14
    )
    np.testing.assert_allclose(rot.mean_rotation(R, np.array([0.0, 2.0])), R[1], atol=1e-14)


def test_mean_axes_weights_and_torch() -> None:
    R = random_rotations(4, 1, 1) @ rot.rotvec_to_matrix(
        0.5 * np.random.default_rng(0).normal(size=(5, 4, 3))
    )
    w = np.random.default_rng(1).uniform(0.1, 1, (5, 4))
    along_1 = both(lambda r, v: rot.mean_rotation(r, v, axis=1), R, w)
    assert along_1.shape == (5, 3, 3)
    for i in range(5):
        np.testing.assert_allclose(along_1[i], rot.mean_rotation(R[i], w[i]), atol=1e-13)
    along_0 = both(lambda r, v: rot.mean_rotation(r, v, axis=-2), R, w[:, 0].copy())
    np.testing.assert_allclose(along_0[2], rot.mean_rotation(R[:, 2], w[:, 0]), atol=1e-13)
    assert both(rot.mean_rotation, R.astype(np.float32)).dtype == np.float32


@pytest.mark.parametrize("weights", [[-1.0, 2], [0.0, 0], [np.nan, 1], [1.0, 1, 1]])
def test_mean_refuses_bad_weights(weights: list[float]) -> None:
    with pytest.raises(ValueError, match="weights"):
        rot.mean_rotation(np.stack([np.eye(3)] * 2), np.array(weights))


def test_mean_refuses_nothing() -> None:
    with pytest.raises(ValueError, match="at least one"):
        rot.mean_rotation(np.zeros((0, 3, 3)))
    with pytest.raises(ValueError, match="axis"):
        rot.mean_rotation(np.zeros((2, 3, 3)), axis=1)


@laws
@given(seeds, st.floats(0, 1))
def test_slerp_endpoints_and_constant_speed(seed: int, alpha: float) -> None:
    A, B = random_rotations(seed, 2)
    np.testing.assert_allclose(rot.slerp(A, B, 0.0), A, atol=1e-15)
    np.testing.assert_allclose(rot.slerp(A, B, 1.0), B, atol=1e-14)
    middle = rot.slerp(A, B, alpha)
    total = rot.geodesic_angle(A, B)
    assert rot.geodesic_angle(A, middle) == pytest.approx(alpha * total, abs=1e-14)
    assert rot.geodesic_angle(middle, B) == pytest.approx((1 - alpha) * total, abs=1e-14)


@laws
@given(seeds)
def test_nearest_rotation_beats_its_neighbours(seed: int) -> None:
    rng = np.random.default_rng(seed)
    M = rng.normal(size=(3, 3))
    R = both(rot.nearest_rotation, M)
    assert np.linalg.det(R) == pytest.approx(1)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-14)
    near = R @ rot.rotvec_to_matrix(1e-2 * rng.normal(size=(50, 3)))
    assert (np.square(near - M).sum((1, 2)) >= np.square(R - M).sum()).all()


def test_nearest_rotation_keeps_rotations_and_refuses_the_ambiguous() -> None:
    R = random_rotations(0, 20)
    np.testing.assert_allclose(rot.nearest_rotation(R), R, atol=2e-15)
    for M in (np.zeros((3, 3)), np.diag([1.0, 0, 0]), -np.eye(3)):
        with pytest.raises(ValueError, match="one nearest rotation"):
            rot.nearest_rotation(M)
        free = rot.nearest_rotation(M, check=False)
        np.testing.assert_allclose(free @ free.T, np.eye(3), atol=1e-15)


def test_continuous_quaternions_turn_less_than_a_right_angle() -> None:
    angles = np.linspace(0, 6 * pi, 60)
    R = rot.rotvec_to_matrix(angles[:, None] * np.array([0.0, 0.6, 0.8]))
    q = np.stack([rot.matrix_to_quat_xyzw(R)] * 2, axis=1)
    assert ((q[1:] * q[:-1]).sum(-1) < 0).any()
    smooth = both(rot.continuous_quat_xyzw, q)
    assert ((smooth[1:] * smooth[:-1]).sum(-1) > 0).all()
    np.testing.assert_array_equal(np.abs(smooth), np.abs(q))
    np.testing.assert_array_equal(smooth[0], q[0])
    swapped = rot.continuous_quat_xyzw(q.swapaxes(0, 1), axis=1)
    np.testing.assert_array_equal(swapped.swapaxes(0, 1), smooth)


def leaf(values: Any) -> torch.Tensor:
    return torch.tensor(np.asarray(values, float), requires_grad=True)


@pytest.mark.parametrize("rotvec", [[0, 0, 0], [1e-9, 0, 0], [0.1, 0.2, -0.1], [2.0, -1, 1.5]])
def test_gradients_of_exp_and_of_log_after_exp(rotvec: list[float]) -> None:
    w = leaf([rotvec])
    assert torch.autograd.gradcheck(rot.rotvec_to_matrix, (w,))
    assert torch.autograd.gradcheck(lambda x: rot.matrix_to_rotvec(rot.rotvec_to_matrix(x)), (w,))
    angle = rot.geodesic_angle(torch.eye(3, dtype=torch.float64), rot.rotvec_to_matrix(w)).sum()
    assert torch.isfinite(torch.autograd.grad(angle, w)[0]).all()


def test_gradients_of_6d_quaternions_and_projection() -> None:
    R = random_rotations(5, 3)
    noisy = leaf(R + 0.1 * np.random.default_rng(0).normal(size=R.shape))
    check = torch.autograd.gradcheck
    assert check(
        lambda x: rot.rot6d_rows_to_matrix(x, check=False), (leaf(R[:, :2].reshape(3, 6)),)
    )
    assert check(lambda q: rot.quat_xyzw_to_matrix(q, check=False), (leaf([[0.5, -1, 2, 0.3]]),))
    assert check(rot.nearest_rotation, (noisy,))
    assert check(rot.nearest_rotation, (leaf(R),))
    near = R[0] @ rot.rotvec_to_matrix(0.3 * np.random.default_rng(1).normal(size=(4, 3)))
    project_then_mean = lambda x: rot.mean_rotation(rot.nearest_rotation(x))  # noqa: E731
    assert check(project_then_mean, (leaf(near),))
    equal = leaf(np.stack([np.eye(3)] * 4))
    rot.mean_rotation(equal).sum().backward()
    assert torch.isfinite(equal.grad).all()
