"""What an evaluation found, as data: clip by clip, summed up, and as JSON.

The file (schema 1) holds

- ``benchmark``: title, source, clips, frames, notes, published (key of the paper's numbers, or
  null), hash of all clips' truth;
- ``prediction``: facts of the checkpoint or labels, or null where only trivial rows were asked for;
- ``rows``: for the prediction and each trivial row its numbers, each as [value, low, high] with the
  95 % interval of a bootstrap over recordings (nulls where fewer than two have the number; a clip
  that is no window of another is a recording):
  ``hands`` by reading of the camera (see `scoring`), ``camera`` as mean and median over clips,
  ``world`` by alignment, ``strata`` (value alone, and ``hands`` counted), ``fov_error_deg``;
- ``clips``: key, part_of (the recording that it is a window of, or null), frames, source, stamp of
  the truth, seconds and the statistics of every row, which add: from them everything above can be
  made again, and two files can be compared clip by clip;
- ``efficiency``, ``warnings``, ``skipped`` (clips without a prediction), ``mint_hub``, ``date``.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Final

from mint_hub.evaluation.bootstrap import RESAMPLES, SEED, Resamples
from mint_hub.evaluation.scoring import Score
from mint_hub.evaluation.summary import summarise
from mint_hub.geometry.metrics import none_for_nan
from mint_hub.loaders.atomic import replacing

SCHEMA: Final = 1
KIND: Final = "mint-hub evaluation"


class ResultsError(ValueError):
    """A file of results that is none, or of another kind than expected."""


@dataclass(frozen=True, eq=False)
class ClipResult:
    """The scores of one clip by row.

    Attributes:
        key: the clip's.
        frames: how many.
        source: data set that it comes from.
        stamp: of the truth and its hand, see `Clip.truth_stamp`.
        scores: by row.
        seconds: what the prediction took, where it was made now.
        peak_bytes: memory then.
        part_of: key of the recording that it is a window of.
        warm_up: whether it was the first that its process predicted.

    """

    key: str
    frames: int
    source: str
    stamp: str
    scores: dict[str, Score]
    seconds: float | None = None
    peak_bytes: int | None = None
    part_of: str | None = None
    warm_up: bool = False

    @property
    def recording(self) -> str:
        """What it is drawn together with by the bootstrap."""
        return self.part_of or self.key

    def to_dict(self) -> dict[str, Any]:
        """Return what JSON holds of it."""
        return {**self.__dict__, "scores": {k: v.to_dict() for k, v in self.scores.items()}}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "ClipResult":
        """Invert ``to_dict``; ValueError where the scores are no mapping."""
        if not isinstance(values["scores"], Mapping):
            raise ValueError(f"scores: expected them by row, got {values['scores']!r}")
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
        draws = Resamples.of([clip.recording for clip in self.clips])
        return {
            row: summarise([clip.scores[row] for clip in self.clips], draws) for row in self.rows
        }

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
            "intervals": {
                "resamples": RESAMPLES,
                "seed": SEED,
                "level": 0.95,
                "over": "recordings",
            },
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
        if values.get("schema") != SCHEMA:
            raise ResultsError(f"{path}: schema: expected {SCHEMA}, got {values.get('schema')}")
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
        except (AttributeError, KeyError, TypeError, ValueError) as error:
            raise ResultsError(
                f"{path}: expected schema {SCHEMA} whole, got {type(error).__name__}: {error}"
            ) from None


def efficiency_of(
    clips: Sequence[ClipResult], prediction: Mapping[str, Any], processes: int = 1
) -> dict[str, Any] | None:
    """Speed and memory of the clips that were predicted in this run, but each process's first.

    From decoded pictures to the fused episode, in each of the processes that run side by side and
    share the cores. None where there are no others.
    """
    timed = [clip for clip in clips if clip.seconds is not None and not clip.warm_up]
    if not timed:
        return None
    frames, seconds = sum(c.frames for c in timed), sum(c.seconds or 0.0 for c in timed)
    settings = prediction.get("settings", {})
    return {
        "frames": frames,
        "seconds": seconds,
        "ms_a_frame": 1e3 * seconds / frames,
        "frames_a_second": frames / seconds,
        "processes": processes,
        "peak_memory_bytes": max(c.peak_bytes or 0 for c in timed),
        "device": prediction.get("device"),
        "dtype": prediction.get("dtype"),
        **{name: settings.get(name) for name in ("window", "overlap", "batch_size", "smooth")},
    }
