"""The verbs of the command line that measure: evaluate and compare."""

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mint_hub.evaluation.clips import Source
    from mint_hub.evaluation.predictor import Predictor
    from mint_hub.evaluation.results import Results

TRIVIAL = "trivial"


def add_evaluate(commands: Any) -> None:
    """Add `mint-hub evaluate`."""
    parser = commands.add_parser(
        "evaluate",
        help="a checkpoint, or labels, against truth: numbers, tables and one page",
        description="Score MODEL on a benchmark and write results.json, tables.md, figures and "
        "report.html (opens offline). Every table carries answers that need no model, and the "
        "paper's numbers are printed apart from ours.",
    )
    add = parser.add_argument
    add(
        "model",
        help="mint-tiny, folder or hub repository of a checkpoint; or a folder with labels: saved "
        f'episodes (KEY.npz, KEY/episode.npz), a corpus; or the word "{TRIVIAL}": the answers '
        "without a model alone",
    )
    _add_benchmark(parser)
    add("-o", "--out", type=Path, help="folder for the results (default: evaluation)")
    add("--name", help="what tables call it (default: the folder's name)")
    add("--skip-missing", action="store_true", help="leave out clips without labels, and tell")
    add("--mean-hand", type=Path, help="mean_hand.json of your training set, for trivial rows")
    _add_run(parser)
    parser.set_defaults(verb=_evaluate)


def add_compare(commands: Any) -> None:
    """Add `mint-hub compare`."""
    parser = commands.add_parser(
        "compare",
        help="two checkpoints, two label sets or two results, paired clip by clip",
        description="Which of two is better, number by number, with the interval of a paired "
        "bootstrap and Wilcoxon's test. A and B are results.json (or their folders), or, with "
        "--on, anything that `mint-hub evaluate` takes. Two label sets without --on: how far B is "
        "from A.",
    )
    parser.add_argument("a", help="results, checkpoint or labels")
    parser.add_argument("b", help="the same")
    _add_benchmark(parser, required=False)
    parser.add_argument("-o", "--out", type=Path, help="folder for comparison.json and .md")
    _add_run(parser)
    parser.set_defaults(verb=_compare, name=None, skip_missing=False, mean_hand=None)


def _add_benchmark(parser: argparse.ArgumentParser, required: bool = True) -> None:
    add = parser.add_argument
    add(
        "--on",
        nargs="+",
        required=required,
        metavar=("BENCHMARK", "ROOT"),
        help="bench, bench-ood (drawn once and kept), hot3d ROOT, arctic ROOT, shards DIR",
    )
    add("--config", help="config of shards, where there are several")
    add("--split", help="split (shards: validation, ARCTIC: val, HOT3D-Clips: all folders)")
    add("--protocol", choices=("p1", "p2"), default="p2", help="ARCTIC's (default: p2)")
    add("--stream", help="HOT3D's camera (default: 214-1 of Aria, 1201-1 of Quest 3)")
    add("--mano", help="folder with your MANO files: HOT3D's and ARCTIC's hands need them")
    add("--clip-frames", type=int, help="cut into clips of so many frames (paper: hands 81)")
    add("--limit", type=int, help="only so many clips, evenly spread")


def _add_run(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("--smooth", action="store_true", help="smooth a checkpoint's hands")
    add("--known-camera", action="store_true", help="tell a checkpoint the true intrinsics")
    add("--overlap", type=int, help="frames that windows share (default: a quarter, at most 8)")
    add("--window", type=int, help="frames in a window (default: the model's)")
    add("--batch-size", type=int, default=1, help="windows at once (default: 1)")
    add("--device", help="device of a checkpoint (default: best here)")
    add("--dtype", default="auto", help="auto, float32, bfloat16 or float16")
    add("--revision", help="revision of a hub repository")
    add("--cache", type=Path, help="where predictions and drawn clips are kept")
    add("--jobs", type=int, default=1, help="processes (default: 1)")
    add("--quiet", action="store_true", help="no progress bar")


def _evaluate(args: argparse.Namespace) -> int:
    from mint_hub.evaluation.evaluate import evaluate
    from mint_hub.evaluation.report import write_report
    from mint_hub.evaluation.tables import main_tables
    from mint_hub.evaluation.trivial import MeanHand

    source = _source(args)
    predictor = None if args.model == TRIVIAL else _predictor(args, args.model, args.name)
    mean = MeanHand.load(args.mean_hand) if args.mean_hand else MeanHand.load()
    results = evaluate(
        source,
        predictor,
        mean=mean,
        jobs=args.jobs,
        on_missing="skip" if args.skip_missing else "raise",
        progress=not args.quiet,
    )
    folder = args.out or Path("evaluation")
    path = write_report(results, folder, source, predictor, mean)
    for warning in results.warnings:
        print(f"warning: {warning}", file=sys.stderr)
    for table in main_tables(results):
        print(table.text())
    print(f"results, tables and report: {path}")
    return 0


def _compare(args: argparse.Namespace) -> int:
    from mint_hub.evaluation.bench_shards import is_corpus
    from mint_hub.evaluation.clips import Source
    from mint_hub.evaluation.compare import compare
    from mint_hub.evaluation.evaluate import evaluate
    from mint_hub.evaluation.tables import all_tables

    sides = [_results_file(what) for what in (args.a, args.b)]
    if not args.on and not any(sides):
        kind = "shards" if is_corpus(Path(args.a)) else "labels"
        source = Source(kind, args.a, config=args.config, split=args.split, mano_dir=args.mano)
        results = evaluate(source, _predictor(args, args.b, None), jobs=args.jobs)
        print(f"{args.b} scored as if {args.a} were true: agreement, not accuracy.\n")
        print("\n".join(table.text() for table in all_tables(results)))
        if args.out:
            print(f"written: {results.save(args.out / 'results.json')}")
        return 0
    comparison = compare(_loaded(args, args.a, sides[0]), _loaded(args, args.b, sides[1]))
    print(comparison.markdown())
    if args.out:
        from mint_hub.loaders.atomic import replacing

        comparison.save(args.out / "comparison.json")
        with replacing(args.out / "comparison.md") as temporary:
            temporary.write_text(comparison.markdown(), encoding="utf-8")
        print(f"written: {args.out / 'comparison.json'}")
    return 0


def _results_file(what: str) -> Path | None:
    """The results that a word means, if it means any."""
    path = Path(what).expanduser()
    if path.is_dir() and (path / "results.json").is_file():
        return path / "results.json"
    return path if path.suffix == ".json" else None


def _loaded(args: argparse.Namespace, what: str, file: Path | None) -> "Results":
    from mint_hub.evaluation.evaluate import evaluate
    from mint_hub.evaluation.results import Results

    if file is not None:
        return Results.load(file)
    if not args.on and not Path(what).expanduser().exists():
        raise ValueError(f"{what}: expected results.json, or a folder with it, found neither")
    if not args.on:
        raise ValueError(
            f"{what}: expected results.json there, or --on BENCHMARK to evaluate it on"
        )
    return evaluate(_source(args), _predictor(args, what, None), jobs=args.jobs)


def _source(args: argparse.Namespace) -> "Source":
    from mint_hub.evaluation.clips import NAMES, Source
    from mint_hub.loaders.remote import default_cache

    name, *rest = args.on
    known = [n for n in NAMES if n != "labels"]
    if name not in known:
        raise ValueError(f"--on: expected one of {known}, got {name!r}")
    drawn = name.startswith("bench")
    if drawn == bool(rest) or len(rest) > 1:
        wanted = "no folder" if drawn else "one folder"
        raise ValueError(f"--on {name}: expected {wanted} after it, got {rest or 'none'}")
    cache = args.cache or default_cache().parent / "evaluation"
    return Source(
        name,
        str(cache / "synthetic") if drawn else rest[0],
        config=args.config,
        split=args.split,
        protocol=args.protocol,
        stream=args.stream,
        mano_dir=args.mano,
        clip_frames=args.clip_frames,
        limit=args.limit,
    )


def _predictor(args: argparse.Namespace, what: str, name: str | None) -> "Predictor":
    from mint_hub.evaluation.predictor import Predictor
    from mint_hub.loaders.remote import default_cache

    predictor = Predictor.of(what, name, mano_dir=args.mano)
    if predictor.kind == "labels":
        for option in ("smooth", "known_camera"):
            if getattr(args, option):
                raise ValueError(
                    f"--{option.replace('_', '-')}: expected with a checkpoint, got labels, which "
                    "stay as is"
                )
        return predictor
    from dataclasses import replace

    from mint_hub.inference.runner import RunSettings

    settings = RunSettings(
        overlap=args.overlap,
        window=args.window,
        batch_size=args.batch_size,
        smooth=args.smooth,
    )
    cache = args.cache or default_cache().parent / "evaluation"
    return replace(
        predictor,
        settings=settings,
        known_camera=args.known_camera,
        device=args.device,
        dtype=args.dtype,
        revision=args.revision,
        cache_dir=str(cache),
    )
