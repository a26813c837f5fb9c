"""Rigid motions SE(3) and similarities Sim(3) as (..., 4, 4) matrices on column vectors, metres.

``T_b_from_a`` maps coordinates in frame a to frame b. Functions take numpy or torch, batched over
leading axes, and keep kind and dtype.

Laws: ``inverse(T) @ T == I``; ``se3_exp(se3_log(T)) == T``; ``umeyama`` gives back the similarity
that made its target; ``robust_mean_rigid`` commutes with moving all its inputs from the left.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

from mint_hub.geometry.arrays import (
    Array,
    ArrayT,
    as_dtype,
    detached,
    dot,
    eye,
    full,
    is_torch,
    matvec,
    namespace,
    norm,
    over_points,
    require_finite,
    require_shape,
    transpose,
)
from mint_hub.geometry.rotations import (
    SMALL_SQUARED_ANGLE,
    geodesic_angle,
    matrix_to_rotvec,
    mean_rotation,
    nearest_rotation,
    power_series,
    rotvec_to_matrix,
    sine_series,
    skew,
    slerp,
)


def rigid(R: ArrayT, t: ArrayT) -> ArrayT:
    """Make transforms (..., 4, 4) of rotations (..., 3, 3) and translations (..., 3), broadcast.

    Raises:
        ValueError: wrong shapes.

    """
    require_shape("R", R, (3, 3))
    require_shape("t", t, (3,))
    xp = namespace(R, t)
    leading = xp.broadcast_shapes(tuple(R.shape[:-2]), tuple(t.shape[:-1]))
    rotation = xp.broadcast_to(R, (*leading, 3, 3))
    translation = xp.broadcast_to(t, (*leading, 3))[..., None]
    top = xp.concatenate([rotation, translation], axis=-1)
    last = xp.broadcast_to(eye(4, R)[3:], (*leading, 1, 4))
    return xp.concatenate([top, last], axis=-2)


def rotation_of(T: ArrayT) -> ArrayT:
    """Return the rotation part (..., 3, 3) of transforms (..., 4, 4)."""
    require_shape("T", T, (4, 4))
    values: Any = T
    return values[..., :3, :3]


def translation_of(T: ArrayT) -> ArrayT:
    """Return the translation part (..., 3) of transforms (..., 4, 4)."""
    require_shape("T", T, (4, 4))
    values: Any = T
    return values[..., :3, 3]


def inverse(T: ArrayT) -> ArrayT:
    """Invert *rigid* transforms (..., 4, 4): [R^T, -R^T t]. Not for similarities."""
    back: Any = transpose(rotation_of(T))
    return rigid(back, -matvec(back, translation_of(T)))


def transform_points(T: ArrayT, points: ArrayT) -> ArrayT:
    """Map points (..., 3) by affine transforms (..., 4, 4).

    T's leading axes are matched with the *first* leading axes of the points, whose further axes
    share a transform: T (4, 4) moves any points, T (T, 4, 4) moves points (T, 3), (T, N, 3) or
    (T, 2, 21, 3). A T with more leading axes than the points broadcasts as usual.

    Raises:
        ValueError: wrong shapes.

    """
    require_shape("T", T, (4, 4))
    require_shape("points", points, (3,))
    namespace(T, points)
    each: Any = over_points(T, points)
    return matvec(each[..., :3, :3], points) + each[..., :3, 3]


def interpolate_rigid(T0: ArrayT, T1: ArrayT, alpha: Array | float) -> ArrayT:
    """Interpolate from T0 (alpha 0) to T1 (alpha 1): rotation by slerp, translation on a line.

    ``alpha`` is a number or broadcasts over the leading axes. The translation of a camera-to-world
    transform is the camera's centre, which then moves straight.
    """
    R = slerp(rotation_of(T0), rotation_of(T1), alpha)
    t0: Any = translation_of(T0)
    t1: Any = translation_of(T1)
    fraction: Any = alpha
    if not isinstance(alpha, (int, float)):
        fraction = as_dtype(alpha, T0.dtype)[..., None]
    return rigid(R, (1 - fraction) * t0 + fraction * t1)


def interpolate_path(times_s: ArrayT, T: ArrayT, at_s: ArrayT) -> ArrayT:
    """Poses (N, 4, 4) at times (N,) of a path with poses T (M, 4, 4) at times (M,), M >= 1.

    Between two poses as ``interpolate_rigid`` does; before the first and after the last time, the
    pose there. Give world-from-camera transforms, whose translation is what moves straight.

    Raises:
        ValueError: wrong shapes, or times that do not increase.

    """
    require_shape("T", T, (4, 4))
    xp = namespace(times_s, T, at_s)
    times: Any = times_s
    at: Any = at_s
    poses: Any = T
    if len(T.shape) != 3 or tuple(times_s.shape) != (len(T),) or len(at_s.shape) != 1 or not len(T):
        raise ValueError(
            f"times_s, T, at_s: expected (M,), (M, 4, 4), (N,), got {tuple(times_s.shape)}, "
            f"{tuple(T.shape)}, {tuple(at_s.shape)}"
        )
    if not bool((times[1:] > times[:-1]).all()):
        raise ValueError("times_s: expected increasing times")
    after = xp.searchsorted(times, at, side="right").clip(0, len(T) - 1)
    before = (after - 1).clip(0)
    span = times[after] - times[before]
    alpha = (at - times[before]) / xp.where(span > 0, span, xp.ones_like(span))
    return interpolate_rigid(poses[before], poses[after], alpha.clip(0, 1))


def se3_exp(twist: ArrayT) -> ArrayT:
    """Exponential map of twists (..., 6), [v metres, w radians], to transforms (..., 4, 4).

    R = exp([w]x), t = (I + (1 - cos a)/a^2 [w]x + (a - sin a)/a^3 [w]x^2) v with a = |w|.
    """
    require_shape("twist", twist, (6,))
    xp = namespace(twist)
    values: Any = twist
    v, w = values[..., :3], values[..., 3:]
    square = dot(w, w)
    small = square < SMALL_SQUARED_ANGLE
    angle = xp.sqrt(xp.where(small, 1.0, square))
    b = xp.where(small, sine_series(square, 2), 2 * (xp.sin(angle / 2) / angle) ** 2)
    c = xp.where(small, sine_series(square, 3), (angle - xp.sin(angle)) / angle**3)
    W = skew(w)
    V = eye(3, w) + b[..., None, None] * W + c[..., None, None] * (W @ W)
    return rigid(rotvec_to_matrix(w), matvec(V, v))


def se3_log(T: ArrayT) -> ArrayT:
    """Logarithm of rigid transforms (..., 4, 4): twists (..., 6), [v metres, w radians].

    v = (I - [w]x / 2 + d [w]x^2) t with d = (1 - (a/2) cot(a/2)) / a^2 and a = |w| up to pi.
    """
    xp = namespace(T)
    w: Any = matrix_to_rotvec(rotation_of(T))
    square = dot(w, w)
    small = square < SMALL_SQUARED_ANGLE
    half = xp.sqrt(xp.where(small, 1.0, square)) / 2
    series = power_series(square, [1 / 12, 1 / 720, 1 / 30240, 1 / 1209600, 1 / 47900160])
    d = xp.where(small, series, (1 - half * xp.cos(half) / xp.sin(half)) / (4 * half**2))
    W = skew(w)
    V_inverse = eye(3, w) - W / 2 + d[..., None, None] * (W @ W)
    return xp.concatenate([matvec(V_inverse, translation_of(T)), w], axis=-1)


@dataclass(frozen=True)
class Similarity:
    """p -> scale R p + translation.

    Attributes:
        scale: (...), unitless.
        rotation: (..., 3, 3).
        translation: (..., 3), metres.

    """

    scale: Any
    rotation: Any
    translation: Any

    def apply(self, points: Any) -> Any:
        """Map points (..., 3); leading axes are matched as in ``transform_points``."""
        return transform_points(self.matrix(), points)

    def matrix(self) -> Any:
        """Return the (..., 4, 4) matrix, scale R in its upper left."""
        return rigid(self.scale[..., None, None] * self.rotation, self.translation)


def umeyama(
    source: ArrayT,
    target: ArrayT,
    with_scale: bool = True,
    weights: ArrayT | None = None,
    check: bool = True,
) -> Similarity:
    """Fit the similarity that takes ``source`` closest to ``target``, least squares.

    Umeyama 1991, equations 40 to 42; the reflection case is handled. Points on one line (also: two
    points) leave the turn about the line free; one valid rotation that fits equally well is
    returned. Coincident points determine nothing and raise.

    Args:
        source: (..., N, 3) metres.
        target: (..., N, 3) metres, same shape as ``source`` or broadcasting against it.
        with_scale: fit the scale, else it is 1.
        weights: (..., N), not negative, or None.
        check: validate values; without it degenerate input gives unspecified finite rotations, and
            source points that coincide exactly the scale 0, if fitted: the target's mean.

    Raises:
        ValueError: wrong shapes; with ``check``, non-finite input, or source or target points that
            all coincide.

    """
    require_shape("source", source, (3,))
    require_shape("target", target, (3,))
    xp = namespace(source, target, weights)
    if len(source.shape) < 2 or source.shape[-2] != target.shape[-2] or source.shape[-2] < 1:
        raise ValueError(
            f"source, target: expected (..., N, 3) with the same N >= 1, got {tuple(source.shape)} "
            f"and {tuple(target.shape)}"
        )
    w: Any = full((source.shape[-2],), 1.0, source) if weights is None else weights
    if check:
        require_finite("source", source)
        require_finite("target", target)
        require_finite("weights", w)
        if bool((w < 0).any()) or bool((w.sum(axis=-1) <= 0).any()):
            raise ValueError("weights: expected none negative and a positive sum")
    w = (w / w.sum(axis=-1, keepdims=True))[..., None]
    mean_source: Any = (w * source).sum(axis=-2)
    mean_target: Any = (w * target).sum(axis=-2)
    a = source - mean_source[..., None, :]
    b = target - mean_target[..., None, :]
    variance = (w * a * a).sum(axis=(-1, -2))
    if check:
        _require_spread("source", variance, source)
        _require_spread("target", (w * b * b).sum(axis=(-1, -2)), target)
    covariance = transpose(w * b) @ a
    R: Any = nearest_rotation(covariance, check=False)
    spread = xp.where(variance > 0, variance, 1.0 + 0 * variance)
    scale = (R * covariance).sum(axis=(-1, -2)) / spread if with_scale else 0 * variance + 1
    translation = mean_target - scale[..., None] * matvec(R, mean_source)
    return Similarity(scale, R, translation)


def _require_spread(name: str, variance: Any, points: Any) -> None:
    """Raise ValueError when the points of any set coincide, to rounding."""
    magnitude = abs(points).max() if not is_torch(points) else points.abs().max()
    eps = float(namespace(points).finfo(points.dtype).eps)
    limit = max(
        (4 * eps * float(magnitude)) ** 2, float(namespace(points).finfo(points.dtype).tiny)
    )
    if bool((variance <= limit).any()):
        raise ValueError(
            f"{name}: expected points that differ, got {int((variance <= limit).sum())} set(s) of "
            "coincident points, which determine no alignment"
        )


class RigidResiduals(NamedTuple):
    """How far each input of a mean lies from it."""

    rotation_rad: Any
    translation_m: Any


class RobustMean(NamedTuple):
    """A mean transform (..., 4, 4) and the residuals (..., N, ...) of what it averages."""

    mean: Any
    residuals: RigidResiduals


CORE = 3.0
"""Residuals, in units of the robust scale, up to which a transform counts fully."""

REACH = 6.0
"""Residuals, in units of the robust scale, from which a transform does not count."""

SCALE_FLOOR = 1e-6
"""Least robust scale, rad and m: closer transforms agree, and count fully."""

MEDIAN_OF_CHI3 = 1.5382
"""Median length of a 3-vector of unit normals: from median distance to standard deviation."""


def robust_mean_rigid(T: Array, axis: int = 0) -> RobustMean:
    """Mean on SE(3) along a leading axis that a minority of arbitrary outliers does not move.

    Iteratively reweighted least squares: rotations by their intrinsic mean, translations by their
    arithmetic mean, under shared weights. A transform's residuals (geodesic angle, distance) are
    divided by robust scales (median residual / 1.54, the normalised median absolute deviation for
    3-vectors, at least 1e-6 rad and 1e-6 m); the larger decides: weight 1 up to 3 (Hampel's flat
    core, so that clean data give the plain mean), falling to 0 at 6. It starts at the medoid.

    Outlier tolerance: fewer than half of N may be arbitrarily wrong. With N <= 2 nobody can be
    outvoted and the plain mean is returned. The cost is quadratic in N.

    Args:
        T: (..., N, ..., 4, 4) metres; ``axis`` counts over the leading axes.
        axis: which leading axis is averaged away.

    Returns:
        (mean, residuals): mean (..., 4, 4) of T's kind and dtype, computed in float64; residuals
        are (rotation_rad, translation_m), shaped like T's leading axes. In torch, gradients flow
        with the weights held fixed.

    Raises:
        ValueError: wrong shape, non-finite entries, nothing to average.

    """
    require_shape("T", T, (4, 4))
    leading = len(T.shape) - 2
    if not -leading <= axis < leading or T.shape[axis % leading] == 0:
        raise ValueError(f"T: expected transforms along axis {axis}, got shape {tuple(T.shape)}")
    require_finite("T", T)
    xp = namespace(T)
    stacked: Any = xp.moveaxis(as_dtype(T, xp.float64), axis % leading, 0)
    weights = _irls_weights(detached(stacked))
    mean: Any = _weighted_mean(stacked, weights)
    angle, distance = _distances(stacked, mean)
    residuals = RigidResiduals(
        *(as_dtype(xp.moveaxis(r, 0, axis % leading), T.dtype) for r in (angle, distance))
    )
    return RobustMean(as_dtype(mean, T.dtype), residuals)


def _irls_weights(stacked: Any, iterations: int = 20) -> Any:
    """Weights (N, ...) of transforms (N, ..., 4, 4), float64."""
    xp = namespace(stacked)
    ones = xp.ones_like(stacked[..., 0, 0])
    if stacked.shape[0] <= 2:
        return ones
    center, weights = _medoid(stacked), ones
    for _ in range(iterations):
        ratios = [r / _scale(r, 0) for r in _distances(stacked, center)]
        ratio = xp.maximum(*ratios)
        safe = ratio.clip(min=CORE)
        falling = CORE / safe * ((REACH - safe) / (REACH - CORE)).clip(min=0.0)
        previous, weights = weights, xp.where(ratio <= CORE, ones, falling)
        if bool((abs(weights - previous) < 1e-9).all()):
            break
        center = _weighted_mean(stacked, weights)
    return weights


def _medoid(stacked: Any) -> Any:
    """Pick the transform with the least summed distance to the others.

    Rotation and translation distances count in units of their median over all pairs.
    """
    xp = namespace(stacked)
    count = stacked.shape[0]
    angle, distance = _distances(stacked[:, None], stacked[None])
    total = 0.0
    for pairs in (angle, distance):
        flat = pairs.reshape((count * count, *pairs.shape[2:]))
        total = total + (pairs / _scale(flat, 0)[None]).sum(axis=1)
    best = xp.argmin(total, axis=0)[None]
    index = xp.arange(count).reshape((count,) + (1,) * (best.ndim - 1))
    chosen = (index == best)[..., None, None]
    return xp.where(chosen, stacked, 0.0).sum(axis=0)


def _scale(residuals: Any, axis: int) -> Any:
    """Robust standard deviation of distances along ``axis``, floored."""
    median = namespace(residuals).quantile(residuals, 0.5, axis=axis)
    return (median / MEDIAN_OF_CHI3).clip(min=SCALE_FLOOR)


def _weighted_mean(stacked: Any, weights: Any) -> Any:
    """Mean (..., 4, 4) of transforms (N, ..., 4, 4) under weights (N, ...)."""
    R = mean_rotation(rotation_of(stacked), weights, check=False)
    share = (weights / weights.sum(axis=0))[..., None]
    return rigid(R, (share * translation_of(stacked)).sum(axis=0))


def _distances(a: Any, b: Any) -> tuple[Any, Any]:
    """Angle (rad) and distance (m) between transforms, broadcast."""
    angle = geodesic_angle(rotation_of(a), rotation_of(b))
    return angle, norm(translation_of(a) - translation_of(b))
