"""What an evaluation found, as data: clip by clip, summed up, and as JSON.

The file (schema 1) holds

- ``benchmark``: title, source, clips, frames, notes, published (key of the paper's numbers, or
  null), hash of all clips' truth;
- ``prediction``: facts of the checkpoint or labels, or null where only trivial rows were asked for;
- ``rows``: for the prediction and each trivial row its numbers, each as [value, low, high] with the
  95 % interval of a bootstrap over clips (nulls where nothing was counted, or of one clip):
  ``hands`` by reading of the camera (see `scoring`), ``camera`` as mean and median over clips,
  ``world`` by alignment, ``strata`` (value alone, and ``hands`` counted), ``fov_error_deg``;
- ``clips``: key, frames, source, seconds and the statistics of every row, which add: from them
  everything above can be made again, and two files can be compared clip by clip;
- ``efficiency``, ``warnings``, ``skipped`` (clips without a prediction), ``mint_hub``, ``date``.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mint_hub.evaluation.scoring import Score
from mint_hub.geometry.metrics import (
    TRAJECTORY_MEASURES,
    HandStatistics,
    TrajectoryStatistics,
    WorldStatistics,
    none_for_nan,
)
from mint_hub.loaders.atomic import replacing

SCHEMA: Final = 1
KIND: Final = "mint-hub evaluation"
RESAMPLES: Final = 1000
SEED: Final = 0

Triple = tuple[float, float, float]
"""A value and its 95 % interval."""


class ResultsError(ValueError):
    """A file of results that is none, or of another kind than expected."""


@dataclass(frozen=True, eq=False)
class ClipResult:
    """The scores of one clip by row; ``seconds`` and ``peak_bytes`` where it was predicted now."""

    key: str
    frames: int
    source: str
    stamp: str
    scores: dict[str, Score]
    seconds: float | None = None
    peak_bytes: int | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return what JSON holds of it."""
        return {**self.__dict__, "scores": {k: v.to_dict() for k, v in self.scores.items()}}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "ClipResult":
        """Invert ``to_dict``."""
        scores = {k: Score.from_dict(v) for k, v in values["scores"].items()}
        plain: dict[str, Any] = {k: v for k, v in values.items() if k != "scores"}
        return cls(**plain, scores=scores)


@dataclass(frozen=True, eq=False)
class Results:
    """An evaluation.

    Attributes:
        benchmark: facts, see the module.
        prediction: facts, or None.
        clips: in the benchmark's order.
        trained_on: what the mean hand of the trivial rows is the mean of.
        efficiency: see `efficiency_of`.
        warnings: what a reader has to know.
        skipped: keys of clips without a prediction.
        mint_hub: version.
        date: ISO, UTC.

    """

    benchmark: dict[str, Any]
    prediction: dict[str, Any] | None
    clips: tuple[ClipResult, ...]
    trained_on: str
    efficiency: dict[str, Any] | None = None
    warnings: tuple[str, ...] = ()
    skipped: tuple[str, ...] = ()
    mint_hub: str = ""
    date: str = ""

    @cached_property
    def rows(self) -> tuple[str, ...]:
        """Names of the rows, the prediction first."""
        return tuple(self.clips[0].scores) if self.clips else ()

    def title(self, row: str) -> str:
        """What a table calls a row."""
        return str(self.prediction["name"]) if row == "prediction" and self.prediction else row

    @cached_property
    def summary(self) -> dict[str, dict[str, Any]]:
        """Numbers of every row, see the module."""
        return {row: summarise([clip.scores[row] for clip in self.clips]) for row in self.rows}

    def to_dict(self) -> dict[str, Any]:
        """Return what the file holds."""
        rows = [
            {"row": row, "name": self.title(row), **none_for_nan(numbers)}
            for row, numbers in self.summary.items()
        ]
        return {
            "kind": KIND,
            "schema": SCHEMA,
            "mint_hub": self.mint_hub,
            "date": self.date,
            "benchmark": self.benchmark,
            "prediction": self.prediction,
            "trained_on": self.trained_on,
            "intervals": {"resamples": RESAMPLES, "seed": SEED, "level": 0.95, "over": "clips"},
            "rows": rows,
            "efficiency": self.efficiency,
            "warnings": list(self.warnings),
            "skipped": list(self.skipped),
            "clips": [clip.to_dict() for clip in self.clips],
        }

    def save(self, path: Path) -> Path:
        """Write the file, whole or not at all."""
        with replacing(path) as temporary:
            values = self.to_dict()
            clips = [
                json.dumps(c, ensure_ascii=False, allow_nan=False) for c in values.pop("clips")
            ]
            head = json.dumps(values, indent=1, ensure_ascii=False, allow_nan=False)
            head = head.removesuffix("\n}")
            lines = ",\n".join(clips)  # a clip a line, for there may be thousands
            temporary.write_text(f'{head},\n "clips": [\n{lines}\n ]\n}}\n', encoding="utf-8")
        return path

    @classmethod
    def load(cls, path: Path) -> "Results":
        """Read what ``save`` wrote; the summary is made again from the clips.

        Raises:
            ResultsError: no such file, or not one of ours.

        """
        try:
            values = json.loads(path.read_text(encoding="utf-8"))
        except FileNotFoundError:
            raise ResultsError(
                f"{path}: expected results of `mint-hub evaluate`, found no file"
            ) from None
        except ValueError as error:
            raise ResultsError(f"{path}: expected JSON, got {error}") from None
        if not isinstance(values, dict) or values.get("kind") != KIND:
            raise ResultsError(f"{path}: expected results of `mint-hub evaluate`, got other JSON")
        if values["schema"] != SCHEMA:
            raise ResultsError(f"{path}: schema: expected {SCHEMA}, got {values['schema']}")
        try:
            return cls(
                values["benchmark"],
                values["prediction"],
                tuple(ClipResult.from_dict(clip) for clip in values["clips"]),
                values["trained_on"],
                values["efficiency"],
                tuple(values["warnings"]),
                tuple(values["skipped"]),
                values["mint_hub"],
                values["date"],
            )
        except (KeyError, TypeError, ValueError) as error:
            raise ResultsError(
                f"{path}: expected schema {SCHEMA} whole, got {type(error).__name__}: {error}"
            ) from None


# --------------------------------------------------------------------------- summing up


def summarise(scores: Sequence[Score]) -> dict[str, Any]:
    """Numbers of one row over its clips, each with its interval."""
    draws = resamples(len(scores))
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
    fov = np.array([score.fov_error_deg for score in scores])
    found["fov_error_deg"] = _with_interval(fov, draws, np.nanmean)
    return found


def resamples(count: int) -> NDArray[np.int64]:
    """Clips drawn with replacement, (RESAMPLES, count), the same for equal counts."""
    rng = np.random.default_rng(SEED)
    return rng.integers(0, max(count, 1), (RESAMPLES if count > 1 else 0, count))


def pooled(parts: Sequence[Any], kind: Any, draws: NDArray[np.int64]) -> dict[str, Triple]:
    """Metrics of the sum of statistics, and their intervals over resampled clips."""
    value, drawn = totalled(parts, kind).metrics(), drawn_metrics(parts, kind, draws)
    return {name: (value[name], *percentiles(np.array([d[name] for d in drawn]))) for name in value}


def drawn_metrics(
    parts: Sequence[Any], kind: Any, draws: NDArray[np.int64]
) -> list[dict[str, float]]:
    """Metrics of the sum of statistics, for each draw of clips (N, clips)."""
    names = list(kind().to_dict())
    table = np.array([[part.to_dict()[name] for name in names] for part in parts], float)
    sums = table[draws].sum(axis=1) if len(draws) else np.zeros((0, len(names)))
    return [kind(**dict(zip(names, row, strict=True))).metrics() for row in sums.tolist()]


def totalled(parts: Sequence[Any], kind: Any) -> Any:
    """The sum of statistics of a kind."""
    total = kind()
    for part in parts:
        total = total + part
    return total


def camera_numbers(scores: Sequence[Score], draws: NDArray[np.int64]) -> dict[str, Any]:
    """Mean and median over sequences, without degenerate ones unless there are no others."""
    errors = [score.camera for score in scores]
    known = [e for e in errors if e is not None]
    lenient = all(e.degenerate for e in known)
    found: dict[str, Any] = {
        "sequences": len(known),
        "degenerate": sum(e.degenerate for e in known),
    }
    value = TrajectoryStatistics(tuple(known)).metrics(with_degenerate=lenient)
    rows = [e.values() if e is not None and (lenient or not e.degenerate) else None for e in errors]
    for measure in TRAJECTORY_MEASURES:
        column = np.array([np.nan if r is None else r[measure.name] for r in rows])
        for word, function in (("mean", np.nanmean), ("median", np.nanmedian)):
            interval = _with_interval(column, draws, function)[1:]
            found[f"{measure.name} {word}"] = (value[f"{measure.name} {word}"], *interval)
    return found


def percentiles(values: NDArray[np.float64]) -> tuple[float, float]:
    """The 95 % interval of what came out of resamples; NaN where most have no value."""
    known = values[np.isfinite(values)]
    if len(known) < max(1, len(values) // 2):
        return float("nan"), float("nan")
    low, high = np.percentile(known, [2.5, 97.5])
    return float(low), float(high)


def _with_interval(column: NDArray[np.float64], draws: NDArray[np.int64], function: Any) -> Triple:
    if not np.isfinite(column).any():
        return float("nan"), float("nan"), float("nan")
    value = float(function(column))
    if not len(draws):
        return value, float("nan"), float("nan")
    drawn = column[draws]
    known = np.isfinite(drawn).any(axis=1)
    return (value, *percentiles(np.asarray(function(drawn[known], axis=1))))


def efficiency_of(
    clips: Sequence[ClipResult], prediction: Mapping[str, Any]
) -> dict[str, Any] | None:
    """Speed and memory of the clips that were predicted in this run, without the first (warm-up).

    From decoded pictures to the fused episode. None where fewer than two were.
    """
    timed = [clip for clip in clips if clip.seconds is not None][1:]
    if not timed:
        return None
    frames, seconds = sum(c.frames for c in timed), sum(c.seconds or 0.0 for c in timed)
    settings = prediction.get("settings", {})
    return {
        "frames": frames,
        "seconds": seconds,
        "ms_a_frame": 1e3 * seconds / frames,
        "frames_a_second": frames / seconds,
        "peak_memory_bytes": max(c.peak_bytes or 0 for c in timed),
        "device": prediction.get("device"),
        "dtype": prediction.get("dtype"),
        **{name: settings.get(name) for name in ("window", "overlap", "batch_size", "smooth")},
    }
