"""Rotations: matrices, row-major 6D, quaternions xyzw and rotation vectors.

Every function takes numpy arrays or torch tensors, batched over leading axes, and returns the same
kind and dtype. A rotation matrix R (..., 3, 3) acts on column vectors. Rotation vectors are axis
times angle, radians. With ``check=False`` the torch versions have no branch that depends on data.

Laws: ``rot6d_rows_to_matrix(matrix_to_rot6d_rows(R)) == R``; ``rotvec_to_matrix`` and
``matrix_to_rotvec`` are inverse up to the half turn; the geodesic angle is a metric;
``mean_rotation`` commutes with rotating all its inputs, from the left and from the right.
"""

from collections.abc import Sequence
from math import factorial
from typing import Any

import numpy as np

from mint_hub.geometry.arrays import (
    Array,
    ArrayT,
    as_dtype,
    components,
    cross,
    detached,
    dot,
    eye,
    full,
    is_torch,
    matvec,
    namespace,
    norm,
    require_finite,
    require_shape,
    transpose,
)

NORM_FLOOR = 1e-8
"""Below this length a 6D row or a quaternion has no direction."""

SMALL_SQUARED_ANGLE = 0.05
"""Squared angles (rad^2) below this use power series instead of quotients."""


def rot6d_rows_to_matrix(rot6d_rows: ArrayT, check: bool = True) -> ArrayT:
    """Decode 6D rotations (..., 6), two rows of three numbers, to matrices (..., 3, 3).

    Gram-Schmidt: the first row is normalised, the second loses its part along the first and is
    normalised, the third is their cross product (Zhou et al. 2019, section 4.2, on rows).

    Degenerate input (a row shorter than 1e-8, parallel rows) has no answer: it raises. With
    ``check=False`` lengths are floored at 1e-8 instead, which stays finite but is no rotation.

    Raises:
        ValueError: wrong shape; with ``check``, non-finite or degenerate rows.

    """
    require_shape("rot6d_rows", rot6d_rows, (6,))
    xp = namespace(rot6d_rows)
    a, b = rot6d_rows[..., :3], rot6d_rows[..., 3:]
    length_a = norm(a, keepdims=True)
    row0 = a / length_a.clip(min=NORM_FLOOR)
    rest = b - dot(row0, b, keepdims=True) * row0
    length_rest = norm(rest, keepdims=True)
    if check:
        require_finite("rot6d_rows", rot6d_rows)
        parallel = 8 * float(xp.finfo(rot6d_rows.dtype).eps) * norm(b, keepdims=True)
        zero = (length_a < NORM_FLOOR) | (length_rest < NORM_FLOOR)
        _require_none("rot6d_rows", zero | (length_rest <= parallel), "two independent rows")
    row1 = rest / length_rest.clip(min=NORM_FLOOR)
    return xp.stack([row0, row1, cross(row0, row1)], axis=-2)


def matrix_to_rot6d_rows(R: ArrayT) -> ArrayT:
    """Encode rotations (..., 3, 3) as their first two rows, flattened (..., 6).

    Raises:
        ValueError: wrong shape.

    """
    require_shape("R", R, (3, 3))
    values: Any = R
    return values[..., :2, :].reshape((*values.shape[:-2], 6))


def quat_xyzw_to_matrix(quat_xyzw: ArrayT, check: bool = True) -> ArrayT:
    """Quaternions (..., 4), of any length and either sign, to matrices (..., 3, 3).

    A quaternion shorter than 1e-8 raises; with ``check=False`` its length is floored at 1e-8.

    Raises:
        ValueError: wrong shape; with ``check``, non-finite or zero quaternions.

    """
    require_shape("quat_xyzw", quat_xyzw, (4,))
    xp = namespace(quat_xyzw)
    length = norm(quat_xyzw, keepdims=True)
    if check:
        require_finite("quat_xyzw", quat_xyzw)
        _require_none("quat_xyzw", length < NORM_FLOOR, "quaternions of nonzero length")
    x, y, z, w = components(quat_xyzw / length.clip(min=NORM_FLOOR))
    entries = [
        *(1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
        *(2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
        *(2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
    ]
    return xp.stack(entries, axis=-1).reshape((*quat_xyzw.shape[:-1], 3, 3))


def matrix_to_quat_xyzw(R: ArrayT) -> ArrayT:
    """Rotations (..., 3, 3) to unit quaternions (..., 4) with w >= 0.

    The four rows of 4 q q^T can be read off R; the longest one is normalised (after Shepperd 1978),
    so that nothing cancels at any angle. At an exact half turn (w = 0) both signs are right; the
    component of largest magnitude is then positive.

    Raises:
        ValueError: wrong shape.

    """
    require_shape("R", R, (3, 3))
    xp = namespace(R)
    (a, b, c), (d, e, f), (g, h, i) = (components(R[..., k, :]) for k in range(3))
    rows = [
        xp.stack([1 + a - e - i, b + d, c + g, h - f], axis=-1),
        xp.stack([b + d, 1 - a + e - i, f + h, c - g], axis=-1),
        xp.stack([c + g, f + h, 1 - a - e + i, d - b], axis=-1),
        xp.stack([h - f, c - g, d - b, 1 + a + e + i], axis=-1),
    ]
    table = xp.stack(rows, axis=-2)
    diagonal = xp.stack([row[..., k] for k, row in enumerate(rows)], axis=-1)
    best = xp.argmax(diagonal, axis=-1)[..., None, None]
    take = xp.take_along_dim if is_torch(R) else np.take_along_axis
    chosen = take(table, xp.broadcast_to(best, (*best.shape[:-1], 4)), -2)[..., 0, :]
    quat = chosen / norm(chosen, keepdims=True).clip(min=NORM_FLOOR)
    return xp.where(quat[..., 3:] < 0, -quat, quat)


def skew(vector: ArrayT) -> ArrayT:
    """Make the matrix [v]x (..., 3, 3) of vectors (..., 3): ``skew(v) @ p == cross(v, p)``."""
    x, y, z = components(vector)
    xp = namespace(vector)
    zero = 0 * x
    entries = [zero, -z, y, z, zero, -x, -y, x, zero]
    return xp.stack(entries, axis=-1).reshape((*vector.shape[:-1], 3, 3))


def rotvec_to_matrix(rotvec: ArrayT) -> ArrayT:
    """Exponential map: rotation vectors (..., 3), radians, to matrices (..., 3, 3).

    Rodrigues' formula I + sin(t)/t [w]x + (1 - cos t)/t^2 [w]x^2, t = |w|, with power series near
    t = 0, where value and gradient are exact. Non-finite input gives non-finite output.

    Raises:
        ValueError: wrong shape.

    """
    require_shape("rotvec", rotvec, (3,))
    xp = namespace(rotvec)
    square = dot(rotvec, rotvec)
    small = square < SMALL_SQUARED_ANGLE
    angle = xp.sqrt(xp.where(small, 1.0, square))
    first = xp.where(small, sine_series(square, 1), xp.sin(angle) / angle)
    second = xp.where(small, sine_series(square, 2), 2 * (xp.sin(angle / 2) / angle) ** 2)
    W = skew(rotvec)
    return eye(3, rotvec) + first[..., None, None] * W + second[..., None, None] * (W @ W)


def matrix_to_rotvec(R: ArrayT) -> ArrayT:
    """Logarithm: rotations (..., 3, 3) to rotation vectors (..., 3), of length 0 to pi radians.

    Goes through the quaternion, which is accurate near 0 and near pi. At an exact half turn the
    axis is known up to sign; its component of largest magnitude is made positive.

    Raises:
        ValueError: wrong shape.

    """
    quat = matrix_to_quat_xyzw(R)
    xp = namespace(R)
    vector, w = quat[..., :3], quat[..., 3]
    square = dot(vector, vector)
    small = square < 1e-4
    sine = xp.sqrt(xp.where(small, 1.0, square))
    cosine = xp.where(small, w, 1.0)
    ratio = xp.where(small, square, 0.0) / cosine**2
    series = (1 - ratio / 3 + ratio**2 / 5 - ratio**3 / 7) / cosine
    half = xp.where(small, series, xp.arctan2(sine, w) / sine)
    return 2 * half[..., None] * vector


def geodesic_angle(A: ArrayT, B: ArrayT) -> ArrayT:
    """Angle (...) in radians, 0 to pi, of the rotation between A and B (..., 3, 3).

    atan2 of twice the sine and twice the cosine of A^T B: accurate near 0 and near pi, where the
    arc cosine of the trace is not.

    Raises:
        ValueError: wrong shapes.

    """
    require_shape("A", A, (3, 3))
    require_shape("B", B, (3, 3))
    xp = namespace(A, B)
    M: Any = transpose(A) @ B
    sine = norm(_vee_of_difference(M))
    return xp.arctan2(sine, M[..., 0, 0] + M[..., 1, 1] + M[..., 2, 2] - 1)


def nearest_rotation(M: ArrayT, check: bool = True) -> ArrayT:
    """Find the rotation nearest to M (..., 3, 3) in the Frobenius norm (Umeyama 1991, lemma).

    U diag(1, 1, det(U V^T)) V^T from the singular values. The torch gradient comes from the
    optimality condition instead of the decomposition's, and so is finite for equal singular values
    (those of a rotation). Where the answer is not unique (rank under 2, or an equal smallest pair
    with negative determinant) it raises; with ``check=False`` one of the answers is returned.

    Raises:
        ValueError: wrong shape; with ``check``, non-finite input or no unique answer.

    """
    require_shape("M", M, (3, 3))
    xp = namespace(M)
    if check:
        require_finite("M", M)
    fixed: Any = detached(M)
    U, s, Vh = xp.linalg.svd(fixed)
    sign = xp.where(xp.linalg.det(U @ Vh) < 0, -1.0, 1.0 + 0.0 * s[..., 0])
    if check:
        gap = s[..., 1] + sign * s[..., 2]
        limit = 8 * float(xp.finfo(M.dtype).eps) * s[..., 0]
        _require_none("M", gap <= limit, "matrices with one nearest rotation")
    ones = xp.ones_like(sign)
    R = (U * xp.stack([ones, ones, sign], axis=-1)[..., None, :]) @ Vh
    return _with_polar_gradient(R, M) if is_torch(M) else R


def _with_polar_gradient(R: Any, M: Any) -> Any:
    """R, detached, given its derivative with respect to M.

    R^T M = S is symmetric at the optimum. A change dM turns R by w (in its own frame) where
    (tr(S) I - S) w = vee(R^T dM - dM^T R).
    """
    xp = namespace(M)
    A = transpose(R) @ M
    S = (A + transpose(A)).detach() / 2
    trace = S.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None]
    turn = matvec(xp.linalg.pinv(trace * eye(3, M) - S, hermitian=True), _vee_of_difference(A))
    return R @ rotvec_to_matrix(turn - turn.detach())


def mean_rotation(
    R: ArrayT, weights: Array | None = None, axis: int = 0, check: bool = True
) -> ArrayT:
    """Intrinsic (Karcher) mean of rotations along ``axis`` of the leading axes.

    The rotation with the least weighted sum of squared geodesic angles (Moakher 2002): iterate
    M <- M exp(sum_i w_i log(M^T R_i)) from the nearest rotation to the arithmetic mean. numpy
    stops at convergence; torch always runs the same number of steps. Rotations spread over more
    than a half turn may have several means; one of them is returned.

    Args:
        R: (..., N, ..., 3, 3); ``axis`` counts over the leading axes only.
        weights: None, (N,), or the shape of the leading axes; not negative, not all zero.
        axis: which leading axis is averaged away.
        check: validate values.

    Raises:
        ValueError: wrong shapes, nothing to average; with ``check``, non-finite rotations, or
            weights that are negative, non-finite or sum to zero.

    """
    require_shape("R", R, (3, 3))
    xp = namespace(R, weights)
    leading = len(R.shape) - 2
    if not -leading <= axis < leading:
        raise ValueError(f"axis: expected one of the {leading} leading axes of R, got {axis}")
    if R.shape[axis % leading] == 0:
        raise ValueError(f"R: expected at least one rotation on axis {axis}, got none")
    stacked: Any = xp.moveaxis(R, axis % leading, 0)
    w = normalized_weights(weights, stacked, axis % leading, check)[..., None]
    if check:
        require_finite("R", R)
    start = (w[..., None] * detached(stacked)).sum(axis=0)
    mean: Any = detached(nearest_rotation(start, check=False))
    tolerance = 4 * float(xp.finfo(R.dtype).eps)
    for _ in range(16 if is_torch(R) else 100):
        step = (w * matrix_to_rotvec(transpose(mean) @ stacked)).sum(axis=0)
        mean = mean @ rotvec_to_matrix(step)
        if not is_torch(R) and not bool((np.abs(step) > tolerance).any()):
            break
    return mean


def normalized_weights(weights: Array | None, stacked: Any, axis: int, check: bool) -> Any:
    """Weights that sum to one along axis 0 and broadcast against ``stacked`` (N, ..., 3, 3).

    ``weights`` is as in ``mean_rotation``, its averaged axis at ``axis``.
    """
    count, leading = stacked.shape[0], tuple(stacked.shape[:-2])
    if weights is None:
        return full((count,) + (1,) * (len(leading) - 1), 1.0 / count, stacked)
    w: Any = as_dtype(weights, stacked.dtype)
    if tuple(w.shape) == (count,):
        w = w.reshape((count,) + (1,) * (len(leading) - 1))
    else:
        if len(w.shape) == len(leading):
            w = namespace(w).moveaxis(w, axis, 0)
        if tuple(w.shape) != leading:
            raise ValueError(
                f"weights: expected shape ({count},) or that of the leading axes (averaged axis "
                f"first: {leading}), got {tuple(w.shape)}"
            )
    if check:
        require_finite("weights", w)
        _require_none("weights", w < 0, "weights >= 0")
        _require_none("weights", w.sum(axis=0) <= 0, "weights with a positive sum")
    return w / w.sum(axis=0)


def slerp(R0: ArrayT, R1: ArrayT, alpha: Array | float) -> ArrayT:
    """Rotations on the shortest arc from R0 (alpha 0) to R1 (alpha 1), each (..., 3, 3).

    R0 exp(alpha log(R0^T R1)); ``alpha`` is a number or broadcasts over the leading axes, and may
    leave [0, 1]. A half turn apart, two arcs are shortest; ``matrix_to_rotvec`` picks one.

    Raises:
        ValueError: wrong shapes.

    """
    namespace(R0, R1, alpha)
    require_shape("R0", R0, (3, 3))
    require_shape("R1", R1, (3, 3))
    fraction: Any = alpha if isinstance(alpha, (int, float)) else alpha[..., None]
    if not isinstance(alpha, (int, float)):
        fraction = as_dtype(fraction, R0.dtype)
    rotvec: Any = matrix_to_rotvec(transpose(R0) @ R1)
    return R0 @ rotvec_to_matrix(fraction * rotvec)


def continuous_quat_xyzw(quat_xyzw: ArrayT, axis: int = 0) -> ArrayT:
    """Flip signs along ``axis`` so that each quaternion is within a right angle of the one before.

    The first keeps its sign; a quaternion at exactly a right angle keeps the running sign.

    Raises:
        ValueError: wrong shape, or ``axis`` is not a leading axis.

    """
    require_shape("quat_xyzw", quat_xyzw, (4,))
    leading = len(quat_xyzw.shape) - 1
    if not -leading <= axis < leading:
        raise ValueError(f"axis: expected one of the {leading} leading axes, got {axis}")
    xp = namespace(quat_xyzw)
    q: Any = xp.moveaxis(quat_xyzw, axis % leading, 0)
    flips = xp.where(dot(q[1:], q[:-1]) < 0, -1.0, xp.ones_like(q[1:, ..., 0]))
    signs = xp.concatenate([xp.ones_like(q[:1, ..., 0]), xp.cumprod(flips, axis=0)], axis=0)
    return xp.moveaxis(q * signs[..., None], 0, axis % leading)


def sine_series(square: ArrayT, first: int) -> ArrayT:
    """sum_k (-t^2)^k / (first + 2k)!, six terms: sin(t)/t for 1, (1 - cos t)/t^2 for 2."""
    return power_series(square, [(-1.0) ** k / factorial(first + 2 * k) for k in range(6)])


def power_series(x: ArrayT, coefficients: Sequence[float]) -> ArrayT:
    """c0 + c1 x + c2 x^2 + ... (Horner)."""
    total: Any = 0 * x + coefficients[-1]
    for c in reversed(coefficients[:-1]):
        total = total * x + c
    return total


def _vee_of_difference(M: ArrayT) -> ArrayT:
    """Return the vector (..., 3) of M - M^T: for a rotation, twice the sine times the axis."""
    xp = namespace(M)
    entries = [
        M[..., 2, 1] - M[..., 1, 2],
        M[..., 0, 2] - M[..., 2, 0],
        M[..., 1, 0] - M[..., 0, 1],
    ]
    return xp.stack(entries, axis=-1)


def _require_none(name: str, bad: Any, expected: str) -> None:
    """Raise ValueError when any entry of ``bad`` is true."""
    if bool(bad.any()):
        count = int(np.prod(tuple(bad.shape)))
        raise ValueError(f"{name}: expected {expected}, got {int(bad.sum())} of {count} otherwise")
