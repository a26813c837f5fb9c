"""Two evaluations of the same clips, paired: which is better, and can that be chance?

For every number: both values over all clips, their difference with the 95 % interval of a bootstrap
that draws clips for both at once, and the p value of Wilcoxon's signed-rank test over the clips'
own values (Wilcoxon 1945), corrected for the many numbers by Holm's method (1979).
"""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from math import isnan, nan
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.stats import wilcoxon

from mint_hub.evaluation.results import (
    ClipResult,
    Results,
    ResultsError,
    drawn_metrics,
    percentiles,
    resamples,
    totalled,
)
from mint_hub.evaluation.scoring import Score
from mint_hub.geometry.metrics import (
    FIELD_OF_VIEW,
    HAND_MEASURES,
    NOTHING,
    TRAJECTORY_MEASURES,
    WORLD_MEASURES,
    HandStatistics,
    WorldStatistics,
    interval,
    measure_of,
    none_for_nan,
    number,
)
from mint_hub.loaders.atomic import replacing
from mint_hub.loaders.derived import markdown_table

LEVEL: Final = 0.05
FEWEST_CLIPS: Final = 6
"""With fewer pairs no signed-rank test can reach p < 0.05."""


@dataclass(frozen=True)
class Difference:
    """One number of A and of B.

    Attributes:
        name: of the number.
        unit: its unit.
        a: value of A over the clips that both have.
        b: value of B.
        low, high: 95 % interval of b - a.
        clips: how many clips have the number on both sides.
        p: two-sided, of clip-wise differences; NaN under FEWEST_CLIPS or where none differ.
        p_holm: the same, corrected.
        better: "A", "B", or "" where interval, test or printed digits do not tell them apart.

    """

    name: str
    unit: str
    a: float
    b: float
    low: float
    high: float
    clips: int
    p: float
    p_holm: float
    better: str


@dataclass(frozen=True)
class Comparison:
    """What two evaluations say of the clips they share."""

    a: str
    b: str
    benchmark: str
    clips: int
    only_a: int
    only_b: int
    differences: tuple[Difference, ...]

    def markdown(self) -> str:
        """Everything as one table."""
        lost = f"; {self.only_a} clips only of A and {self.only_b} only of B are left out"
        about = (
            f"A: {self.a}. B: {self.b}. {self.clips} clips of {self.benchmark}, paired"
            f"{lost if self.only_a or self.only_b else ''}. B - A with the 95 % interval of a "
            "bootstrap over clips; p of Wilcoxon's signed-rank test over clips, Holm-corrected."
        )
        tested = sum(not isnan(d.p) for d in self.differences)
        if 2 * tested * 0.5**self.clips > LEVEL:
            about += (
                f" With {self.clips} clips and {tested} numbers no p can be below {LEVEL:g}, so "
                "nothing is called better: read the intervals."
            )
        rows = [
            (
                measure_of(d.name).title,
                number(d.a, d.unit),
                number(d.b, d.unit),
                f"{number(d.b - d.a, d.unit)} {interval(d.low, d.high, d.unit)}".strip(),
                NOTHING if isnan(d.p_holm) else f"{d.p_holm:.2g}",
                d.better or NOTHING,
            )
            for d in self.differences
        ]
        heads = ("", "A", "B", "B - A", "p", "better")
        return f"# {self.b} against {self.a}\n\n{about}\n\n{markdown_table(heads, rows)}"

    def save(self, path: Path) -> Path:
        """Write it as JSON (None for NaN), whole or not at all."""
        values = {"kind": "mint-hub comparison", "schema": 1, **none_for_nan(asdict(self))}
        with replacing(path) as temporary:
            temporary.write_text(json.dumps(values, indent=1) + "\n", encoding="utf-8")
        return path


def compare(a: Results, b: Results, row: str = "prediction") -> Comparison:
    """Compare two evaluations clip by clip.

    Args:
        a: the one to start from.
        b: the other.
        row: which row of both.

    Raises:
        ResultsError: no clip in common, another truth or other pictures under the same key, or no
            such row.

    """
    for name, results in (("A", a), ("B", b)):
        if row not in results.rows:
            raise ResultsError(f"{name}: expected the row {row!r}, got {list(results.rows)}")
    mine, theirs = ({c.key: c for c in r.clips} for r in (a, b))
    shared = [key for key in mine if key in theirs]
    if not shared:
        raise ResultsError(
            f"expected evaluations of the same clips, got none in common "
            f"({a.benchmark['title']} and {b.benchmark['title']})"
        )
    for key in shared:
        if mine[key].frames != theirs[key].frames:
            raise ResultsError(
                f"{key}: expected the same frames, got {mine[key].frames} in A and "
                f"{theirs[key].frames} in B"
            )
        if mine[key].stamp != theirs[key].stamp:
            raise ResultsError(
                f"{key}: expected the same truth, pictures and hand on both sides, got others "
                f"(hash {mine[key].stamp} in A, {theirs[key].stamp} in B): evaluate both on one "
                "benchmark"
            )
    pairs = [(_score(mine[key], row), _score(theirs[key], row)) for key in shared]
    return Comparison(
        a.title(row),
        b.title(row),
        str(a.benchmark["title"]),
        len(shared),
        len(mine) - len(shared),
        len(theirs) - len(shared),
        tuple(_ranked(_differences(pairs))),
    )


def _score(clip: ClipResult, row: str) -> Score:
    return clip.scores[row]


def _differences(pairs: Sequence[tuple[Score, Score]]) -> list[Difference]:
    draws = resamples(len(pairs))
    both = _sides(pairs)
    hands = [[s.hands.get("published", HandStatistics()) for s in side] for side in both]
    found = _pooled([m.name for m in HAND_MEASURES], hands, HandStatistics, draws)
    for name in (m.name for m in TRAJECTORY_MEASURES):
        columns = [
            np.array([nan if s.camera is None else s.camera.values()[name] for s in side])
            for side in both
        ]
        found.append(_mean(f"{name} mean", columns, draws))
    world = [[s.world.get("SE(3)", WorldStatistics()) for s in side] for side in both]
    found += _pooled([m.name for m in WORLD_MEASURES], world, WorldStatistics, draws)
    columns = [np.array([s.fov_error_deg for s in side]) for side in both]
    found.append(_mean(FIELD_OF_VIEW.name, columns, draws))
    return [d for d in found if not isnan(d.a) and not isnan(d.b)]


def _sides(pairs: Sequence[tuple[Score, Score]]) -> tuple[list[Score], list[Score]]:
    return [a for a, _ in pairs], [b for _, b in pairs]


def _pooled(
    names: Sequence[str], sides: Sequence[Sequence[Any]], kind: Any, draws: NDArray[np.int64]
) -> list[Difference]:
    """Differences of numbers that are made of sums."""
    values: list[dict[str, float]] = [totalled(side, kind).metrics() for side in sides]
    by_clip: list[list[dict[str, float]]] = [[part.metrics() for part in side] for side in sides]
    drawn = [drawn_metrics(side, kind, draws) for side in sides]
    made: list[Difference] = []
    for name in names:
        columns = [np.array([metrics[name] for metrics in side]) for side in by_clip]
        spread = [np.array([metrics[name] for metrics in side]) for side in drawn]
        two = [side[name] for side in values]
        made.append(_difference(name, measure_of(name).unit, two, columns, spread[1] - spread[0]))
    return made


def _mean(
    label: str, columns: Sequence[NDArray[np.float64]], draws: NDArray[np.int64]
) -> Difference:
    known = np.isfinite(columns[0]) & np.isfinite(columns[1])
    both = [np.where(known, column, nan) for column in columns]
    unit = measure_of(label).unit
    if not known.any():
        return Difference(label, unit, nan, nan, nan, nan, 0, nan, nan, "")
    rows = draws[known[draws].any(axis=1)] if len(draws) else draws
    drawn = [np.nanmean(column[rows], axis=1) if len(rows) else np.zeros(0) for column in both]
    values = [float(np.nanmean(column)) for column in both]
    return _difference(label, unit, values, both, drawn[1] - drawn[0])


def _difference(
    label: str,
    unit: str,
    values: Sequence[float],
    by_clip: Sequence[NDArray[np.float64]],
    drawn: NDArray[np.float64],
) -> Difference:
    known = np.isfinite(by_clip[0]) & np.isfinite(by_clip[1])
    steps = (by_clip[1] - by_clip[0])[known]
    p = nan
    if len(steps) >= FEWEST_CLIPS and steps.any():
        p = float(wilcoxon(steps).pvalue)  # pyright: ignore[reportAttributeAccessIssue]
    low, high = percentiles(drawn) if len(drawn) else (nan, nan)
    return Difference(label, unit, values[0], values[1], low, high, int(known.sum()), p, nan, "")


def _ranked(differences: Sequence[Difference]) -> list[Difference]:
    """Correct the p values for their number, and say who is better where it is clear."""
    order = sorted((d.p, i) for i, d in enumerate(differences) if not isnan(d.p))
    corrected, highest = dict[int, float](), 0.0
    for rank, (p, i) in enumerate(order):
        highest = max(highest, min(1.0, p * (len(order) - rank)))
        corrected[i] = highest
    made: list[Difference] = []
    for i, d in enumerate(differences):
        p = corrected.get(i, nan)
        ideal, better = measure_of(d.name).ideal, ""
        seen = number(d.a, d.unit) != number(d.b, d.unit)  # no verdict on rounding
        if seen and ideal is not None and p < LEVEL and (d.low > 0 or d.high < 0):
            better = "B" if abs(d.b - ideal) < abs(d.a - ideal) else "A"
        made.append(replace(d, p_holm=p, better=better))
    return made
