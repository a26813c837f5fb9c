"""Two evaluations of the same clips, paired: which is better, and can that be chance?

For every number: both values over all clips, their difference with the 95 % interval of a bootstrap
that draws recordings for both at once, and the p value of Wilcoxon's signed-rank test (Wilcoxon
1945), corrected for the many numbers by Holm's method (1979). Windows of one recording are alike,
so a recording gives the test one value. Tested is which side is nearer to the ideal: where the
ideal lies between (a path too long or too short) B - A can be clear and say nothing of that.
"""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from math import isnan, nan
from pathlib import Path
from typing import Any, Final

import numpy as np
from scipy.stats import rankdata, wilcoxon

from mint_hub.evaluation.bootstrap import (
    Floats,
    Resamples,
    drawn_means,
    drawn_metrics,
    percentiles,
)
from mint_hub.evaluation.results import Results, ResultsError
from mint_hub.evaluation.scoring import Score
from mint_hub.evaluation.summary import camera_columns, totalled
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
from mint_hub.view.canvas import plural

LEVEL: Final = 0.05
FEWEST_RECORDINGS: Final = 6
"""With fewer pairs no signed-rank test can reach p < 0.05."""
ROUNDING: Final = 1e-6
"""Recordings whose numbers differ by no more, relatively, tie."""


@dataclass(frozen=True)
class Difference:
    """One number of A and of B.

    Attributes:
        name: of the number.
        unit: its unit.
        a: value of A over the clips that both have.
        b: value of B.
        low, high: 95 % interval of b - a; NaN where fewer than two recordings have the number.
        nearer_low, nearer_high: the same of |b - ideal| - |a - ideal|; of b - a without an ideal.
        clips: how many clips have the number on both sides.
        recordings: how many recordings do.
        p: two-sided, of the recordings' own |b - ideal| - |a - ideal| (b - a without an ideal); NaN
            under FEWEST_RECORDINGS or where none differ.
        ahead: "A" or "B", whose recordings the test finds nearer; "" where it finds neither.
        p_holm: the same, corrected.
        better: "A", "B", or "" where interval, test or printed digits do not tell which is nearer
            to the ideal, or interval and test disagree.

    """

    name: str
    unit: str
    a: float
    b: float
    low: float
    high: float
    nearer_low: float
    nearer_high: float
    clips: int
    recordings: int
    p: float
    ahead: str
    p_holm: float = nan
    better: str = ""


@dataclass(frozen=True)
class Comparison:
    """What two evaluations say of the clips they share.

    Attributes:
        a: title of A's row.
        b: title of B's row.
        benchmark: A's title.
        clips: that both have.
        recordings: of which these clips are.
        still: clips that have camera numbers but do not count there, because the true path or
            either predicted one is degenerate.
        only_a: clips of A alone.
        only_b: clips of B alone.
        differences: a number each.

    """

    a: str
    b: str
    benchmark: str
    clips: int
    recordings: int
    still: int
    only_a: int
    only_b: int
    differences: tuple[Difference, ...]

    def markdown(self) -> str:
        """Everything as one table."""
        lost = f"; {self.only_a} clips only of A and {self.only_b} only of B are left out"
        cut = f" (windows of {plural(self.recordings, 'recording')})"
        about = (
            f"A: {self.a}. B: {self.b}. {plural(self.clips, 'clip')}"
            f"{cut if self.recordings < self.clips else ''} of {self.benchmark}, paired"
            f"{lost if self.only_a or self.only_b else ''}. B - A with the 95 % interval of a "
            "bootstrap over recordings; p of Wilcoxon's signed-rank test over recordings of which "
            "is nearer to the ideal, Holm-corrected."
        )
        if self.still:
            about += (
                f" {plural(self.still, 'clip')} whose camera does not move, in truth or in a "
                "prediction, left out of the camera's numbers on both sides."
            )
        tested = sum(not isnan(d.p) for d in self.differences)
        if 2 * tested * 0.5**self.recordings > LEVEL:
            about += (
                f" With {plural(self.recordings, 'recording')} and {tested} numbers no p can be "
                f"below {LEVEL:g}, so nothing is called better: read the intervals."
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
        ResultsError: no clip in common, another truth under the same key, or no such row.

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
                f"{key}: expected the same truth and hand on both sides, got others "
                f"(hash {mine[key].stamp} in A, {theirs[key].stamp} in B): evaluate both on one "
                "benchmark"
            )
    draws = Resamples.of([mine[key].recording for key in shared])
    sides = [[results[key].scores[row] for key in shared] for results in (mine, theirs)]
    columns = _camera_columns(sides)
    return Comparison(
        a.title(row),
        b.title(row),
        str(a.benchmark["title"]),
        len(shared),
        draws.count,
        _left_out(sides, columns),
        len(mine) - len(shared),
        len(theirs) - len(shared),
        tuple(_ranked(_differences(sides, columns, draws))),
    )


def _camera_columns(sides: Sequence[Sequence[Score]]) -> list[dict[str, Floats]]:
    """Trajectory measures by clip of each side; NaN on both where the clip is not ranked on one."""
    columns = [camera_columns([score.camera for score in side]) for side in sides]
    for name in columns[0]:
        lost = np.isnan(columns[0][name]) | np.isnan(columns[1][name])
        for side in columns:
            side[name] = np.where(lost, nan, side[name])
    return columns


def _left_out(sides: Sequence[Sequence[Score]], columns: Sequence[dict[str, Floats]]) -> int:
    """Count clips with a degenerate path on a side and no camera number for it."""
    counted = np.any([np.isfinite(column) for column in columns[0].values()], axis=0)
    still = [
        any(score.camera is not None and score.camera.degenerate for score in pair)
        for pair in zip(*sides, strict=True)
    ]
    return int((np.array(still) & ~counted).sum())


def _differences(
    sides: Sequence[Sequence[Score]], columns: Sequence[dict[str, Floats]], draws: Resamples
) -> list[Difference]:
    hands = [[s.hands.get("published", HandStatistics()) for s in side] for side in sides]
    found = _pooled([m.name for m in HAND_MEASURES], hands, HandStatistics, draws)
    for name in (m.name for m in TRAJECTORY_MEASURES):
        found.append(_mean(f"{name} mean", [side[name] for side in columns], draws))
    world = [[s.world.get("SE(3)", WorldStatistics()) for s in side] for side in sides]
    found += _pooled([m.name for m in WORLD_MEASURES], world, WorldStatistics, draws)
    fov = [np.array([s.fov_error_deg for s in side], float) for side in sides]
    found.append(_mean(FIELD_OF_VIEW.name, fov, draws))
    return [d for d in found if not isnan(d.a) and not isnan(d.b)]


def _pooled(
    names: Sequence[str], sides: Sequence[Sequence[Any]], kind: Any, draws: Resamples
) -> list[Difference]:
    """Differences of numbers that are made of sums."""
    values: list[dict[str, float]] = [totalled(side, kind).metrics() for side in sides]
    clips: list[list[dict[str, float]]] = [[part.metrics() for part in side] for side in sides]
    recordings: list[list[dict[str, float]]] = [
        [totalled([side[i] for i in group], kind).metrics() for group in draws.groups()]
        for side in sides
    ]
    drawn = [drawn_metrics(side, kind, draws) for side in sides]
    made: list[Difference] = []
    for name in names:
        two = [side[name] for side in values]
        own, spread, known = (_columns(rows, name) for rows in (recordings, drawn, clips))
        count = int((np.isfinite(known[0]) & np.isfinite(known[1])).sum())
        made.append(_difference(name, two, own, spread, count))
    return made


def _columns(sides: Sequence[Sequence[dict[str, float]]], name: str) -> list[Floats]:
    return [np.array([metrics[name] for metrics in side], float) for side in sides]


def _mean(label: str, columns: Sequence[Floats], draws: Resamples) -> Difference:
    """Difference of a number that is a mean over the clips that have it on both sides."""
    known = np.isfinite(columns[0]) & np.isfinite(columns[1])
    if not known.any():
        return _difference(label, [nan, nan], [np.zeros(0)] * 2, [np.zeros(0)] * 2, 0)
    both = [np.where(known, column, nan) for column in columns]
    kept = [group[known[group]] for group in draws.groups() if known[group].any()]
    own = [np.array([column[group].mean() for group in kept]) for column in both]
    values = [float(column[known].mean()) for column in both]
    spread = [drawn_means(column, draws) for column in both]
    return _difference(label, values, own, spread, int(known.sum()))


def _difference(
    label: str,
    values: Sequence[float],
    own: Sequence[Floats],
    drawn: Sequence[Floats],
    clips: int,
) -> Difference:
    """Difference of two values, from the recordings' own values and those of the draws."""
    measure = measure_of(label)
    known = np.isfinite(own[0]) & np.isfinite(own[1])
    steps = _nearer(own[0], own[1], measure.ideal)[known]
    steps[np.abs(steps) <= ROUNDING * np.maximum(np.abs(own[0]), np.abs(own[1]))[known]] = 0.0
    p, ahead = nan, ""
    if len(steps) >= FEWEST_RECORDINGS and steps.any():
        p = float(wilcoxon(steps).pvalue)  # pyright: ignore[reportAttributeAccessIssue]
        signed_ranks = float((np.sign(steps) * rankdata(np.abs(steps))).sum())
        ahead = "A" if signed_ranks > 0 else "B" if signed_ranks < 0 else ""
    plain = nearer = (nan, nan)
    if known.sum() > 1:
        plain = percentiles(drawn[1] - drawn[0])
        nearer = percentiles(_nearer(drawn[0], drawn[1], measure.ideal))
    count = int(known.sum())
    return Difference(
        label, measure.unit, values[0], values[1], *plain, *nearer, clips, count, p, ahead
    )


def _nearer(a: Floats, b: Floats, ideal: float | None) -> Floats:
    """Below zero where b is nearer to the ideal than a; b - a without an ideal."""
    return b - a if ideal is None else np.abs(b - ideal) - np.abs(a - ideal)


def _ranked(differences: Sequence[Difference]) -> list[Difference]:
    """Correct the p values for their number, and say who is better where it is clear."""
    order = sorted((d.p, i) for i, d in enumerate(differences) if not isnan(d.p))
    corrected, highest = dict[int, float](), 0.0
    for rank, (p, i) in enumerate(order):
        highest = max(highest, min(1.0, p * (len(order) - rank)))
        corrected[i] = highest
    made: list[Difference] = []
    for i, d in enumerate(differences):
        p, better = corrected.get(i, nan), ""
        seen = number(d.a, d.unit) != number(d.b, d.unit)  # no verdict on rounding
        if seen and measure_of(d.name).ideal is not None and p < LEVEL:
            clear = "B" if d.nearer_high < 0 else "A" if d.nearer_low > 0 else ""
            better = clear if clear == d.ahead else ""
        made.append(replace(d, p_holm=p, better=better))
    return made
