"""Camera trajectories: relative and absolute pose error, scale and drift.

Poses are camera-to-world (T, 4, 4), metres, at a constant frame rate; both paths may live in
worlds of their own. Numbers come under two alignments of the camera centres, each one Umeyama fit:
SE(3), without scale (the MINT paper's tables), and Sim(3). RPE follows Sturm et al. 2012 (the TUM
RGB-D benchmark); RPE and ATE equal those of the ``evo`` package.

Sequences are not pooled: each has its numbers, and a corpus their means and medians.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from math import fsum, isnan, nan
from statistics import median
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mint_hub.conventions import MODEL_FPS
from mint_hub.geometry.additive_metrics import (
    Floats,
    Measure,
    checked_fps,
    checked_path,
    none_for_nan,
    require_fields,
)
from mint_hub.geometry.rigid import Similarity, inverse, umeyama
from mint_hub.geometry.rotations import geodesic_angle

DEGENERATE_PATH_M = 1e-9
"""A path shorter than this has no shape to compare."""

MIN_DISPLACEMENT_M = 0.01
"""True displacements over 1 s under this say nothing about scale and are left out."""

_PER_ALIGNMENT = {
    "ATE": ("ate_mm", "mm"),
    "ATE %": ("ate_percent", "% of path"),
    "RPE-T": ("rpe_translation_mm", "mm"),
    "RPE-T 1 s": ("rpe_1s_translation_mm", "mm"),
    "ATE 10 s": ("ate_10s_mm", "mm"),
    "ATE 1 min": ("ate_1min_mm", "mm"),
    "ATE 10 min": ("ate_10min_mm", "mm"),
}

_WHOLE = {
    "RPE-R": ("rpe_rotation_deg", "deg", 0.0),
    "RPE-R 1 s": ("rpe_1s_rotation_deg", "deg", 0.0),
    "Arc-length ratio (predicted / true)": ("arc_length_ratio", "", 1.0),
    "|log scale| 1 s": ("log_scale_1s", "", 0.0),
}

TRAJECTORY_MEASURES = (
    *(Measure(name, unit, 0.0) for name, (_, unit) in _PER_ALIGNMENT.items()),
    *(Measure(name, unit, ideal) for name, (_, unit, ideal) in _WHOLE.items()),
    *(Measure(f"{name}, Sim(3)", unit, 0.0) for name, (_, unit) in _PER_ALIGNMENT.items()),
)
"""What ``TrajectoryErrors.values`` returns; a corpus has "<name> mean" and "<name> median"."""


@dataclass(frozen=True)
class AlignedErrors:
    """What depends on the alignment; NaN where the sequence is too short, or has no Sim(3).

    Attributes:
        ate_mm: RMSE of the camera centres, one fit over the sequence.
        ate_percent: that, in percent of the true path's length.
        rpe_translation_mm: RMSE of the relative translation from frame to frame.
        rpe_1s_translation_mm: the same over 1 s, every start.
        ate_10s_mm: RMSE of the centres in consecutive stretches of 10 s, a fit in each; a tail
            shorter than that is left out. How far the path drifts in that time.
        ate_1min_mm: in stretches of 1 minute.
        ate_10min_mm: in stretches of 10 minutes.

    """

    ate_mm: float
    ate_percent: float
    rpe_translation_mm: float
    rpe_1s_translation_mm: float
    ate_10s_mm: float
    ate_1min_mm: float
    ate_10min_mm: float


@dataclass(frozen=True)
class TrajectoryErrors:
    """One sequence's numbers.

    Attributes:
        frames: poses compared.
        degenerate: either path is shorter than ``DEGENERATE_PATH_M``: reported, not ranked. Then
            everything of Sim(3) is NaN, and what divides by the true path where that is it.
        true_path_m: length of the true path.
        predicted_path_m: length of the predicted path, not aligned.
        scale: of the Sim(3) that takes the prediction to the truth.
        arc_length_ratio: predicted path length / true path length.
        log_scale_1s: median of |log(predicted / true)| of displacements over 1 s, where the true
            one is at least ``MIN_DISPLACEMENT_M``; predicted ones are floored at 1e-9 m.
        rpe_rotation_deg: RMSE of the relative rotation from frame to frame.
        rpe_1s_rotation_deg: the same over 1 s.
        se3: under SE(3).
        sim3: under Sim(3).

    """

    frames: int
    degenerate: bool
    true_path_m: float
    predicted_path_m: float
    scale: float
    arc_length_ratio: float
    log_scale_1s: float
    rpe_rotation_deg: float
    rpe_1s_rotation_deg: float
    se3: AlignedErrors
    sim3: AlignedErrors

    def values(self) -> dict[str, float]:
        """Return the values of ``TRAJECTORY_MEASURES`` by name."""
        return {
            **{name: getattr(self.se3, field) for name, (field, _) in _PER_ALIGNMENT.items()},
            **{name: getattr(self, field) for name, (field, _, _) in _WHOLE.items()},
            **{
                f"{name}, Sim(3)": getattr(self.sim3, field)
                for name, (field, _) in _PER_ALIGNMENT.items()
            },
        }

    def to_dict(self) -> dict[str, Any]:
        """Return nested fields ready for JSON, None for NaN."""
        return none_for_nan(asdict(self))

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "TrajectoryErrors":
        """Invert ``to_dict``; ValueError when a field is missing or unknown."""
        require_fields(cls, values)
        parts: dict[str, Any] = {k: nan if v is None else v for k, v in values.items()}
        for name in ("se3", "sim3"):
            require_fields(AlignedErrors, values[name])
            parts[name] = AlignedErrors(
                **{key: nan if v is None else v for key, v in values[name].items()}
            )
        return cls(**parts)


@dataclass(frozen=True)
class TrajectoryStatistics:
    """The sequences of a corpus, or of a part of it; parts are added."""

    sequences: tuple[TrajectoryErrors, ...] = ()

    def __add__(self, other: "TrajectoryStatistics") -> "TrajectoryStatistics":
        """Put the sequences together; ``metrics`` does not depend on their order."""
        return TrajectoryStatistics(self.sequences + other.sequences)

    def metrics(self, with_degenerate: bool = False) -> dict[str, float]:
        """Mean and median over sequences of every measure, and how many sequences there are.

        Degenerate sequences are counted and left out, but ``with_degenerate`` lets in those that
        only the prediction makes so, see ``ranked_sequences``. A measure that no sequence has is
        NaN.
        """
        counts = ranked_sequences(self.sequences, with_degenerate)
        rows = [s.values() for s, own in zip(self.sequences, counts, strict=True) if own]
        found: dict[str, float] = {
            "sequences": len(self.sequences),
            "degenerate": sum(s.degenerate for s in self.sequences),
        }
        for measure in TRAJECTORY_MEASURES:
            known = [row[measure.name] for row in rows if not isnan(row[measure.name])]
            found[f"{measure.name} mean"] = fsum(known) / len(known) if known else nan
            found[f"{measure.name} median"] = median(known) if known else nan
        return found

    def to_dict(self) -> dict[str, Any]:
        """Return the sequences ready for JSON."""
        return {"sequences": [s.to_dict() for s in self.sequences]}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "TrajectoryStatistics":
        """Invert ``to_dict``."""
        require_fields(cls, values)
        return cls(tuple(TrajectoryErrors.from_dict(s) for s in values["sequences"]))


def ranked_sequences(
    sequences: Sequence[TrajectoryErrors], with_degenerate: bool = False
) -> list[bool]:
    """Say which sequences count in a mean: those that are not degenerate.

    A row that never moves the camera has no such sequence. ``with_degenerate`` lets in every one
    whose true camera moves, which are those that any other row is ranked on; all where none does.
    """
    if not with_degenerate:
        return [not s.degenerate for s in sequences]
    moving = [s.true_path_m >= DEGENERATE_PATH_M for s in sequences]
    return moving if any(moving) else [True] * len(sequences)


def trajectory_errors(predicted: Any, truth: Any, fps: float = MODEL_FPS) -> TrajectoryErrors:
    """Score a predicted camera path against the true one.

    With E = (G_i^-1 G_j)^-1 (P_i^-1 P_j), RPE-T is the RMSE of the length of E's translation, mm,
    and RPE-R that of its angle, degrees. Sim(3) scales the predicted centres before that.

    Args:
        predicted: (T, 4, 4) camera to its world, metres.
        truth: (T, 4, 4), of the same frames.
        fps: frames a second, for what is measured over seconds.

    Returns:
        The numbers; see there for degenerate paths. RPE of a single frame is NaN.

    Raises:
        ValueError: shapes that disagree, no frame, poses that are not finite or not rigid, or a
            frame rate that is not positive.

    """
    G = checked_path("truth", truth)
    P = checked_path("predicted", predicted, len(G))
    second = max(1, round(checked_fps(fps)))
    true_path, path = path_length(G), path_length(P)
    degenerate = min(true_path, path) < DEGENERATE_PATH_M
    scale = nan if degenerate else float(align_paths(P, G, with_scale=True).scale)
    return TrajectoryErrors(
        frames=len(G),
        degenerate=degenerate,
        true_path_m=true_path,
        predicted_path_m=path,
        scale=scale,
        arc_length_ratio=path / true_path if true_path >= DEGENERATE_PATH_M else nan,
        log_scale_1s=_log_scale(P[:, :3, 3], G[:, :3, 3], second),
        rpe_rotation_deg=_rpe(P, G, 1)[1],
        rpe_1s_rotation_deg=_rpe(P, G, second)[1],
        se3=_aligned_errors(P, G, fps, true_path, None),
        sim3=_aligned_errors(P, G, fps, true_path, scale),
    )


def path_length(T_world_from_camera: Floats) -> float:
    """Length in metres of the way of the camera centre; poses (T, 4, 4)."""
    return float(np.linalg.norm(np.diff(T_world_from_camera[:, :3, 3], axis=0), axis=-1).sum())


def align_paths(predicted: Floats, truth: Floats, with_scale: bool) -> Similarity:
    """Fit the motion of the predicted world that brings the camera centres onto the true ones.

    One Umeyama fit over the centres. What centres leave free (the turn about a straight path, every
    turn of a still camera) follows the camera rotations, which enter with a relative weight of
    1e-12. Where either path is degenerate the scale is 1. Poses (T, 4, 4), rigid.
    """
    degenerate = min(path_length(predicted), path_length(truth)) < DEGENERATE_PATH_M
    points: list[Floats] = []
    for T in (predicted, truth):
        centre = T[:, None, :3, 3]
        spread = float(np.sqrt(np.square(centre - centre.mean(axis=0)).sum(axis=-1).mean()))
        axes = np.swapaxes(T[:, :3, :3], 1, 2) * (1e-6 * spread if spread > 0 else 1.0)
        around = centre - centre.mean(axis=0)
        points.append(np.concatenate([around, around + axes, around - axes], axis=1).reshape(-1, 3))
    fit = umeyama(*points, with_scale=with_scale and not degenerate, check=False)
    mean, true_mean = (T[:, :3, 3].mean(axis=0) for T in (predicted, truth))
    return Similarity(fit.scale, fit.rotation, true_mean - fit.scale * (fit.rotation @ mean))


def associate(
    times_s: Any, other_times_s: Any, max_diff_s: float = 0.01
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Pair the samples of two clocks: for each of the fewer times the nearest of the others.

    Args:
        times_s: (N,) seconds, not decreasing.
        other_times_s: (M,) seconds, not decreasing.
        max_diff_s: pairs further apart than this are dropped.

    Returns:
        (indices, other_indices) of the pairs, in time's order. Of two equally near samples the
        earlier is taken; two of the fewer times may take the same sample.

    Raises:
        ValueError: no times, or times that decrease.

    """
    times, others = (np.asarray(t, dtype=np.float64) for t in (times_s, other_times_s))
    for name, clock in (("times_s", times), ("other_times_s", others)):
        if clock.ndim != 1 or not len(clock) or not (np.diff(clock) >= 0).all():
            raise ValueError(
                f"{name}: expected times (N,) that do not decrease, got shape {clock.shape}"
            )
    swapped = len(others) <= len(times)
    few, many = (others, times) if swapped else (times, others)
    after = np.searchsorted(many, few, side="right").clip(0, len(many) - 1)
    before = (after - 1).clip(0)
    nearest = np.where(np.abs(many[after] - few) < np.abs(few - many[before]), after, before)
    kept = np.flatnonzero(np.abs(many[nearest] - few) <= max_diff_s)
    return (nearest[kept], kept) if swapped else (kept, nearest[kept])


def _aligned_errors(
    P: Floats, G: Floats, fps: float, true_path_m: float, scale: float | None
) -> AlignedErrors:
    """Errors under SE(3) where ``scale`` is None, else under Sim(3) with that scale (or NaN)."""
    if scale is not None and isnan(scale):
        return AlignedErrors(**{f.name: nan for f in fields(AlignedErrors)})
    with_scale = scale is not None
    scaled = P.copy()
    scaled[:, :3, 3] *= 1.0 if scale is None else scale
    centres, true_centres = P[:, :3, 3], G[:, :3, 3]
    ate = _rmse_mm(align_paths(P, G, with_scale).apply(centres) - true_centres)
    drifts = [_drift(centres, true_centres, round(s * fps), with_scale) for s in (10, 60, 600)]
    percent = 0.1 * ate / true_path_m if true_path_m >= DEGENERATE_PATH_M else nan
    second = max(1, round(fps))
    return AlignedErrors(ate, percent, _rpe(scaled, G, 1)[0], _rpe(scaled, G, second)[0], *drifts)


def _rpe(P: Floats, G: Floats, step: int) -> tuple[float, float]:
    """RMSE of relative poses over ``step`` frames: (mm, degrees); NaN when there are none."""
    if len(P) <= step:
        return nan, nan
    p, g = (inverse(T[:-step]) @ T[step:] for T in (P, G))
    angle = np.degrees(geodesic_angle(g[:, :3, :3], p[:, :3, :3]))
    return _rmse_mm(p[:, :3, 3] - g[:, :3, 3]), float(np.sqrt(np.square(angle).mean()))


def _drift(centres: Floats, true_centres: Floats, length: int, with_scale: bool) -> float:
    """RMSE in mm of centres (T, 3) cut in stretches of ``length``, each fitted by itself."""
    count = len(centres) // length if length else 0
    if count == 0:
        return nan
    source, target = (
        x[: count * length].reshape(count, length, 3) for x in (centres, true_centres)
    )
    return _rmse_mm(umeyama(source, target, with_scale, check=False).apply(source) - target)


def _log_scale(centres: Floats, true_centres: Floats, step: int) -> float:
    """Median |log(predicted / true)| of displacements over ``step`` frames; NaN without any."""
    far, true_far = (np.linalg.norm(x[step:] - x[:-step], axis=-1) for x in (centres, true_centres))
    moving = true_far >= MIN_DISPLACEMENT_M
    if not moving.any():
        return nan
    far = np.maximum(far[moving], DEGENERATE_PATH_M)
    return float(np.median(np.abs(np.log(far / true_far[moving]))))


def _rmse_mm(errors_m: Floats) -> float:
    """Root of the mean squared length of vectors (..., 3), metres, in mm."""
    return 1e3 * float(np.sqrt(np.square(errors_m).sum(axis=-1).mean()))
