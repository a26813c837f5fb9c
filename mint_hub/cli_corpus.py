"""The verbs of the command line that work on the corpus: verify, convert, pack."""

import argparse
import json
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mint_hub.loaders.schema import Episode

Keep = Callable[[str, str | None], bool]


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
        description="Write FORMAT's labels as a config of a corpus: lerobot (LeRobot v3 roots, or "
        "folders of them, local or hf://), vitra (.npy annotations), hot3d (raw sequences). "
        "Interrupted at any moment, the same command goes on; what it finished is skipped. Train "
        "and validation are told apart by participant, else by video. Withdrawn videos stay out.",
    )
    add = parser.add_argument
    add("format", choices=sorted(_READERS), help="what the sources are")
    add("sources", nargs="+", help="roots, files or folders")
    add("-o", "--out", type=Path, required=True, help="folder of the corpus")
    add("--config", required=True, help="name of the config to write, e.g. ego4d")
    add("--split", choices=("auto", "train", "validation"), default="auto", help="default: auto")
    add("--lossless", action="store_true", help="keep all 109 numbers of every hand as float32")
    add("--extra", action="store_true", help="keep exact times and presence scores")
    add(
        "--on-error",
        choices=("raise", "skip"),
        default="raise",
        help="skip: leave out what cannot be read, name it at the end (lerobot: as it comes), exit "
        "code 1 (default: raise)",
    )
    add("--mano", type=Path, help="folder with your MANO files (hot3d)")
    add("--num-procs", type=int, default=1, help="processes that encode (default: 1)")
    add("--quiet", action="store_true", help="no progress bar")
    parser.set_defaults(verb=_convert)


def _convert(args: argparse.Namespace) -> int:
    from mint_hub.loaders.card import write_card
    from mint_hub.loaders.changelog import Changelog
    from mint_hub.loaders.shards import split_of, write_corpus

    read = _READERS[args.format]
    origin = _origin(args)
    withdrawn = Changelog.load(args.out)
    splits = ("train", "validation") if args.split == "auto" else (args.split,)
    args.skipped = {}
    if args.split == "auto" and next(iter(read(args, _anything)), None) is None:
        _tell_skipped(args)
        raise ValueError(f"{args.sources}: expected episodes, found none")
    for split in splits:

        def keep(uid: str, participant: str | None, split: str = split) -> bool:
            if withdrawn.has(uid):
                return False
            return args.split != "auto" or split_of(uid, participant) == split

        # Reads up to the first that falls here: all of them only where none does.
        if args.split == "auto" and next(iter(read(args, keep)), None) is None:
            print(f"{args.config}/{split}: no episodes fall here")
            continue
        if not _begin(args.out, args.config, split, origin):
            continue
        report = write_corpus(
            lambda keep=keep: read(args, keep),
            args.out,
            args.config,
            split,
            format="lossless" if args.lossless else "compact",
            extra=args.extra,
            num_procs=args.num_procs,
            progress=not args.quiet,
        )
        print(report)
    if args.format == "hot3d" and args.mano is None:
        _keep_hand_annotations(args)
    print(f"card: {_renew(args.out / 'README.md', lambda path: write_card(path.parent))}")
    _tell_skipped(args)
    return 1 if args.skipped else 0


def _tell_skipped(args: argparse.Namespace) -> None:
    if args.skipped:
        print(f"skipped {len(args.skipped)} of {len(args.sources)} sources:")
    for source, error in args.skipped.items():
        print(error if source in error else f"{source}: {error}")


def _origin(args: argparse.Namespace) -> dict[str, Any]:
    from mint_hub.loaders.conversion import INPUTS, inputs_stamp

    return {
        "verb": "convert",
        "sources": args.sources,
        INPUTS: inputs_stamp([*args.sources, *([args.mano] if args.mano else [])], args.out),
        **{name: getattr(args, name) for name in ("format", "split", "lossless", "extra")},
        "mano": args.mano is not None,
        **({"on_error": args.on_error} if args.on_error != "raise" else {}),
    }


def _begin(folder: Path, config: str, split: str, origin: dict[str, Any]) -> bool:
    from mint_hub.loaders.conversion import begin

    if begin(folder, config, split, origin):
        return True
    print(f"{config}/{split}: finished before, from the same inputs and arguments: skipped")
    return False


def _renew(path: Path, write: Callable[[Path], Path]) -> Path:
    """Write a file that appears whole or not at all, where an earlier try may have been killed."""
    from mint_hub.loaders.atomic import clear_left_over

    clear_left_over(path)
    return write(path)


def _anything(_uid: str, _participant: str | None) -> bool:
    return True


def _kept(episodes: "Iterable[Episode]", keep: Keep) -> "Iterator[Episode]":
    from mint_hub.loaders.participants import group_of

    return (episode for episode in episodes if keep(*group_of(episode.meta, episode.key)))


def _each(args: argparse.Namespace, read: "Callable[[str], Episode]") -> "Iterator[Episode]":
    """Read one source after the other; with ``--on-error skip`` note those that cannot be read."""
    for source in args.sources:
        try:
            episode = read(source)
        except (ValueError, FileNotFoundError) as error:
            if args.on_error == "raise":
                raise
            args.skipped[source] = str(error)
        else:
            yield episode


def _read_lerobot(args: argparse.Namespace, keep: Keep) -> Iterable[Any]:
    from mint_hub.loaders.lerobot import LeRobotSlices, lerobot_roots

    roots = [root for place in args.sources for root in lerobot_roots(place) or [place]]
    return LeRobotSlices(roots, keep, on_error=args.on_error)


def _read_vitra(args: argparse.Namespace, keep: Keep) -> "Iterable[Episode]":
    from mint_hub.loaders.vitra import from_vitra

    return _kept(_each(args, from_vitra), keep)


def _read_hot3d(args: argparse.Namespace, keep: Keep) -> "Iterable[Episode]":
    from mint_hub.loaders.hot3d import from_hot3d

    return _kept(_each(args, lambda folder: from_hot3d(folder, mano_dir=args.mano)), keep)


def _keep_hand_annotations(args: argparse.Namespace) -> None:
    """Write what HOT3D says of hands that cannot be read, for those who have MANO later."""
    from mint_hub.loaders.beside import keep_annotation
    from mint_hub.loaders.hot3d import hot3d_hands, hot3d_key

    for folder in args.sources:
        if folder in args.skipped:
            continue
        key = hot3d_key(folder)
        if (path := keep_annotation(args.out, hot3d_hands(folder), key)) is not None:
            print(f"hands need MANO (--mano); as annotated: {path}")


def add_withdraw(commands: Any) -> None:
    """Add `mint-hub withdraw`."""
    parser = commands.add_parser(
        "withdraw",
        help="take videos out of a corpus, for good",
        description="Take every episode of some videos out of every config of a corpus, and their "
        "labels beside the shards. Shards are written anew without them; tombstones in "
        "changelog.json and on the card keep them out.",
    )
    parser.add_argument("folder", type=Path, help="the corpus")
    parser.add_argument("uids", nargs="+", help="names of the videos (uid of their episodes)")
    parser.add_argument("--reason", required=True, help="why; it is published")
    parser.add_argument("--source", help="their data set, where two have a video of that name")
    parser.set_defaults(verb=_withdraw)


def _withdraw(args: argparse.Namespace) -> int:
    from mint_hub.loaders.withdraw import withdraw

    report = withdraw(args.folder, args.uids, args.reason, source=args.source)
    for place, count in report.episodes.items():
        gone = ", which is gone now" if place in report.removed_splits else ""
        print(f"{count} episodes out of {place}{gone}")
    for place in report.beside:
        print(f"removed {place}")
    if not report.episodes and not report.beside:
        print("withdrawn before: nothing changed")
    return 0


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
    add(
        "--layout",
        choices=layouts,
        default="folder",
        help="how the folder is laid out (default: folder, as the source of each episode publishes "
        "its videos, else UID.mp4)",
    )
    add("-o", "--out", type=Path, required=True, help="folder of the corpus to write")
    add("--name", help="config to write (default: CONFIG-video)")
    add("--size", help="height x width of the clips, e.g. 224x224 (default: the episode's)")
    add(
        "--lens",
        help="how the videos are distorted, for labels of undistorted pictures: JSON, or a file of "
        'it, such as {"model": "kannala_brandt", "K": [[...]], "distortion": [...]}, '
        "or {UID: lens, ...} (default: what the labels say)",
    )
    add("--ignore-lens", action="store_true", help="the videos are undistorted already")
    checks = ("duration", "size", "fps")
    add("--ignore", nargs="+", choices=checks, default=[], help="pack though this does not agree")
    add("--skip-missing", action="store_true", help="leave out episodes whose video is missing")
    add("--num-procs", type=int, default=1, help="processes that encode (default: 1)")
    add("--quiet", action="store_true", help="no progress bar")
    parser.set_defaults(verb=_pack)


def _pack(args: argparse.Namespace) -> int:
    from mint_hub.loaders import resolvers
    from mint_hub.loaders.attach import VideoMismatchError
    from mint_hub.loaders.card import write_card
    from mint_hub.loaders.packing import Packer, pack_corpus
    from mint_hub.loaders.reader import CorpusReader

    layouts: dict[str, Any] = {
        "folder": Path,
        "ego4d": resolvers.Ego4DVideos,
        "epic": resolvers.EpicVideos,
        "egodex": resolvers.EgoDexVideos,
    }
    lens = _lens(args)
    packer = Packer(layouts[args.layout](args.videos), _size(args.size), **lens)
    reader = CorpusReader(args.corpus, args.config, args.split)
    name = args.name or f"{args.config}-video"
    origin = {
        "verb": "pack",
        "sources": [args.corpus, str(args.videos)],
        "labels": reader.manifest.content,
        "videos": str(args.videos),
        **{option: getattr(args, option) for option in ("layout", "size", "skip_missing")},
        **({"lens": lens} if args.lens or args.ignore_lens or args.ignore else {}),
    }
    if _begin(args.out, name, args.split, origin):
        try:
            report = pack_corpus(
                reader,
                packer,
                args.out,
                name,
                args.split,
                on_missing="skip" if args.skip_missing else "raise",
                num_procs=args.num_procs,
                progress=not args.quiet,
            )
        except VideoMismatchError as error:
            if error.check is None:
                raise
            raise VideoMismatchError(f"{error.fact}; {_remedy(error.check)}") from error
        print(report.corpus)
    packed = CorpusReader(args.out, name, args.split)
    there = {packed.key(i) for i in range(len(packed))}
    missing = [key for key in map(reader.key, range(len(reader))) if key not in there]
    for key in missing:
        print(f"left out, no video: {key}")
    print(f"card: {_renew(args.out / 'README.md', lambda path: write_card(path.parent))}")
    return 1 if missing else 0


def _lens(args: argparse.Namespace) -> dict[str, Any]:
    """Return what a Packer takes for ``--lens``, ``--ignore-lens`` and ``--ignore``."""
    options: dict[str, Any] = {"ignore": sorted(args.ignore)}
    if args.lens is not None and args.ignore_lens:
        raise ValueError("--lens, --ignore-lens: expected one of them, got both")
    if args.ignore_lens:
        return {"options": {**options, "lens": None}}
    if args.lens is None:
        return {"options": options}
    inline = args.lens.lstrip()[:1] in ("{", "[")
    try:
        said: Any = json.loads(args.lens if inline else Path(args.lens).read_text("utf-8"))
    except ValueError as error:
        raise ValueError(f"--lens: expected JSON, got {args.lens!r}: {error}") from None
    if not said or not isinstance(said, dict | list):
        raise ValueError(f"--lens: expected a lens, or {{UID: lens, ...}}, got {said!r}")
    lenses: dict[str, Any] = said if isinstance(said, dict) else {}
    by_uid = bool(lenses) and not _OF_A_LENS & lenses.keys()
    if by_uid and all(isinstance(lens, dict | list) for lens in lenses.values()):
        return {"options": options, "lenses": lenses}
    return {"options": {**options, "lens": said}}


_OF_A_LENS = frozenset({"K", "params", "distortion", "image_size_hw"})
"""Entries of a lens that are lists; else a mapping of lists and mappings is one of uids."""


def _remedy(check: str) -> str:
    """Return the options that answer a check of ``VideoAttachment``."""
    if check == "lens":
        return "say how with --lens, or --ignore-lens if the videos are undistorted already"
    return f"if it is the right video nevertheless, --ignore {check}"


def _size(text: str | None) -> tuple[int, int] | None:
    if text is None:
        return None
    parts = text.split("x")
    if len(parts) != 2 or not all(part.isdigit() and int(part) for part in parts):
        raise ValueError(f"--size: expected height x width such as 224x224, got {text!r}")
    return int(parts[0]), int(parts[1])


_READERS: dict[str, Callable[[argparse.Namespace, Keep], Iterable[Any]]] = {
    "hot3d": _read_hot3d,
    "lerobot": _read_lerobot,
    "vitra": _read_vitra,
}
"""From arguments and a law of (uid, participant) to episodes, or to slices of them."""
