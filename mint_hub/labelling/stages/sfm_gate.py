"""What to believe of a structure from motion: the covisibility gate, focals pooled, reasons.

"Registered" is no proof: a mapper places images that see nothing in common somewhere, too. What
holds two keyframes together is the map points that both see. Pure functions on numbers.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mint_hub.geometry.arrays import runs

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]

MIN_SHARED: Final = 20
"""Map points two keyframes in a row must share.

On sharp clips right solutions shared 84 and more, on dark ones with motion blur down to about 25;
wrong ones share 0, or a handful that lie on the moving hands and what they hold. A pose needs some
six spread points of which half may be wrong, and the mapper itself asks for 15 matches of a pair.
"""

MAX_UNSOLVED: Final = 15
"""Frames in a row whose pose may be interpolated: half a second."""

MIN_ANGLE_DEG: Final = 0.7
"""Median angle between the rays to a map point, below which the camera moved too little."""

MIN_FLOW_PX: Final = 0.5
MIN_FEATURES: Final = 100
MIN_MATCHES: Final = 30

MAX_TURNING: Final = 0.9
"""Share of matched pairs that a homography explains, above which a failure is a turning camera's.

A flat scene looks the same to a pair; but its map does not fail.
"""

STILL: Final = "camera moves too little for structure from motion"
FLAT: Final = "too little texture for structure from motion"
UNMATCHED: Final = "neighbouring frames have too little in common for structure from motion"
UNSOLVED: Final = "structure from motion found no consistent solution"
UNLINKED: Final = "too few map points link the frames"
SHORT: Final = "too short a piece after the camera's path was split"


def covisibility(keyframe: NDArray[np.int64], shared: NDArray[np.int64]) -> NDArray[np.float32]:
    """Points shared with the next frame, (F,), for frames first keyframe .. last keyframe.

    Between keyframes it is the number that the keyframes on both sides share: fewer than
    neighbouring frames do, never more. The last one repeats.
    """
    if len(keyframe) < 2:
        return np.zeros(len(keyframe), dtype=np.float32)
    counts = np.repeat(shared, np.diff(keyframe)).astype(np.float32)
    return np.append(counts, counts[-1])


def segments(
    covisible: NDArray[np.float32],
    solved: Bool,
    *,
    min_shared: float = MIN_SHARED,
    max_unsolved: int = MAX_UNSOLVED,
    min_frames: int = 2,
) -> list[tuple[int, int]]:
    """Stretches (start, stop) of frames that hold together, in order.

    A link from frame t to t + 1 breaks where fewer than ``min_shared`` points are shared, and
    where frames are unsolved for more than ``max_unsolved`` in a row. Stretches begin and end with
    solved frames and have at least ``min_frames``.
    """
    usable = np.ones(len(covisible), dtype=bool)
    for start, stop in runs(~solved):
        if stop - start > max_unsolved:
            usable[start:stop] = False
    linked = (covisible[:-1] >= min_shared) & usable[:-1] & usable[1:]
    kept: list[tuple[int, int]] = []
    for start, last in runs(linked):
        frames = start + np.flatnonzero(solved[start : last + 1])
        if len(frames) and frames[-1] + 1 - frames[0] >= min_frames:
            kept.append((int(frames[0]), int(frames[-1]) + 1))
    return kept


def gaps(kept: Sequence[tuple[int, int]], num_frames: int) -> list[tuple[int, int]]:
    """Stretches of 0 .. num_frames that are in none of ``kept`` (disjoint, in order)."""
    edges = [0, *(edge for stretch in kept for edge in stretch), num_frames]
    pairs = zip(edges[::2], edges[1::2], strict=True)
    return [(start, stop) for start, stop in pairs if stop > start]


def disjoint(stretches: Sequence[tuple[int, int]]) -> list[int]:
    """Indices of stretches to keep so that none overlap: the longest first."""
    order = sorted(
        range(len(stretches)), key=lambda i: (stretches[i][0] - stretches[i][1], stretches[i][0])
    )
    kept: list[int] = []
    for i in order:
        start, stop = stretches[i]
        if all(stop <= stretches[j][0] or start >= stretches[j][1] for j in kept):
            kept.append(i)
    return sorted(kept, key=lambda i: stretches[i][0])


def reason(evidence: Mapping[str, float], models: Sequence[Mapping[str, Any]]) -> str:
    """Say why there is no path, from what there was to see."""
    if evidence["features"] < MIN_FEATURES:
        return FLAT
    if evidence["matches"] < MIN_MATCHES:
        return UNMATCHED
    if evidence["flow_px"] < MIN_FLOW_PX or any(moved_too_little(m) for m in models):
        return STILL
    if evidence["turning"] > MAX_TURNING:
        return STILL
    return UNLINKED if models else UNSOLVED


def moved_too_little(model: Mapping[str, Any]) -> bool:
    """Whether a model's rays hardly cross: a turning or resting camera has no path to find."""
    return bool(model["angle_deg"] < MIN_ANGLE_DEG)


@dataclass(frozen=True)
class PooledFocal:
    """One focal from several windows.

    Attributes:
        focal: their robust mean.
        spread: weighted standard deviation of the logarithms of those that agree.
        agreeing: how many agree.
        confidence: 0 to 1.

    """

    focal: float
    spread: float
    agreeing: int
    confidence: float


def pool_focals(focals: Sequence[float], weights: Sequence[float]) -> PooledFocal:
    """One focal for a video: the weighted mean of those within 3 % of the weighted median.

    Confidence grows with the number of windows that agree and falls with their spread and with the
    share of weight that does not agree; one window alone is worth at most 0.6.

    Raises:
        ValueError: none, or focals or weights that are not positive.

    """
    logs, w = np.log(np.asarray(focals, dtype=np.float64)), np.asarray(weights, dtype=np.float64)
    if not len(logs) or len(logs) != len(w) or not np.isfinite(logs).all() or not (w > 0).all():
        raise ValueError(
            f"focals: expected positive ones with positive weights, got {focals} and {weights}"
        )
    order = np.argsort(logs, kind="stable")
    half = np.cumsum(w[order]) >= 0.5 * w.sum()
    median = logs[order][int(np.argmax(half))]
    near = np.abs(logs - median) < 0.03
    mean = float(np.average(logs[near], weights=w[near]))
    spread = float(np.sqrt(np.average((logs[near] - mean) ** 2, weights=w[near])))
    count = int(near.sum())
    share = float(w[near].sum() / w.sum())
    confidence = (0.6 if count == 1 else 1 - 0.3 / count) * share * float(np.exp(-spread / 0.03))
    return PooledFocal(float(np.exp(mean)), spread, count, confidence)
