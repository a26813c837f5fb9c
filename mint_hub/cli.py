"""The command line: parse, call one verb, say what happened.

Exit codes: 0 all done, 1 some video failed, 2 the call itself is wrong, 130 interrupted.
"""

import argparse
import json
import sys
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mint_hub import cli_corpus, cli_demo, cli_evaluate, cli_label, cli_synth, cli_train
from mint_hub._version import __version__

if TYPE_CHECKING:
    from mint_hub.inference.runner import MintRunner

RANDOM_WEIGHTS = (
    "RANDOM WEIGHTS: this network is untrained. Cameras and hands below are noise; this run only "
    "shows that the path from a video to results works"
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run `mint-hub`; returns the exit code."""
    parser = _parser()
    args = parser.parse_args(argv)
    if args.command is None:
        parser.print_help()
        return 2
    try:
        return args.verb(args)
    except KeyboardInterrupt:
        print("interrupted: run the same command again to go on", file=sys.stderr)
        return 130
    except (ValueError, OSError, ImportError, RuntimeError) as error:
        print(f"mint-hub {args.command}: {error}", file=sys.stderr)
        return 2


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="mint-hub",
        description="Egocentric video in, world-space camera and two-hand motion out.",
    )
    parser.add_argument("--version", action="version", version=f"mint-hub {__version__}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND")
    cli_demo.add_demo(commands)
    _add_predict(commands)
    _add_info(commands)
    _add_convert(commands)
    cli_corpus.add_verify(commands)
    cli_corpus.add_convert(commands)
    cli_corpus.add_pack(commands)
    cli_synth.add_synth(commands)
    cli_corpus.add_withdraw(commands)
    cli_label.add_label(commands)
    cli_train.add_train(commands)
    cli_evaluate.add_evaluate(commands)
    cli_evaluate.add_compare(commands)
    return parser


# --- predict --------------------------------------------------------------------------------------


def _add_predict(commands: Any) -> None:
    parser = commands.add_parser(
        "predict",
        help="videos to camera and hand motion, with overlay, plot and summary",
        description="Predict every video and write, into a folder each, episode.npz and beside it "
        "an overlay (.mp4), a plot (.png) and a summary (.html). Finished videos are skipped when "
        "run again.",
    )
    add = parser.add_argument
    add("videos", nargs="*", help="video files, folders or URLs")
    add("--sample", action="store_true", help="the clip that comes with mint-hub")
    add("-o", "--out", type=Path, required=True, help="folder for the results")
    weights = parser.add_mutually_exclusive_group()
    weights.add_argument(
        "--model",
        help="folder or hub repository of a MINT checkpoint (default: mint-tiny, which comes with "
        "mint-hub: for trying things, not for labelling)",
    )
    weights.add_argument(
        "--random-weights",
        action="store_true",
        help="an untrained small network, to try the path without a checkpoint (results are noise)",
    )
    add("--revision", help="revision of a hub repository")
    add("--device", help="one device, or several with commas: cuda:0,cuda:1 (default: best here)")
    add("--dtype", default="auto", help="auto, float32, bfloat16 or float16")
    add("--fps", default="30", help='rate to resample to, or "native" (default: 30)')
    add("--overlap", type=int, help="frames that windows share (default: a quarter, at most 8)")
    add("--window", type=int, help="frames in a window (default: the model's)")
    add("--batch-size", type=int, default=1, help="windows at once (default: 1)")
    add("--smooth", action="store_true", help="smooth the hands (Kalman filter and smoother)")
    add("--zooms", action="store_true", help="the lens zooms: a field of view of each frame's own")
    add("--presence-threshold", type=float, default=0.0, help="logit from which a hand is there")
    add("--camera", help="known lens: JSON text, or a .json file (K, or model and distortion)")
    add(
        "--camera-poses",
        help="known poses: .npy (T,4,4), or .npz (timestamps_s, T_camera_from_world)",
    )
    add("--mano", type=Path, help="folder with your MANO files (default: the licence-free hand)")
    add("--on-error", choices=("raise", "stop"), default="raise", help="damage inside a video")
    add("--no-overlay", action="store_true", help="do not draw the overlay video")
    add("--rerun", action="store_true", help="also write episode.rrd (needs mint-hub[viz])")
    add("--overwrite", action="store_true", help="do finished videos again")
    add("--quiet", action="store_true", help="no progress bars")
    parser.set_defaults(verb=_predict)


def _predict(args: argparse.Namespace) -> int:
    from mint_hub.assets import sample_clip
    from mint_hub.inference.batch import Outputs, failures_text, find_videos, predict_videos
    from mint_hub.inference.runner import RunSettings
    from mint_hub.view.scene import import_rerun

    if args.rerun:
        import_rerun()
    if not args.videos and not args.sample:
        raise ValueError("expected a video file, folder or URL, or --sample")
    videos = find_videos([*args.videos, *([sample_clip()] if args.sample else [])])
    settings = RunSettings(
        fps=None if args.fps == "native" else _number("--fps", args.fps),
        overlap=args.overlap,
        window=args.window,
        batch_size=args.batch_size,
        presence_threshold=args.presence_threshold,
        smooth=args.smooth,
        fixed_lens=not args.zooms,
        on_error=args.on_error,
    )
    options: dict[str, Any] = {}
    if args.camera is not None:
        options["camera"] = _read_camera(args.camera)
    if args.camera_poses is not None:
        options["camera_poses"] = _read_poses(args.camera_poses)
    if args.random_weights:
        options["warnings"] = [RANDOM_WEIGHTS]
        print(f"\n*** {RANDOM_WEIGHTS} ***\n", file=sys.stderr)
    if args.camera_poses is not None and len(videos) > 1:
        raise ValueError(f"--camera-poses: expected one video with one path, got {len(videos)}")
    if args.out.exists() and not args.out.is_dir():
        raise ValueError(f"-o {args.out}: expected a folder, got a file")
    runner = _runner(args)
    settings.resolved(runner.models[0].config.window)
    report = predict_videos(
        videos,
        args.out,
        runner,
        settings,
        outputs=Outputs(overlay=not args.no_overlay, rerun=args.rerun),
        overwrite=args.overwrite,
        progress=not args.quiet,
        say=print,
        **options,
    )
    print(
        f"{len(report.done)} done, {len(report.skipped)} finished before, "
        f"{len(report.failed)} failed; results in {args.out}"
    )
    if args.random_weights:
        print(f"*** {RANDOM_WEIGHTS} ***", file=sys.stderr)
    if report.failed:
        print(f"failed:\n{failures_text(report.failed)}", file=sys.stderr)
        return 1
    return 0


def _runner(args: argparse.Namespace) -> "MintRunner":
    import torch

    from mint_hub.geometry.hand_model import HandModel
    from mint_hub.inference.devices import available_device
    from mint_hub.inference.opening import open_model, runner_of
    from mint_hub.model.configuration_mint import MintConfig
    from mint_hub.model.loading_mint import cast_weights
    from mint_hub.model.modeling_mint import MintModel

    dtypes = {"auto", "float32", "bfloat16", "float16"}
    if args.dtype not in dtypes:
        raise ValueError(f"--dtype: expected one of {sorted(dtypes)}, got {args.dtype!r}")
    devices = args.device.split(",") if args.device else []
    for name in devices:
        available_device(name)
    if args.random_weights:
        torch.manual_seed(0)
        model = MintModel(MintConfig.tiny(name_or_path="random weights, seed 0"))
        if args.dtype != "auto":
            cast_weights(model, getattr(torch, args.dtype))
    else:
        model = open_model(args.model, args.dtype, args.revision)
    return runner_of(model, devices, HandModel.default(args.mano) if args.mano else None)


def _number(name: str, text: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"{name}: expected a number, got {text!r}") from None


def _read_camera(text: str) -> Any:
    source = Path(text)
    try:
        return json.loads(source.read_text() if text.endswith(".json") else text)
    except json.JSONDecodeError as error:
        raise ValueError(
            f"--camera: expected JSON (or a .json file), got {text!r}: {error}"
        ) from None
    except OSError as error:
        raise ValueError(
            f"--camera: {text}: expected a readable file, got: {error.strerror}"
        ) from None


def _read_poses(text: str) -> Any:
    import numpy as np

    try:
        values = np.load(text, allow_pickle=False)
        return values if isinstance(values, np.ndarray) else {k: values[k] for k in values.files}
    except (EOFError, ValueError, zipfile.BadZipFile):
        raise ValueError(
            f"--camera-poses: {text}: expected a .npy with (T, 4, 4), or a .npz with timestamps_s "
            "and T_camera_from_world"
        ) from None
    except OSError as error:
        raise ValueError(
            f"--camera-poses: {text}: expected a readable file, got: {error.strerror}"
        ) from None


# --- info -----------------------------------------------------------------------------------------


def _add_info(commands: Any) -> None:
    parser = commands.add_parser("info", help="versions, model, hand assets, devices")
    parser.add_argument("--model", help="also describe this checkpoint")
    parser.add_argument("--mano", type=Path, help="folder with your MANO files")
    parser.add_argument("--json", action="store_true", help="as JSON")
    parser.set_defaults(verb=_info)


def _info(args: argparse.Namespace) -> int:
    from mint_hub.inference.info import collect, describe

    facts = collect(args.model, args.mano)
    print(json.dumps(facts, indent=1) if args.json else describe(facts))
    return 0


# --- convert-checkpoint ---------------------------------------------------------------------------


def _add_convert(commands: Any) -> None:
    parser = commands.add_parser(
        "convert-checkpoint",
        help="the public release's weights, or LingBot-Map's, to a folder in our format",
    )
    parser.add_argument(
        "source", help="folder or hub repository with model.safetensors, or a .pt file"
    )
    parser.add_argument("out", type=Path, help="folder to write: config, weights, processor")
    parser.add_argument("--config", type=Path, help="folder or config.json of the network's sizes")
    parser.add_argument("--dtype", help="write as float32, bfloat16 or float16 (default: as it is)")
    parser.add_argument("--revision", help="revision of a hub repository")
    parser.set_defaults(verb=_convert)


def _convert(args: argparse.Namespace) -> int:
    from mint_hub.model.conversion_mint import convert_checkpoint

    for line in convert_checkpoint(
        args.source, args.out, config=args.config, dtype=args.dtype, revision=args.revision
    ):
        print(line)
    return 0


if __name__ == "__main__":
    sys.exit(main())
