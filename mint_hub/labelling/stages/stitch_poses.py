"""How two camera paths that share frames lie in one world: pure functions on poses.

Letters: m shared frames; a and b the worlds of the earlier and of the later path.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mint_hub.geometry import rigid, rotations
from mint_hub.inference.fusion import align

Float64 = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Alignment:
    """World b in world a: scale b's lengths by ``scale``, then move by ``T_a_from_b``.

    Attributes:
        scale: units of a per unit of b.
        log_sigma: standard deviation of the scale's logarithm, as far as the evidence tells.
        T_a_from_b: (4, 4), in units of a.
        rotation_deg, translation: median residuals over the shared frames, degrees and units of a.

    """

    scale: float
    log_sigma: float
    T_a_from_b: Float64
    rotation_deg: float
    translation: float

    def moved(self, T_camera_from_b: Float64) -> Float64:
        """Poses (..., 4, 4) of world b, as T_camera_from_a in units of a."""
        T = T_camera_from_b.copy()
        T[..., :3, 3] *= self.scale
        return T @ rigid.inverse(self.T_a_from_b)


@dataclass(frozen=True)
class ScaleRatio:
    """A scale and the standard deviation of its logarithm."""

    scale: float
    log_sigma: float


EXACT = ScaleRatio(1.0, 0.0)
"""Both paths have the same unit."""


def alignment(
    T_camera_from_a: Float64, T_camera_from_b: Float64, ratio: ScaleRatio | None = None
) -> Alignment:
    """Align two paths by all frames they share, robustly.

    Args:
        T_camera_from_a: (m, 4, 4), m >= 1.
        T_camera_from_b: (m, 4, 4), the same cameras in another world.
        ratio: the scale, where something else knows it; None takes it from the cameras' travel.

    """
    ratio = ratio or scale_from_travel(T_camera_from_a, T_camera_from_b)
    scaled = T_camera_from_b.copy()
    scaled[:, :3, 3] *= ratio.scale
    T_a_from_b = align(T_camera_from_a, scaled)
    between = T_camera_from_a @ rigid.inverse(scaled @ rigid.inverse(T_a_from_b))
    angle_deg = np.degrees(rotations.geodesic_angle(between[:, :3, :3], np.eye(3)))
    a_from_camera = rigid.inverse(T_camera_from_a)
    b_from_camera = T_a_from_b @ rigid.inverse(scaled)
    distance = np.linalg.norm(a_from_camera[:, :3, 3] - b_from_camera[:, :3, 3], axis=-1)
    return Alignment(
        ratio.scale,
        ratio.log_sigma,
        T_a_from_b,
        rotation_deg=float(np.median(angle_deg)),
        translation=float(np.median(distance)),
    )


def scale_from_travel(T_camera_from_a: Float64, T_camera_from_b: Float64) -> ScaleRatio:
    """Scale that makes the cameras of b travel as far as those of a, with its uncertainty.

    The two are turned alike first, by the robust mean of the frames' rotations. Then every frame's
    way from the median centre is compared along the way itself: the weighted median of the ratios
    is not moved by a minority of wrong frames. Its uncertainty is that of the remaining distances
    relative to the way; without any way it is infinite, and the scale 1.
    """
    a, b = (rigid.inverse(T)[:, :3, 3] for T in (T_camera_from_a, T_camera_from_b))
    turns = T_camera_from_a[:, :3, :3].transpose(0, 2, 1) @ T_camera_from_b[:, :3, :3]
    R_a_from_b = rigid.robust_mean_rigid(rigid.rigid(turns, np.zeros((len(turns), 3)))).mean
    b = b @ R_a_from_b[:3, :3].T  # first, for medians of turned points are others
    a, b = a - np.median(a, axis=0), b - np.median(b, axis=0)
    # Symmetric in a and b: the way is measured along their common direction.
    lengths = np.linalg.norm(a, axis=-1), np.linalg.norm(b, axis=-1)
    spread_a, spread_b = (float(np.sqrt(np.mean(length**2))) for length in lengths)
    if min(spread_a, spread_b) <= 1e-9 * max(spread_a, spread_b, 1e-9):
        return ScaleRatio(1.0, float("inf"))
    first = spread_a / spread_b
    common = a / spread_a + b / spread_b
    way_a = (a * common).sum(-1)
    way_b = (b * common).sum(-1)
    usable = (way_a > 0) & (way_b > 0)
    if not usable.any():
        return ScaleRatio(first, float("inf"))
    ratios = way_a[usable] / way_b[usable]
    scale = _weighted_median(ratios, np.sqrt(way_a[usable] * way_b[usable]))
    off = np.linalg.norm(a - scale * b, axis=-1)
    noise = 1.4826 * float(np.median(off)) / np.sqrt(3)
    return ScaleRatio(scale, noise / (spread_a * np.sqrt(len(a) / 3)))


def scale_from_depths(depth_a: Float64, depth_b: Float64) -> ScaleRatio | None:
    """Scale from depths (N,) of the same things in the same frames; None under ten of them."""
    if len(depth_a) < 10:
        return None
    logs = np.log(depth_a / depth_b)
    middle = float(np.median(logs))
    sigma = 1.4826 * float(np.median(np.abs(logs - middle)))
    # Points of one surface err together: count no more than a hundred as independent.
    return ScaleRatio(float(np.exp(middle)), sigma / np.sqrt(min(len(logs), 100)))


def pooled(ratios: list[ScaleRatio]) -> ScaleRatio:
    """Mean of the logarithms, weighted by their precision; the surest alone if it is exact."""
    best = min(ratios, key=lambda ratio: ratio.log_sigma)
    if best.log_sigma == 0 or not np.isfinite(best.log_sigma):
        return best
    precision = np.array([1 / ratio.log_sigma**2 for ratio in ratios])
    mean = float(np.average(np.log([ratio.scale for ratio in ratios]), weights=precision))
    return ScaleRatio(float(np.exp(mean)), float(1 / np.sqrt(precision.sum())))


def shares(ramp: Float64, earlier: Float64, later: Float64) -> Float64:
    """Share (m,) of the later one of two estimates: its ramp times its weight, relative to both.

    With no weight on either side it is the ramp.
    """
    mine, theirs = ramp * later, (1 - ramp) * earlier
    total = mine + theirs
    return np.where(total > 0, mine / np.where(total > 0, total, 1.0), ramp)


def _weighted_median(values: Float64, weights: Float64) -> float:
    order = np.argsort(values)
    total = np.cumsum(weights[order])
    return float(values[order][np.searchsorted(total, total[-1] / 2)])
