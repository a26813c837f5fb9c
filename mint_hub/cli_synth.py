"""The verb of the command line that makes synthetic clips."""

import argparse
from pathlib import Path
from typing import Any

PRESETS = ("train", "train-lively", "bench", "bench-ood")


def add_synth(commands: Any) -> None:
    """Add `mint-hub synth`."""
    parser = commands.add_parser(
        "synth",
        help="synthetic egocentric clips with exact labels, as corpus shards",
        description="Make clips of two hands that work at a table, seen from the head: H.264 "
        "beside exact camera, hands and presence, as a config of a corpus. Interrupted, the same "
        "command goes on. Needs mint-hub[synth].",
    )
    add = parser.add_argument
    add("--episodes", type=int, help="how many clips (default: all of a bench)")
    add("--seed", type=int, default=0, help="of the run; benches ignore it (default: 0)")
    add("--preset", choices=PRESETS, default="train", help="default: train")
    add("-o", "--out", type=Path, required=True, help="folder of the corpus to write")
    add("--config", help="name of the config (default: synth-PRESET)")
    add("--split", choices=("train", "validation"), help="default: train; of benches: validation")
    add("--frames", type=int, help="frames of every clip (default: 150 to 240, drawn)")
    add(
        "--pieces",
        type=int,
        default=0,
        help="instead of whole clips, so many pieces of --frames frames of each, spread over it: "
        "more rooms and people for the frames drawn; train only",
    )
    add("--samples", type=int, default=4, help="a pixel: 0, 2 or 4; 0 is a third faster")
    add("--scale", type=float, default=1.0, help="factor on the size of pictures (default: 1)")
    add(
        "--lens",
        type=float,
        default=0.0,
        metavar="SHARE",
        help="share of clips, 0 to 1, whose pictures are bent by a lens; labels stay those of the "
        "pinhole that rectifying with meta synth.lens gives, as training does; train only "
        "(default: 0)",
    )
    add("--depth", action="store_true", help="also store depth")
    add("--segmentation", action="store_true", help="also store segments")
    add("--jobs", type=int, default=1, help="processes that make clips (default: 1)")
    add("--quiet", action="store_true", help="no progress bar")
    parser.set_defaults(verb=_synth)


def _synth(args: argparse.Namespace) -> int:
    from mint_hub.loaders.card import write_card
    from mint_hub.synth.corpus import synthesise

    if args.jobs < 1:
        raise ValueError(f"--jobs: expected at least 1, got {args.jobs}")
    if args.episodes is None and args.preset.startswith("train"):
        raise ValueError(f"--episodes: expected how many clips of {args.preset}, got none")
    if args.out.exists() and not args.out.is_dir():
        raise ValueError(f"-o {args.out}: expected a folder, got a file")
    report = synthesise(
        args.out,
        args.preset,
        args.episodes,
        args.seed,
        config=args.config,
        split=args.split,
        num_frames=args.frames,
        pieces=args.pieces,
        scale=args.scale,
        samples=args.samples,
        lens=args.lens,
        depth=args.depth,
        segmentation=args.segmentation,
        num_procs=args.jobs,
        progress=not args.quiet,
    )
    print(report)
    print(f"card: {write_card(args.out)}")
    return 0
