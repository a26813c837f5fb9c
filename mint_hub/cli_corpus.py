"""The verbs of the command line that work on the corpus: verify, convert, pack."""

import argparse
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mint_hub.loaders.schema import Episode


def add_verify(commands: Any) -> None:
    """Add `mint-hub verify`."""
    parser = commands.add_parser(
        "verify",
        help="check the files of a corpus against what was written",
        description="Check a corpus, a config or a split: every file that is missing, cut short, "
        "swapped, damaged or unfinished is named with the episodes lost in it. Exit code 1 if any.",
    )
    parser.add_argument("folder", type=Path, help="a corpus, one of its configs, or one split")
    parser.add_argument("--full", action="store_true", help="also compare checksums (reads it all)")
    parser.set_defaults(verb=_verify)


def _verify(args: argparse.Namespace) -> int:
    from mint_hub.loaders.integrity import verify

    report = verify(args.folder, "full" if args.full else "size")
    print(report)
    return 0 if report.ok else 1


def add_convert(commands: Any) -> None:
    """Add `mint-hub convert`."""
    parser = commands.add_parser(
        "convert",
        help="labels in other formats to corpus shards",
        description="Write FORMAT's labels as a config of a corpus: lerobot (LeRobot v3 roots, "
        "local or hf://), vitra (.npy annotations), hot3d (raw sequences). Interrupted, the same "
        "command goes on. Train and validation are told apart by participant, else by video.",
    )
    add = parser.add_argument
    add("format", choices=sorted(_READERS), help="what the sources are")
    add("sources", nargs="+", help="roots, files or folders")
    add("-o", "--out", type=Path, required=True, help="folder of the corpus")
    add("--config", required=True, help="name of the config to write, e.g. ego4d")
    add("--split", choices=("auto", "train", "validation"), default="auto", help="default: auto")
    add("--lossless", action="store_true", help="keep all 109 numbers of every hand as float32")
    add("--extra", action="store_true", help="keep exact times and presence scores")
    add("--mano", type=Path, help="folder with your MANO files (hot3d)")
    add("--num-procs", type=int, default=1, help="processes that encode (default: 1)")
    add("--quiet", action="store_true", help="no progress bar")
    parser.set_defaults(verb=_convert)


def _convert(args: argparse.Namespace) -> int:
    from mint_hub.loaders.card import write_card
    from mint_hub.loaders.shards import split_of, write_corpus

    read = _READERS[args.format]
    splits = ("train", "validation") if args.split == "auto" else (args.split,)
    if args.split == "auto" and next(read(args), None) is None:
        raise ValueError(f"{args.sources}: expected episodes, found none")
    for split in splits:

        def chosen(split: str = split) -> "Iterator[Episode]":
            for episode in read(args):
                if args.split != "auto" or _split(episode, split_of) == split:
                    yield episode

        # Reads up to the first that falls here: all of them only where none does.
        if args.split == "auto" and next(chosen(), None) is None:
            print(f"{args.config}/{split}: no episodes fall here")
            continue
        report = write_corpus(
            chosen,
            args.out,
            args.config,
            split,
            format="lossless" if args.lossless else "compact",
            extra=args.extra,
            num_procs=args.num_procs,
            progress=not args.quiet,
        )
        print(report)
    print(f"card: {write_card(args.out)}")
    return 0


def _split(episode: "Episode", split_of: Callable[..., str]) -> str:
    uid = episode.meta.get("uid") or episode.key
    return split_of(str(uid), episode.meta.get("participant"))


def _read_lerobot(args: argparse.Namespace) -> "Iterator[Episode]":
    from mint_hub.loaders.lerobot import from_lerobot

    for root in args.sources:
        yield from from_lerobot(root)


def _read_vitra(args: argparse.Namespace) -> "Iterator[Episode]":
    from mint_hub.loaders.vitra import from_vitra

    for path in args.sources:
        yield from_vitra(path)


def _read_hot3d(args: argparse.Namespace) -> "Iterator[Episode]":
    from mint_hub.loaders.hot3d import from_hot3d

    for folder in args.sources:
        yield from_hot3d(folder, mano_dir=args.mano)


def add_pack(commands: Any) -> None:
    """Add `mint-hub pack`."""
    parser = commands.add_parser(
        "pack",
        help="your own videos into shards, beside their labels",
        description="Write a config whose samples hold a short-GOP clip beside the labels, from "
        "videos that you have. Interrupted, the same command goes on.",
    )
    add = parser.add_argument
    add("corpus", help="folder or address of the corpus with the labels")
    add("--config", required=True, help="its config, e.g. ego4d")
    add("--split", default="train", help="its split (default: train)")
    add("--videos", type=Path, required=True, help="folder of the videos (or one video)")
    layouts = ("folder", "ego4d", "epic", "egodex")
    add("--layout", choices=layouts, default="folder", help="how the folder is laid out")
    add("-o", "--out", type=Path, required=True, help="folder of the corpus to write")
    add("--name", help="config to write (default: CONFIG-video)")
    add("--size", help="height x width of the clips, e.g. 224x224 (default: the episode's)")
    add("--skip-missing", action="store_true", help="leave out episodes whose video is missing")
    add("--num-procs", type=int, default=1, help="processes that encode (default: 1)")
    add("--quiet", action="store_true", help="no progress bar")
    parser.set_defaults(verb=_pack)


def _pack(args: argparse.Namespace) -> int:
    from mint_hub.loaders import resolvers
    from mint_hub.loaders.card import write_card
    from mint_hub.loaders.packing import Packer, pack_corpus
    from mint_hub.loaders.reader import CorpusReader

    layouts: dict[str, Any] = {
        "folder": Path,
        "ego4d": resolvers.Ego4DVideos,
        "epic": resolvers.EpicVideos,
        "egodex": resolvers.EgoDexVideos,
    }
    packer = Packer(layouts[args.layout](args.videos), size_hw=_size(args.size))
    report = pack_corpus(
        CorpusReader(args.corpus, args.config, args.split),
        packer,
        args.out,
        args.name or f"{args.config}-video",
        args.split,
        on_missing="skip" if args.skip_missing else "raise",
        num_procs=args.num_procs,
        progress=not args.quiet,
    )
    print(report.corpus)
    for key in report.missing:
        print(f"left out, no video: {key}")
    print(f"card: {write_card(args.out)}")
    return 1 if report.missing else 0


def _size(text: str | None) -> tuple[int, int] | None:
    if text is None:
        return None
    parts = text.split("x")
    if len(parts) != 2 or not all(part.isdigit() and int(part) for part in parts):
        raise ValueError(f"--size: expected height x width such as 224x224, got {text!r}")
    return int(parts[0]), int(parts[1])


_READERS: dict[str, Callable[[argparse.Namespace], "Iterator[Episode]"]] = {
    "hot3d": _read_hot3d,
    "lerobot": _read_lerobot,
    "vitra": _read_vitra,
}
