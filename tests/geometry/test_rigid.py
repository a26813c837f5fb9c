from math import pi
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from mint_hub.geometry import rigid as rg
from mint_hub.geometry.rotations import geodesic_angle, mean_rotation, rotvec_to_matrix

Floats = NDArray[np.float64]
laws = settings(deadline=None, max_examples=50, derandomize=True)
seeds = st.integers(0, 2**31 - 1)


def random_motions(
    rng: np.random.Generator, *shape: int, turn: float = 1, move: float = 1
) -> Floats:
    R = rotvec_to_matrix(turn * rng.normal(size=(*shape, 3)))
    return rg.rigid(R, move * rng.normal(size=(*shape, 3)))


def errors(T: Floats) -> tuple[Floats, Floats]:
    """Angle and distance from the identity."""
    return geodesic_angle(T[..., :3, :3], np.eye(3)), np.linalg.norm(T[..., :3, 3], axis=-1)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_inverse_and_parts(dtype: type) -> None:
    T = random_motions(np.random.default_rng(0), 3, 4).astype(dtype)
    tolerance = 100 * float(np.finfo(dtype).eps)
    assert rg.inverse(T).dtype == dtype
    np.testing.assert_allclose(
        rg.inverse(T) @ T, np.broadcast_to(np.eye(4), T.shape), atol=tolerance
    )
    np.testing.assert_array_equal(rg.rigid(rg.rotation_of(T), rg.translation_of(T)), T)
    tensor = torch.as_tensor(T)
    np.testing.assert_allclose(rg.inverse(tensor).numpy(), rg.inverse(T), atol=tolerance)
    assert rg.rigid(np.eye(3, dtype=dtype), np.zeros((5, 3), dtype)).shape == (5, 4, 4)


def test_transform_points_matches_first_axes() -> None:
    rng = np.random.default_rng(1)
    T, points = random_motions(rng, 5), rng.normal(size=(5, 2, 21, 3))
    moved = rg.transform_points(T, points)
    for i in range(5):
        R, t = T[i, :3, :3], T[i, :3, 3]
        np.testing.assert_allclose(moved[i], points[i] @ R.T + t, atol=1e-14)
    np.testing.assert_allclose(rg.transform_points(T, points[:, 0, 0]), moved[:, 0, 0], atol=1e-14)
    np.testing.assert_allclose(rg.transform_points(T, points[0, 0, 0])[0], moved[0, 0, 0])
    np.testing.assert_allclose(rg.transform_points(T[0], points)[0], moved[0], atol=1e-14)
    as_torch = rg.transform_points(torch.as_tensor(T), torch.as_tensor(points))
    np.testing.assert_allclose(as_torch.numpy(), moved, atol=1e-14)


@laws
@given(seeds, st.sampled_from([0.0, 1e-9, 1e-4, 0.2236, 1.0, 3.0, pi - 1e-6]))
def test_se3_exp_and_log_invert(seed: int, angle: float) -> None:
    rng = np.random.default_rng(seed)
    axis = rng.normal(size=3)
    twist = np.concatenate([rng.normal(size=3), angle * axis / np.linalg.norm(axis)])
    T = rg.se3_exp(twist)
    np.testing.assert_allclose(rg.se3_log(T), twist, atol=1e-13)
    np.testing.assert_allclose(rg.se3_exp(-twist), rg.inverse(T), atol=1e-14)
    np.testing.assert_allclose(rg.se3_exp(twist / 2) @ rg.se3_exp(twist / 2), T, atol=1e-13)
    tensor = torch.as_tensor(twist)
    np.testing.assert_allclose(rg.se3_exp(tensor).numpy(), T, atol=1e-14)
    np.testing.assert_allclose(rg.se3_log(torch.as_tensor(T)).numpy(), rg.se3_log(T), atol=1e-13)


def test_se3_gradients_even_at_the_identity() -> None:
    for twist in (
        np.zeros(6),
        np.array([1.0, 2, 3, 0.3, -0.2, 0.1]),
        np.array([1.0, 0, 0, 2, 1, 0]),
    ):
        leaf = torch.tensor(twist, requires_grad=True)
        assert torch.autograd.gradcheck(rg.se3_exp, (leaf,))
        assert torch.autograd.gradcheck(lambda x: rg.se3_log(rg.se3_exp(x)), (leaf,))


@laws
@given(seeds)
def test_interpolation_ends_where_it_should(seed: int) -> None:
    A, B = random_motions(np.random.default_rng(seed), 2)
    np.testing.assert_allclose(rg.interpolate_rigid(A, B, 0.0), A, atol=1e-14)
    np.testing.assert_allclose(rg.interpolate_rigid(A, B, 1.0), B, atol=1e-14)
    steps = rg.interpolate_rigid(A[None], B[None], np.array([0.25, 0.5]))
    np.testing.assert_allclose(steps[1, :3, 3], (A[:3, 3] + B[:3, 3]) / 2, atol=1e-14)
    np.testing.assert_allclose(steps[0], rg.interpolate_rigid(A, steps[1], 0.5), atol=1e-13)


# ---------------------------------------------------------------- similarity fit


@laws
@given(seeds, st.floats(0.01, 100), st.integers(3, 30), st.booleans())
def test_umeyama_recovers_a_similarity(seed: int, scale: float, count: int, weigh: bool) -> None:
    rng = np.random.default_rng(seed)
    T, source = random_motions(rng), rng.normal(size=(count, 3))
    target = scale * source @ T[:3, :3].T + T[:3, 3]
    weights = rng.uniform(0.5, 1, count) if weigh else None
    fit = rg.umeyama(source, target, weights=weights)
    assert fit.scale == pytest.approx(scale, rel=1e-11)
    np.testing.assert_allclose(fit.rotation, T[:3, :3], atol=1e-8)
    np.testing.assert_allclose(fit.apply(source), target, atol=1e-11 * max(scale, 1))
    other = rg.umeyama(*(torch.as_tensor(x) for x in (source, target)))
    np.testing.assert_allclose(other.matrix().numpy(), fit.matrix(), atol=1e-7 * max(scale, 1))


@laws
@given(seeds, st.booleans())
def test_umeyama_is_the_least_squares_optimum(seed: int, with_scale: bool) -> None:
    rng = np.random.default_rng(seed)
    source, target = rng.normal(size=(2, 6, 3))
    target[:, 0] *= -1  # mirrored shapes: the reflection must be refused
    fit = rg.umeyama(source, target, with_scale=with_scale)
    assert np.linalg.det(fit.rotation) == pytest.approx(1)
    assert with_scale or fit.scale == 1.0
    best = np.square(fit.apply(source) - target).sum()
    for _ in range(20):
        nudge = rg.se3_exp(1e-2 * rng.normal(size=6)) @ fit.matrix()
        if with_scale:
            nudge[:3, :3] *= 1 + 1e-2 * rng.normal()
        assert np.square(rg.transform_points(nudge, source) - target).sum() >= best


def test_umeyama_weights_silence_points_and_batches_agree() -> None:
    rng = np.random.default_rng(2)
    T, source = random_motions(rng, 4), rng.normal(size=(4, 9, 3))
    target = rg.transform_points(T, source)
    target[:, 0] += 5
    weights = np.ones((4, 9))
    weights[:, 0] = 0
    fit = rg.umeyama(source, target, with_scale=False, weights=weights)
    np.testing.assert_allclose(fit.matrix(), T, atol=1e-13)
    assert fit.apply(source).shape == source.shape
    one = rg.umeyama(source[2], target[2], with_scale=False, weights=weights[2])
    np.testing.assert_allclose(one.matrix(), T[2], atol=1e-13)


def test_umeyama_degenerate_answers() -> None:
    rng = np.random.default_rng(3)
    cloud = rng.normal(size=(5, 3))
    point = np.broadcast_to(rng.normal(size=3), (5, 3))
    with pytest.raises(ValueError, match="source: expected points that differ"):
        rg.umeyama(point, cloud)
    with pytest.raises(ValueError, match="target: expected points that differ"):
        rg.umeyama(cloud, point)
    with pytest.raises(ValueError, match="finite"):
        rg.umeyama(cloud, np.where(np.eye(5, 3) > 0, np.nan, cloud))
    with pytest.raises(ValueError, match="same N"):
        rg.umeyama(cloud, cloud[:4])
    T = random_motions(rng)
    line = np.linspace(-1, 2, 5)[:, None] * rng.normal(size=3) + rng.normal(size=3)
    for kind in (np.asarray, torch.as_tensor):
        fit: Any = rg.umeyama(kind(line), kind(rg.transform_points(T, line)))
        R = np.asarray(fit.rotation)
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-14)
        assert np.linalg.det(R) == pytest.approx(1)
        np.testing.assert_allclose(fit.apply(kind(line)), rg.transform_points(T, line), atol=1e-13)


def test_umeyama_is_differentiable() -> None:
    rng = np.random.default_rng(4)
    source, target = (torch.tensor(rng.normal(size=(5, 3)), requires_grad=True) for _ in range(2))
    fit = lambda a, b: rg.umeyama(a, b, check=False).matrix()  # noqa: E731
    assert torch.autograd.gradcheck(fit, (source, target))


# ---------------------------------------------------------------- robust mean


@laws
@given(seeds, st.integers(1, 12), st.sampled_from([0.0, 1e-9, 2e-7]))
def test_robust_mean_of_agreeing_motions_is_the_plain_mean(
    seed: int, count: int, noise: float
) -> None:
    rng = np.random.default_rng(seed)
    T = random_motions(rng) @ rg.se3_exp(noise * rng.normal(size=(count, 6)))
    mean, residuals = rg.robust_mean_rigid(T)
    np.testing.assert_allclose(mean[:3, :3], mean_rotation(T[:, :3, :3]), atol=1e-14)
    np.testing.assert_allclose(mean[:3, 3], T[:, :3, 3].mean(0), atol=1e-14)
    assert residuals.rotation_rad.shape == residuals.translation_m.shape == (count,)
    assert max(residuals.rotation_rad.max(), residuals.translation_m.max()) <= 1e-14 + 8 * noise


def test_robust_mean_costs_little_on_gaussian_noise() -> None:
    T = random_motions(np.random.default_rng(5), 8, 600, turn=0.01, move=0.005)
    mean, _ = rg.robust_mean_rigid(T, axis=0)
    plain = rg.rigid(mean_rotation(T[..., :3, :3]), T[..., :3, 3].mean(0))
    for robust, reference in zip(errors(mean), errors(plain), strict=True):
        assert np.sqrt(np.square(robust).mean()) < 1.05 * np.sqrt(np.square(reference).mean())


@pytest.mark.parametrize("count", [3, 5, 8, 15])
@pytest.mark.parametrize("alike", [False, True], ids=["scattered", "conspiring"])
def test_robust_mean_ignores_a_minority(count: int, alike: bool) -> None:
    rng = np.random.default_rng(count)
    wrong = (count - 1) // 2
    T = random_motions(rng, count, 200, turn=0.01, move=0.005)
    T[:wrong] = random_motions(rng, *((1, 200) if alike else (wrong, 200)), turn=1, move=1)
    mean, residuals = rg.robust_mean_rigid(T, axis=0)
    angle, distance = errors(mean)
    assert angle.max() < 0.05
    assert distance.max() < 0.025
    assert np.median(residuals.translation_m[:wrong]) > 0.5
    silent = errors(rg.robust_mean_rigid(T[wrong:])[0])
    assert np.sqrt(np.square(distance).mean()) < 1.3 * np.sqrt(np.square(silent[1]).mean())


def test_robust_mean_distrusts_a_motion_wrong_in_either_part() -> None:
    T = random_motions(np.random.default_rng(6), 8, turn=1e-3, move=1e-3)
    T[2] = T[2] @ rg.se3_exp(np.array([0, 0, 0, 0.5, 0, 0]))
    T[5] = rg.se3_exp(np.array([0.5, 0, 0, 0, 0, 0])) @ T[5]
    keep = [i for i in range(8) if i not in (2, 5)]
    expected = rg.robust_mean_rigid(T[keep]).mean
    np.testing.assert_allclose(rg.robust_mean_rigid(T).mean, expected, atol=1e-12)


@laws
@given(seeds)
def test_robust_mean_commutes_with_left_motions_and_order(seed: int) -> None:
    rng = np.random.default_rng(seed)
    T, A = random_motions(rng, 7, turn=0.05, move=0.05), random_motions(rng)
    T[0] = random_motions(rng)
    mean = rg.robust_mean_rigid(T).mean
    np.testing.assert_allclose(rg.robust_mean_rigid(A @ T).mean, A @ mean, atol=1e-8)
    np.testing.assert_allclose(rg.robust_mean_rigid(T[::-1]).mean, mean, atol=1e-8)


def test_robust_mean_axes_kinds_and_dtype() -> None:
    T = random_motions(np.random.default_rng(7), 3, 6, turn=0.1, move=0.1).astype(np.float32)
    mean, residuals = rg.robust_mean_rigid(T, axis=1)
    assert mean.dtype == residuals.rotation_rad.dtype == np.float32
    assert mean.shape == (3, 4, 4)
    assert residuals.translation_m.shape == (3, 6)
    leaf = torch.tensor(T, requires_grad=True)
    tensor, spread = rg.robust_mean_rigid(leaf, axis=1)
    np.testing.assert_allclose(tensor.detach().numpy(), mean, atol=1e-6)
    np.testing.assert_allclose(
        spread.rotation_rad.detach().numpy(), residuals.rotation_rad, atol=1e-6
    )
    tensor.sum().backward()
    assert torch.isfinite(leaf.grad).all()


def test_robust_mean_refuses_nothing_and_nan() -> None:
    with pytest.raises(ValueError, match="along axis 0"):
        rg.robust_mean_rigid(np.zeros((0, 4, 4)))
    with pytest.raises(ValueError, match="finite"):
        rg.robust_mean_rigid(np.full((3, 4, 4), np.nan))
