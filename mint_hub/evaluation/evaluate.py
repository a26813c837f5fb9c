"""The verb: a benchmark, a prediction or none, and in how many processes; out come results."""

import datetime
import hashlib
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from tqdm.auto import tqdm

from mint_hub._version import __version__
from mint_hub.evaluation.benchmarks import open_benchmark
from mint_hub.evaluation.clips import (
    Benchmark,
    BenchmarkError,
    Clip,
    MissingFilesError,
    Source,
)
from mint_hub.evaluation.predictor import OpenPredictor, Prediction, Predictor
from mint_hub.evaluation.results import ClipResult, Results, efficiency_of
from mint_hub.evaluation.scoring import ClipScorer, Score
from mint_hub.evaluation.trivial import MeanHand, trivial_predictions
from mint_hub.geometry.trajectory_metrics import DEGENERATE_PATH_M
from mint_hub.loaders.parallel import in_order
from mint_hub.view.canvas import plural

OnMissing = Literal["raise", "skip"]


@dataclass(frozen=True)
class _Scorer:
    """Scores clips by number; travels to other processes, where it opens its files once."""

    source: Source
    predictor: Predictor | None
    mean: MeanHand
    on_missing: OnMissing
    _open: dict[str, Any] = field(default_factory=dict[str, Any], repr=False)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_open": {}}

    def facts(self) -> dict[str, Any]:
        """What the results say of the prediction; opens it where this process has not."""
        assert self.predictor is not None
        return (self._open.get("predictor") or self.predictor.open()).facts

    def __call__(self, i: int) -> "ClipResult | str":
        """Return the scores of a clip, or the key of one that is skipped for want of labels."""
        if not self._open:
            self._open["benchmark"] = open_benchmark(self.source)
            self._open["predictor"] = self.predictor.open() if self.predictor else None
        benchmark: Benchmark = self._open["benchmark"]
        return self._scores(benchmark.clip(i), self._open["predictor"])

    def _scores(self, clip: Clip, predictor: OpenPredictor | None) -> "ClipResult | str":
        scores: dict[str, Score] = {}
        made: Prediction | None = None
        scorer = ClipScorer(clip, predictor.hand_model if predictor else None)
        if predictor is not None:
            try:
                made = predictor.predict(clip)
            except MissingFilesError:
                if self.on_missing == "skip":
                    return clip.key
                raise
            scores["prediction"] = scorer.score(made.episode)
        for row, episode in trivial_predictions(clip.truth, self.mean, scorer.seen()).items():
            scores[row] = scorer.score(episode, row)
        return ClipResult(
            key=clip.key,
            frames=clip.truth.num_frames,
            source=clip.source,
            stamp=clip.truth_stamp(),
            scores=scores,
            seconds=made.seconds if made else None,
            peak_bytes=made.peak_bytes if made else None,
            part_of=clip.part_of,
            warm_up=made.warm_up if made else False,
        )


def evaluate(
    source: Source,
    predictor: Predictor | None = None,
    *,
    mean: MeanHand | None = None,
    jobs: int = 1,
    on_missing: OnMissing = "raise",
    progress: bool = False,
) -> Results:
    """Score a prediction and the trivial rows on a benchmark.

    Args:
        source: the benchmark.
        predictor: what to score; None for the trivial rows alone.
        mean: of the training set; what comes with mint-hub without it.
        jobs: processes; results are the same for any number, a checkpoint's but for rounding.
        on_missing: of a clip without prediction: "raise", or "skip" it and tell.
        progress: show a bar of clips.

    Raises:
        BenchmarkError: the benchmark or a prediction cannot be used; names the file.
        ValueError: a prediction that does not fit its clip.

    """
    if jobs < 1:
        raise ValueError(f"jobs: expected at least 1, got {jobs}")
    benchmark = open_benchmark(source, jobs)
    mean = mean or MeanHand.load()
    scorer = _Scorer(source, predictor, mean, on_missing)
    numbers = tqdm(range(len(benchmark)), unit="clip", disable=None if progress else True)
    found = list(in_order(scorer, numbers, jobs, batch=1))
    clips = tuple(c for c in found if isinstance(c, ClipResult))
    skipped = tuple(c for c in found if isinstance(c, str))
    if not clips:
        raise BenchmarkError(f"{benchmark.title}: expected predictions of its clips, found none")
    facts = scorer.facts() if predictor is not None else None
    return Results(
        benchmark=_facts(benchmark, clips),
        prediction=facts,
        clips=clips,
        trained_on=mean.trained_on,
        efficiency=efficiency_of(clips, facts, jobs) if facts else None,
        warnings=tuple(_warnings(clips, skipped)),
        skipped=skipped,
        mint_hub=__version__,
        date=datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
    )


def _facts(benchmark: Benchmark, clips: tuple[ClipResult, ...]) -> dict[str, Any]:
    digest = hashlib.sha256("\n".join(f"{c.key} {c.stamp}" for c in clips).encode())
    source = benchmark.source
    return {
        "title": benchmark.title,
        "name": source.name,
        "folder": Path(source.root).name,
        "config": source.config,
        "split": source.split,
        "protocol": source.protocol if source.name == "arctic" else None,
        "clip_frames": source.clip_frames,
        "published": benchmark.published,
        "clips": len(clips),
        "frames": sum(clip.frames for clip in clips),
        "notes": list(benchmark.notes),
        "hash": digest.hexdigest()[:16],
    }


def _warnings(clips: tuple[ClipResult, ...], skipped: tuple[str, ...]) -> Iterable[str]:
    if skipped:
        count = plural(len(skipped), "clip")
        yield f"{count} without a prediction, which count nowhere, the first: {skipped[0]}"
    row = next(iter(clips[0].scores))
    scored = [clip.scores[row].hands.get("published") for clip in clips]
    seen = [hands for hands in scored if hands is not None]
    if not seen:
        yield "the truth has no hands that can be read: there are no hand numbers"
    elif not any(hands.pose_count for hands in seen):
        yield "no hand is on screen in any clip: pose numbers are empty"
    cameras = [
        clip.scores[row].camera or clip.scores["zero camera motion"].camera for clip in clips
    ]
    known = [camera for camera in cameras if camera is not None]
    still = sum(camera.true_path_m < DEGENERATE_PATH_M for camera in known)
    if still:
        yield f"{plural(still, 'clip')} whose camera does not move: reported, not ranked"
    stuck = sum(c.degenerate for c in known) - still
    if row == "prediction" and stuck:
        yield (
            f"{plural(stuck, 'clip')} whose predicted camera does not move though the true one "
            "does: left out of the camera's numbers, unless there are no others"
        )
