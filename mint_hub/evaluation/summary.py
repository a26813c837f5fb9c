"""From the scores of clips to the numbers of a row, each with its interval."""

from collections.abc import Callable, Sequence
from math import nan
from typing import Any

import numpy as np

from mint_hub.evaluation.bootstrap import (
    Floats,
    Resamples,
    drawn_means,
    drawn_medians,
    drawn_metrics,
    percentiles,
)
from mint_hub.evaluation.scoring import Score
from mint_hub.geometry.metrics import (
    TRAJECTORY_MEASURES,
    HandStatistics,
    TrajectoryErrors,
    TrajectoryStatistics,
    WorldStatistics,
    ranked_sequences,
)

Triple = tuple[float, float, float]
"""A value and its 95 % interval."""


def summarise(scores: Sequence[Score], draws: Resamples) -> dict[str, Any]:
    """Numbers of one row over its clips, each with its interval."""
    found: dict[str, Any] = {"hands": {}, "camera": {}, "world": {}, "strata": {}}
    for name in {key: None for score in scores for key in score.hands}:
        parts = [score.hands.get(name, HandStatistics()) for score in scores]
        found["hands"][name] = pooled(parts, HandStatistics, draws)
    for name in {key: None for score in scores for key in score.world}:
        parts = [score.world.get(name, WorldStatistics()) for score in scores]
        found["world"][name] = pooled(parts, WorldStatistics, draws)
    if any(score.camera is not None for score in scores):
        found["camera"] = camera_numbers(scores, draws)
    for name in {key: None for score in scores for key in score.strata}:
        parts = [score.strata.get(name, HandStatistics()) for score in scores]
        total = totalled(parts, HandStatistics)
        counted = {"hands": total.pose_count, "negatives": total.negatives}
        found["strata"][name] = {**counted, **total.metrics()}
    fov = np.array([score.fov_error_deg for score in scores], float)
    known = fov[np.isfinite(fov)]
    value = float(known.mean()) if len(known) else nan
    found["fov_error_deg"] = (value, *_intervals(fov[:, None], draws, drawn_means)[0])
    return found


def pooled(parts: Sequence[Any], kind: Any, draws: Resamples) -> dict[str, Triple]:
    """Metrics of the sum of statistics, and their intervals over draws.

    A number that fewer than two recordings have by themselves has no interval.
    """
    value, drawn = totalled(parts, kind).metrics(), drawn_metrics(parts, kind, draws)
    own = [part.metrics() for part in parts]
    found: dict[str, Triple] = {}
    for name in value:
        spread = np.array([d[name] for d in drawn], float)
        several = draws.has_several(np.isfinite([metrics[name] for metrics in own]))
        found[name] = (value[name], *(percentiles(spread) if several else (nan, nan)))
    return found


def totalled(parts: Sequence[Any], kind: Any) -> Any:
    """The sum of statistics of a kind."""
    total = kind()
    for part in parts:
        total = total + part
    return total


def camera_numbers(scores: Sequence[Score], draws: Resamples) -> dict[str, Any]:
    """Mean and median over sequences, without degenerate ones unless there are no others."""
    errors = [score.camera for score in scores]
    known = [e for e in errors if e is not None]
    found: dict[str, Any] = {
        "sequences": len(known),
        "degenerate": sum(e.degenerate for e in known),
    }
    lenient = all(e.degenerate for e in known)
    value = TrajectoryStatistics(tuple(known)).metrics(with_degenerate=lenient)
    columns = camera_columns(errors)
    table = np.stack(list(columns.values()), axis=1)
    for word, function in (("mean", drawn_means), ("median", drawn_medians)):
        intervals = _intervals(table, draws, function)
        for name, interval in zip(columns, intervals, strict=True):
            found[f"{name} {word}"] = (value[f"{name} {word}"], *interval)
    return found


def camera_columns(errors: Sequence[TrajectoryErrors | None]) -> dict[str, Floats]:
    """Return every trajectory measure's values by clip; NaN where the clip does not count."""
    known = [e for e in errors if e is not None]
    counts = iter(ranked_sequences(known, all(e.degenerate for e in known)))
    rows = [e.values() if e is not None and next(counts) else None for e in errors]
    return {
        m.name: np.array([nan if row is None else row[m.name] for row in rows], float)
        for m in TRAJECTORY_MEASURES
    }


def _intervals(
    table: Floats, draws: Resamples, function: Callable[[Floats, Resamples], Floats]
) -> list[tuple[float, float]]:
    """The interval of each column (N, M); NaN where fewer than two recordings have the number."""
    drawn = function(table, draws)
    return [
        percentiles(drawn[:, k]) if draws.has_several(np.isfinite(table[:, k])) else (nan, nan)
        for k in range(table.shape[1])
    ]
