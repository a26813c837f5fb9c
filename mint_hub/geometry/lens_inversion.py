"""The numerics of inverting lens models: bracketed and planar Newton iterations, first roots."""

from collections.abc import Callable
from math import inf
from typing import Any

from numpy.polynomial import Polynomial

from mint_hub.geometry.arrays import Array, components, full, namespace
from mint_hub.geometry.rotations import power_series

SETTLED = 1e-14
"""Relative step below which an iteration has converged, float64."""


def evaluate(polynomial: Polynomial, x: Any) -> Any:
    """Evaluate ``polynomial`` at ``x``, numpy or torch, in the dtype of ``x``."""
    return power_series(x, [float(c) for c in polynomial.coef])


def first_positive_root(polynomial: Polynomial) -> float:
    """Find the least positive real root, infinity when there is none."""
    roots = polynomial.trim().roots()
    real = roots.real[(abs(roots.imag) <= 1e-9 * (1 + abs(roots.real))) & (roots.real > 0)]
    return float(real.min()) if real.size else inf


def ratio(numerator: Any, denominator: Any, at_zero: Any = 1.0) -> Any:
    """Numerator / denominator, ``at_zero`` where the denominator is zero; gradients stay finite."""
    xp = namespace(denominator)
    zero = denominator == 0
    return xp.where(zero, at_zero, numerator / xp.where(zero, 1.0, denominator))


def invert_monotone(
    function: Callable[[Any], Any], slope: Callable[[Any], Any], target: Array, limit: float
) -> Any:
    """Solve function(x) = target for x in [0, limit], where the function grows from 0.

    Newton's method kept inside a shrinking bracket, so that it cannot escape or cycle. Targets out
    of reach end at ``limit``; the caller checks the residual.
    """
    xp = namespace(target)
    values: Any = target
    low, high = full(tuple(values.shape), 0.0, values), full(tuple(values.shape), limit, values)
    x = values.clip(min=0.0, max=limit)
    for _ in range(60):
        error = function(x) - values
        low, high = xp.where(error <= 0, x, low), xp.where(error >= 0, x, high)
        step = x - error / slope(x)
        inside = (step >= low) & (step <= high)
        following = xp.where(inside, step, (low + high) / 2)
        moving = abs(following - x) > SETTLED * (1 + abs(x))
        x = following
        if not bool(moving.any()):
            break
    return x


def newton_2d(
    function: Callable[[Any], tuple[Any, tuple[Any, Any, Any, Any]]], target: Any, start: Any
) -> Any:
    """Solve function(xy) = target (..., 2) from ``start``; the caller checks the residual.

    ``function`` returns its value (..., 2) and the four entries of its Jacobian, row by row.
    """
    xp = namespace(target)
    xy = start
    for _ in range(30):
        value, (a, b, c, d) = function(xy)
        ex, ey = components(value - target)
        determinant = a * d - b * c
        step = xp.stack([d * ex - b * ey, a * ey - c * ex], axis=-1) / determinant[..., None]
        xy = xy - step
        moving = abs(step) > SETTLED * (1 + abs(xy))
        if not bool(moving.any()):
            break
    return xy
