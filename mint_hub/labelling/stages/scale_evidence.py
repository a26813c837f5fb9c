"""What tells metres from a camera path's own units: known lengths, metric depth, hands.

Pure functions. Depths along z and lengths of the map are in units of the path; an estimate is
metres per unit with the standard deviation of its logarithm.
"""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]
Pixel = tuple[float, float]

HAND_SIGMA: Final = 0.35
"""Log standard deviation of the hands' estimate: hand size, depth by size, and that the surfaces
around a hand are not quite at its depth; seen 18 to 38 % low against known objects."""

HAND_QUANTILE: Final = 0.75
"""Over frames: each bounds the scale from below, and is near it while the hand touches something.
On the one clip with an annotated scale the median was 35 % low, this quantile 20 %."""

DEPTH_SIGMA: Final = 0.05
"""The same of a depth backend's own scale."""

NEIGHBOURS: Final = 12
MIN_NEIGHBOURS: Final = 3
REACH: Final = 0.15
"""How far from a pixel map points still speak for it, as a share of the image diagonal."""

PIXEL_SIGMA: Final = 1.5
"""How well a person points at a pixel."""

SYNTAX: Final = (
    "a factor (1.7), or a length between two pixels of the source video at a time in seconds, "
    "LENGTH:u1,v1-u2,v2@t (0.42m:100,200-380,215@12.5; units m, cm, mm)"
)
_NUMBER = r"\d+(?:\.\d*)?|\.\d+"
_LENGTH = re.compile(
    rf"({_NUMBER})\s*(m|cm|mm):({_NUMBER}),({_NUMBER})-({_NUMBER}),({_NUMBER})@({_NUMBER})s?"
)
_METRES: Final = {"m": 1.0, "cm": 0.01, "mm": 0.001}


@dataclass(frozen=True)
class GivenFactor:
    """Metres per unit, by the user. One unit of an SfM path is the median depth of its map."""

    metres_per_unit: float


@dataclass(frozen=True)
class KnownLength:
    """A length between two pixels (u, v) of the source video at a source time."""

    metres: float
    first_uv: Pixel
    second_uv: Pixel
    time_s: float


def parse_scale(text: str) -> GivenFactor | KnownLength:
    """Read what a user says about metric size.

    >>> parse_scale("0.42m:100,200-380,215@12.5")
    KnownLength(metres=0.42, first_uv=(100.0, 200.0), second_uv=(380.0, 215.0), time_s=12.5)
    >>> parse_scale("1.7")
    GivenFactor(metres_per_unit=1.7)

    Raises:
        ValueError: it is neither, is not positive, or its two pixels are one.

    """
    stripped = text.replace(" ", "")
    if re.fullmatch(_NUMBER, stripped):
        factor = float(stripped)
        if factor <= 0:
            raise ValueError(f"scale: expected a positive factor, got {text!r}")
        return GivenFactor(factor)
    match = _LENGTH.fullmatch(stripped)
    if match is None:
        raise ValueError(f"scale: expected {SYNTAX}, got {text!r}")
    metres = float(match[1]) * _METRES[match[2]]
    u1, v1, u2, v2, time_s = (float(match[i]) for i in range(3, 8))
    if metres <= 0:
        raise ValueError(f"scale: expected a positive length, got {text!r}")
    if math.hypot(u2 - u1, v2 - v1) < 1:
        raise ValueError(f"scale: expected two pixels at least one apart, got {text!r}")
    return KnownLength(metres, (u1, v1), (u2, v2), time_s)


@dataclass(frozen=True)
class Estimate:
    """Metres per unit and the standard deviation of its logarithm."""

    metres_per_unit: float
    log_sigma: float


def depth_at(
    uv: Pixel, seen_uv: Float, seen_depth: Float, image_size_hw: tuple[int, int]
) -> tuple[float, float]:
    """Depth at a pixel, and its relative standard deviation, from points near it.

    The inverse depth of a plane is linear in the pixel: it is fitted, robustly, to the nearest
    points (N, 2) with depths (N,), and held within their range.

    Raises:
        ValueError: fewer than 3 points are near enough.

    """
    distance = np.linalg.norm(seen_uv - np.asarray(uv), axis=1)
    nearest = np.argsort(distance, kind="stable")[:NEIGHBOURS]
    nearest = nearest[distance[nearest] <= REACH * math.hypot(*image_size_hw)]
    if len(nearest) < MIN_NEIGHBOURS:
        raise ValueError(
            f"expected at least {MIN_NEIGHBOURS} map points near pixel ({uv[0]:g}, {uv[1]:g}), got "
            f"{len(nearest)}: point at something with texture that does not move"
        )
    inverse = 1.0 / seen_depth[nearest]
    offset = (seen_uv[nearest] - np.asarray(uv)) / max(float(distance[nearest].max()), 1e-9)
    middle = float(np.median(inverse))
    value, residual = middle, inverse - middle
    if len(nearest) >= 6:
        A = np.column_stack([np.ones(len(nearest)), offset])
        weight = np.ones(len(nearest))
        solution = np.zeros(3)
        for _ in range(10):
            root = np.sqrt(weight)[:, None]
            solution = np.linalg.lstsq(A * root, inverse * root[:, 0], rcond=None)[0]
            residual = inverse - A @ solution
            spread = max(1.4826 * float(np.median(np.abs(residual))), 1e-6 * middle)
            weight = 1.0 / (1.0 + (residual / (1.5 * spread)) ** 2)
        value = float(np.clip(solution[0], inverse.min(), inverse.max()))
    spread = 1.4826 * float(np.median(np.abs(residual)))
    return 1.0 / value, max(spread / value / math.sqrt(len(nearest) / 3), 0.002)


def scale_from_length(
    metres: float,
    ends_uv: tuple[Pixel, Pixel],
    seen_uv: Float,
    seen_depth: Float,
    K: Float,
    image_size_hw: tuple[int, int],
) -> Estimate:
    """Metres per unit from a length between two pixels of one frame.

    Args:
        metres: how long it is.
        ends_uv: its ends.
        seen_uv, seen_depth: map points (N, 2), (N,) of that frame.
        K: (3, 3) of that frame.
        image_size_hw: its size.

    Raises:
        ValueError: no map points near an end, or both ends at one point.

    """
    rays = [np.array([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], 1.0]) for u, v in ends_uv]
    (z1, s1), (z2, s2) = (depth_at(uv, seen_uv, seen_depth, image_size_hw) for uv in ends_uv)

    def units(first: float, second: float) -> float:
        return float(np.linalg.norm(rays[0] * first - rays[1] * second))

    length = units(z1, z2)
    if length < 1e-6 * max(z1, z2):
        raise ValueError("expected two points apart, got both ends at one")
    by_first = math.log(max(units(z1 * (1 + s1), z2), 1e-12) / length)
    by_second = math.log(max(units(z1, z2 * (1 + s2)), 1e-12) / length)
    pixels = math.hypot(ends_uv[0][0] - ends_uv[1][0], ends_uv[0][1] - ends_uv[1][1])
    pointing = math.sqrt(2) * PIXEL_SIGMA / pixels
    return Estimate(metres / length, math.sqrt(by_first**2 + by_second**2 + pointing**2))


def depth_ratios(
    seen_uv: Float, seen_depth: Float, depth_m: NDArray[Any], image_size_hw: tuple[int, int]
) -> Float:
    """Metric depth over map depth, (M,), at the points where the depth map is valid.

    Args:
        seen_uv, seen_depth: map points (N, 2), (N,) of a frame of ``image_size_hw``.
        depth_m: (h, w) metres, any size; not finite or <= 0 is invalid and says nothing.
        image_size_hw: size of the frame that pixels belong to.

    """
    scale = np.array(depth_m.shape[::-1]) / np.array(image_size_hw[::-1])
    at = np.floor(seen_uv * scale).astype(np.int64)
    inside = ((at >= 0) & (at < np.array(depth_m.shape[::-1]))).all(axis=1) & (seen_depth > 0)
    metric = depth_m[at[inside, 1], at[inside, 0]].astype(np.float64)
    valid = np.isfinite(metric) & (metric > 0)
    return metric[valid] / seen_depth[inside][valid]


def scale_from_ratios(
    ratios: Sequence[Float],
    floor: float,
    *,
    quantile: float = 0.5,
    min_each: int = 8,
    min_frames: int = 1,
) -> Estimate | None:
    """Median over frames of the median log ratio of each; None where too little is known.

    Args:
        ratios: of each frame, metres over units.
        floor: log standard deviation that no number of frames takes away.
        quantile: over frames, instead of the median: higher where ratios are lower bounds.
        min_each: ratios a frame needs to have a say.
        min_frames: frames with a say that are needed.

    """
    logs = np.array([np.median(np.log(r)) for r in ratios if len(r) >= min_each])
    if len(logs) < max(min_frames, 1):
        return None
    middle = float(np.quantile(logs, quantile))
    spread = 1.4826 * float(np.median(np.abs(logs - np.median(logs))))
    return Estimate(math.exp(middle), math.hypot(floor, spread))


def hand_ratios(hand_uv: Float, hand_depth_m: float, seen_uv: Float, seen_depth: Float) -> Float:
    """Depth of a hand over depths of map points around it, (M,), metres over units.

    A hand hides what is behind it, so that each ratio bounds the scale from below; where it
    touches things it is nearly the scale. The nearer half of the points in a ring about the hand's
    box speaks: what the hand is busy with rather than the far end of the room.

    Args:
        hand_uv: (21, 2) landmarks.
        hand_depth_m: median depth of them.
        seen_uv, seen_depth: map points (N, 2), (N,) of that frame.

    """
    low, high = hand_uv.min(axis=0), hand_uv.max(axis=0)
    margin = 0.5 * float((high - low).max())
    ring = ((seen_uv > low - margin) & (seen_uv < high + margin)).all(axis=1)
    depth = np.sort(seen_depth[ring])
    return hand_depth_m / depth[: (len(depth) + 1) // 2]


def hand_depth(landmarks_uv: Float, landmarks_m: Float, K: Float) -> float | None:
    """Median depth, metres, of a hand of known size (21, 3) seen at (21, 2); None if it has none.

    Perspective-n-point; how far a hand is follows from how large it looks.
    """
    if not (np.isfinite(landmarks_uv).all() and np.isfinite(landmarks_m).all()):
        return None
    solved, rotvec, translation = cv2.solvePnP(
        landmarks_m.astype(np.float64),
        landmarks_uv.astype(np.float64),
        K,
        np.zeros(4),
        flags=cv2.SOLVEPNP_SQPNP,
    )
    if not solved:
        return None
    depth = landmarks_m @ cv2.Rodrigues(rotvec)[0].T + translation.ravel()
    middle = float(np.median(depth[:, 2]))
    return middle if 0.05 < middle < 2.0 else None
