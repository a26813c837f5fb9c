"""The verb that shows everything once: a clip, its prediction, and the truth."""

import argparse
import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mint_hub.evaluation.scoring import Score
    from mint_hub.loaders.schema import Episode

HANDS = ("FAcc", "MPJPE-p", "PA-MPJPE-p", "GO-p", "CT-p", "EPE-p", "Presence-BA")
CAMERA = ("RPE-T", "RPE-R", "RPE-T 1 s", "RPE-R 1 s", "ATE")
ROWS = ("mean hand", "last frame copied", "zero camera motion")
METRICS = "metrics.json"


def add_demo(commands: Any) -> None:
    """Add `mint-hub demo`."""
    parser = commands.add_parser(
        "demo",
        help="the embedded network on the embedded clip, beside its exact truth",
        description="Predict the clip that comes with mint-hub, by the network that comes with it, "
        "compare with the clip's exact truth, and write episode, overlay, plot, summary and "
        "metrics. Needs no network, GPU or download.",
    )
    add = parser.add_argument
    add("-o", "--out", type=Path, default=Path("out"), help="folder for the results (default: out)")
    add("--model", help="another checkpoint: folder or hub repository (default: the embedded one)")
    add("--quiet", action="store_true", help="no progress bars")
    parser.set_defaults(verb=_demo)


def _demo(args: argparse.Namespace) -> int:
    from mint_hub.assets import asset_path, sample_clip
    from mint_hub.geometry.additive_metrics import none_for_nan
    from mint_hub.inference.batch import Outputs, failures_text, find_videos, predict_videos
    from mint_hub.inference.opening import open_model, runner_of
    from mint_hub.inference.runner import RunSettings
    from mint_hub.loaders.atomic import replacing
    from mint_hub.loaders.schema import Episode

    if args.out.exists() and not args.out.is_dir():
        raise ValueError(f"-o {args.out}: expected a folder, got a file")
    runner = runner_of(open_model(args.model))
    videos = find_videos([sample_clip()])
    report = predict_videos(
        videos, args.out, runner, RunSettings(), outputs=Outputs(), progress=not args.quiet
    )
    if report.failed:
        print(f"failed:\n{failures_text(report.failed)}", file=sys.stderr)
        return 1
    (folder,) = [*report.done, *report.skipped]
    scores = _scores(Episode.load(folder / "episode.npz"), Episode.load(asset_path("sample.npz")))
    numbers = {row: _numbers(score) for row, score in scores.items()}
    with replacing(folder / METRICS) as temporary:
        temporary.write_text(json.dumps(none_for_nan(numbers), indent=1, allow_nan=False) + "\n")
    shown = "mint-tiny" if args.model is None else Path(args.model).name
    print(_table(shown, numbers))
    print("Beside the prediction: answers that need no network. A number is only good beside them.")
    for label, file in (
        ("overlay", "episode.mp4"),
        ("plot", "episode.png"),
        ("episode", "episode.npz"),
        ("summary, open it in a browser", "episode.html"),
        ("metrics", METRICS),
    ):
        print(f"{label}: {folder / file}")
    return 0


def _scores(predicted: "Episode", truth: "Episode") -> "dict[str, Score]":
    """Score the prediction and the trivial answers on one clip."""
    from mint_hub.evaluation.clips import Clip
    from mint_hub.evaluation.scoring import ClipScorer
    from mint_hub.evaluation.trivial import MeanHand, trivial_predictions

    hand = truth.default_hand_model()
    clip = Clip(truth.key, truth, truth.K[0], truth.image_size_hw, None, hand, "the embedded clip")
    scorer = ClipScorer(clip)
    found = {"prediction": scorer.score(predicted)}
    for row, episode in trivial_predictions(truth, MeanHand.load()).items():
        if row in ROWS:
            found[row] = scorer.score(episode, row)
    return found


def _numbers(score: "Score") -> dict[str, float]:
    """Metrics by name; only those that the row has."""
    from mint_hub.geometry.metrics import TrajectoryStatistics

    found: dict[str, float] = {}
    if "published" in score.hands:
        metrics = score.hands["published"].metrics()
        found |= {name: float(metrics[name]) for name in HANDS}
    if score.camera is not None:
        means = TrajectoryStatistics((score.camera,)).metrics(with_degenerate=True)
        found |= {name: float(means[f"{name} mean"]) for name in CAMERA}
    if score.fov_error_deg == score.fov_error_deg:
        found["fov"] = score.fov_error_deg
    return found


def _table(name: str, numbers: Mapping[str, Mapping[str, float]]) -> str:
    from mint_hub.geometry.metrics import measure_of, number

    rows = list(numbers)
    lines = [["", name, *rows[1:]]]
    for metric in (*HANDS, *CAMERA, "fov"):
        unit = "deg" if metric == "fov" else measure_of(metric).unit
        cells = [number(n[metric], unit) if metric in n else "-" for n in numbers.values()]
        lines.append([f"{metric} {unit}".strip(), *cells])
    wide = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return "\n".join(
        "  ".join(cell.ljust(size) for cell, size in zip(line, wide, strict=True)).rstrip()
        for line in lines
    )
