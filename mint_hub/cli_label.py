"""The verb of the command line that labels videos: `mint-hub label`."""

import argparse
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mint_hub.labelling.label import LabelReport

DOCTOR = "doctor"


def add_label(commands: Any) -> None:
    """Add `mint-hub label`."""
    parser = commands.add_parser(
        "label",
        help="raw videos to corpus shards (EgoPipeline)",
        description="Label videos with the cascade and write verified shards; every hour that is "
        'not kept is accounted for. Interrupted, the same command goes on. "mint-hub label doctor" '
        "lists every backend: ready, or what it lacks and where to get it.",
    )
    add = parser.add_argument
    add("videos", nargs="+", help="video files or folders; or the word doctor")
    add("-o", "--out", type=Path, help="folder of the corpus")
    add("--source", default="user", help="config to write: user, ego4d, epic, ... (default: user)")
    add(
        "--backend",
        action="append",
        default=[],
        metavar="STAGE=NAME",
        help="who does a stage, e.g. camera=megasam (see doctor); may be repeated",
    )
    add(
        "--set",
        action="append",
        default=[],
        metavar="STAGE.SETTING=VALUE",
        help="a setting of a stage, as JSON or text; may be repeated",
    )
    add(
        "--scale",
        action="append",
        default=[],
        metavar="LENGTH",
        help="a known length, 0.42m:U1,V1-U2,V2@SECONDS, or a factor; may be repeated",
    )
    add("--lens", help="known lens: JSON text or a .json file; labels then refer to the pinhole")
    add("--annotations", type=Path, help="file of action annotations to join")
    add("--checkpoint", help="MINT checkpoint: it does intrinsics, camera and hands")
    add(
        "--ray",
        nargs="?",
        const="local",
        metavar="ADDRESS",
        help="spread over Ray: a cluster's address, or this machine (default: one process)",
    )
    add("--retry-failed", action="store_true", help="do again what failed with an error before")
    add("--keep-work", action="store_true", help="keep the stages' files of finished videos")
    add("--review", action="store_true", help="also write overlays and plots of every episode")
    add("--quiet", action="store_true", help="no progress bar")
    parser.set_defaults(verb=_label)


def _label(args: argparse.Namespace) -> int:
    if args.videos == [DOCTOR]:
        return _doctor(*_choices(args))
    if args.out is None:
        raise ValueError("-o, --out: expected the folder of the corpus to write")
    from mint_hub.inference.batch import find_videos
    from mint_hub.labelling.build import build_cascade
    from mint_hub.labelling.doctor import check_ready
    from mint_hub.labelling.label import FOLDER, label_videos
    from mint_hub.labelling.runner import InProcess

    chosen, settings = _choices(args)
    cascade = build_cascade(args.out / FOLDER / "work", chosen=chosen, settings=settings)
    if args.ray:
        from mint_hub.labelling.ray_runner import OnRay

        executor = OnRay(cascade, args.ray)
    else:
        check_ready(cascade.stages)
        executor = InProcess(cascade)
    report = label_videos(
        find_videos(args.videos),
        args.out,
        cascade,
        source=args.source,
        executor=executor,
        retry_failed=args.retry_failed,
        keep_work=args.keep_work,
        progress=not args.quiet,
        say=lambda line: print(line, file=sys.stderr),
    )
    print(report)
    if args.review:
        _review(report)
    if report.problems:
        print(report.problems)
    return 1 if report.failed or report.problems else 0


def _doctor(chosen: dict[str, str], settings: dict[str, dict[str, Any]]) -> int:
    from mint_hub.labelling.backends import backend_of, default_backend
    from mint_hub.labelling.doctor import doctor

    for stage, name in chosen.items():
        backend_of(stage, name)
    named = {
        f"{stage}={chosen.get(stage) or default_backend(stage)}": s for stage, s in settings.items()
    }
    for found in doctor(named):
        print(found)
    return 0


def _choices(args: argparse.Namespace) -> tuple[dict[str, str], dict[str, dict[str, Any]]]:
    """Backends by stage and settings by stage, from the command line."""
    chosen: dict[str, str] = {}
    for text in args.backend:
        stage, _, name = text.partition("=")
        if not (stage and name):
            raise ValueError(f"--backend: expected STAGE=NAME, got {text!r}")
        chosen[stage] = name
    settings: dict[str, dict[str, Any]] = {}
    for text in args.set:
        place, equals, value = text.partition("=")
        stage, _, name = place.partition(".")
        if not (stage and name and equals):
            raise ValueError(f"--set: expected STAGE.SETTING=VALUE, got {text!r}")
        settings.setdefault(stage, {})[name] = _json_or_text(value)
    if args.checkpoint:
        for stage in ("intrinsics", "camera", "hands"):
            chosen.setdefault(stage, "mint")
            if chosen[stage] == "mint":
                settings.setdefault(stage, {})["model"] = args.checkpoint
    if args.scale:
        settings.setdefault("scale", {})["known"] = args.scale
    if args.lens:
        lens = _lens(args.lens)
        settings.setdefault("undistort", {})["lens"] = lens
        if chosen.setdefault("intrinsics", "given") == "given":
            settings.setdefault("intrinsics", {})["lens"] = lens
    if args.annotations:
        if not args.annotations.exists():
            raise ValueError(f"--annotations: expected a file, found none at {args.annotations}")
        settings.setdefault("describe", {})["path"] = str(args.annotations)
    return chosen, settings


def _lens(given: str) -> dict[str, Any]:
    """Read a lens as JSON, and try it before any video is."""
    from mint_hub.geometry.lenses import lens_from

    path = Path(given)
    try:
        lens = json.loads(path.read_text() if path.suffix == ".json" else given)
        lens = lens if isinstance(lens, dict) else {"K": lens}
        lens_from(lens, lens.get("image_size_hw", (1000, 1000)))
    except OSError as error:
        raise ValueError(f"--lens: {path}: {error.strerror}") from None
    except json.JSONDecodeError as error:
        raise ValueError(f"--lens: expected JSON or a .json file, got {error}") from None
    except ValueError as error:
        raise ValueError(f"--lens: {error}") from None
    return lens


def _json_or_text(value: str) -> Any:
    try:
        return json.loads(value)
    except json.JSONDecodeError:
        return value


def _review(report: "LabelReport") -> None:
    from mint_hub.labelling.review import write_reviews

    for path in write_reviews(report.folder):
        print(f"review: {path}")
