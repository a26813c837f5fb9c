"""Many videos to a folder of results: resumable, one bad video never stops the others.

Each video gets a folder named by its key, with ``episode.npz`` and, beside it, the overlay
``episode.mp4``, the plot ``episode.png`` and the page ``episode.html``. Last of all comes
``done.json``: a video is finished when that file is there and says the same source, model and
settings. Failures are collected and returned.
"""

import hashlib
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from tqdm.auto import tqdm

from mint_hub._version import __version__
from mint_hub.inference.runner import MintRunner, RunSettings, frame_bar
from mint_hub.inference.video_input import key_from_name
from mint_hub.loaders.atomic import replacing
from mint_hub.loaders.schema import Episode
from mint_hub.loaders.video import OnError
from mint_hub.view.overlay import write_overlay
from mint_hub.view.plots import write_trajectory_plot
from mint_hub.view.scene import write_rrd
from mint_hub.view.summary import write_index, write_summary

VIDEO_SUFFIXES = frozenset(
    {".mp4", ".mov", ".mkv", ".webm", ".avi", ".m4v", ".mpg", ".mpeg", ".ts"}
)
DONE = "done.json"


@dataclass(frozen=True)
class Outputs:
    """Which files to write beside the episode.

    Attributes:
        overlay: skeletons over the frames, ``episode.mp4``.
        plots: world trajectories, ``episode.png``, and the one-page summary ``episode.html``.
        rerun: an interactive scene, ``episode.rrd`` (needs the extra ``viz``).

    """

    overlay: bool = True
    plots: bool = True
    rerun: bool = False


@dataclass
class BatchReport:
    """What became of each video.

    Attributes:
        done: folders written in this run.
        skipped: folders that were finished before.
        failed: (video, error) pairs.

    """

    done: list[Path] = field(default_factory=list[Path])
    skipped: list[Path] = field(default_factory=list[Path])
    failed: list[tuple[str, str]] = field(default_factory=list[tuple[str, str]])


def find_videos(inputs: Iterable[str | Path]) -> dict[str, str]:
    """Videos by key: files and URLs as given, folders searched for video files, in order.

    Hidden files and the results of earlier runs (videos beside a ``done.json``) are not taken from
    a folder. Keys come from names (paths below the folder for a folder); where several videos of
    one call have the same name, each key gets the start of a hash of its path.

    Raises:
        ValueError: a folder without videos, or nothing at all.

    """
    named: list[tuple[str, str]] = []
    for item in map(str, inputs):
        folder = Path(item)
        if not folder.is_dir():
            named.append((key_from_name(item), item))
            continue
        files = sorted(p for p in folder.rglob("*") if _is_input(p.relative_to(folder), folder))
        if not files:
            raise ValueError(
                f"{folder}: expected a folder with videos ({', '.join(sorted(VIDEO_SUFFIXES))}), "
                "found none"
            )
        named += [
            ("_".join(map(key_from_name, p.relative_to(folder).parts)), str(p)) for p in files
        ]
    if not named:
        raise ValueError("videos: expected at least one file, folder or URL, got none")
    unique = {_same_place(path): (key, path) for key, path in reversed(named)}
    unique = list(reversed(unique.values()))
    counts: dict[str, int] = {}
    for key, _ in unique:
        counts[key] = counts.get(key, 0) + 1
    return {
        key if counts[key] == 1 else f"{key}-{hashlib.sha256(path.encode()).hexdigest()[:8]}": path
        for key, path in unique
    }


def _is_input(below: Path, folder: Path) -> bool:
    path = folder / below
    return (
        below.suffix.lower() in VIDEO_SUFFIXES
        and not any(part.startswith(".") for part in below.parts)
        and path.is_file()
        and not (path.parent / DONE).exists()
    )


def _same_place(path: str) -> str:
    return path if "://" in path else str(Path(path).resolve())


def predict_videos(
    videos: dict[str, str],
    folder: Path,
    runner: MintRunner,
    settings: RunSettings,
    *,
    outputs: Outputs | None = None,
    overwrite: bool = False,
    progress: bool = True,
    say: Callable[[str], None] | None = None,
    **options: Any,
) -> BatchReport:
    """Predict every video and write its results below ``folder``.

    Args:
        videos: path or URL by key (see `find_videos`).
        folder: where results go; made if needed.
        runner: the model.
        settings: how to run it.
        outputs: which files to write.
        overwrite: do finished videos again.
        progress: show bars on standard error.
        say: called with a line for each video.
        options: `camera`, `camera_poses`, `warnings` for `MintRunner.run`.

    Returns:
        BatchReport: what was done, skipped, and failed. An interruption (KeyboardInterrupt) is
        raised through; what was finished stays finished.

    """
    outputs = outputs or Outputs()
    say = say or (lambda _: None)
    report = BatchReport()
    folder.mkdir(parents=True, exist_ok=True)
    hidden = None if progress and len(videos) > 1 else True  # None: hidden unless on a terminal
    bar = tqdm(videos.items(), unit="video", disable=hidden)
    for key, path in bar:
        target = folder / key
        wanted = _fingerprint(path, runner, settings, outputs, options)
        if not overwrite and _finished(target, wanted):
            report.skipped.append(target)
            say(f"{key}: finished before, skipped")
            continue
        try:
            episode = runner.run(path, settings, key=key, progress=progress, **options)
            _write(episode, path, target, runner, outputs, settings.on_error, progress)
            _mark_done(target, wanted)
        except Exception as error:  # whatever one video does, the others go on
            known = isinstance(error, ValueError | OSError | RuntimeError | ImportError)
            message = str(error) if known else f"{type(error).__name__}: {error}"
            report.failed.append((path, message))
            say(f"{key}: failed: {message}")
            continue
        report.done.append(target)
        say(f"{episode!r} -> {target}")
    if outputs.plots and (report.done or report.skipped):
        write_index(folder)
    return report


def _write(
    episode: Episode,
    video: str,
    target: Path,
    runner: MintRunner,
    outputs: Outputs,
    on_error: OnError,
    progress: bool,
) -> None:
    target.mkdir(parents=True, exist_ok=True)
    (target / DONE).unlink(missing_ok=True)
    episode.save(target / "episode.npz")
    overlay = None
    if outputs.overlay:
        with frame_bar(episode.num_frames, "overlay", progress) as bar:
            overlay = write_overlay(
                episode,
                video,
                target / "episode.mp4",
                hand_model=runner.hand_model,
                progress=lambda _done, _total: bar.update(),
                on_error=on_error,
            )
    if outputs.rerun:
        local = video if Path(video).is_file() else None
        write_rrd(episode, target / "episode.rrd", video=local, hand_model=runner.hand_model)
    if outputs.plots:
        write_trajectory_plot(episode, target / "episode.png")
        write_summary(
            episode,
            target / "episode.html",
            video=video,
            overlay=overlay,
            hand_model=runner.hand_model,
        )


def _fingerprint(
    path: str,
    runner: MintRunner,
    settings: RunSettings,
    outputs: Outputs,
    options: dict[str, Any],
) -> dict[str, Any]:
    """What a result depends on, as plain JSON; unequal means it has to be made again."""
    file = Path(path)
    stat = file.stat() if file.is_file() else None
    config = runner.models[0].config
    wanted = {
        "source": path if stat is None else str(file.resolve()),
        "bytes": None if stat is None else stat.st_size,
        "modified_ns": None if stat is None else stat.st_mtime_ns,
        "model": str(config._name_or_path),  # pyright: ignore
        "weights": _weights_stamp(str(config._name_or_path)),  # pyright: ignore
        "revision": getattr(config, "_commit_hash", None),
        "dtype": str(runner.models[0].dtype),
        "hand_model": runner.hand_model.name,
        "mint_hub": __version__,
        "settings": asdict(settings) | {"batch_size": None},  # how many at once changes nothing
        "outputs": asdict(outputs),
        "options": {k: _stamp(v) for k, v in sorted(options.items())},
    }
    return json.loads(json.dumps(wanted))


def _stamp(value: Any) -> Any:
    """A value as JSON; arrays by the hash of their content."""
    if isinstance(value, Mapping):
        items: Mapping[Any, Any] = value  # pyright: ignore[reportUnknownVariableType]
        return {str(k): _stamp(v) for k, v in items.items()}
    if isinstance(value, np.ndarray):
        digest = hashlib.sha256(np.ascontiguousarray(value).tobytes()).hexdigest()
        return [list(value.shape), str(value.dtype), digest]
    return repr(value)


def _weights_stamp(model: str) -> list[tuple[str, int, int]]:
    """Names, sizes and times of a local checkpoint's files; a hub's revision says it otherwise."""
    files = sorted(Path(model).glob("*.safetensors")) if model and Path(model).is_dir() else []
    return [(f.name, f.stat().st_size, f.stat().st_mtime_ns) for f in files]


def _finished(target: Path, wanted: dict[str, Any]) -> bool:
    try:
        return json.loads((target / DONE).read_text()) == wanted
    except (OSError, json.JSONDecodeError):
        return False


def _mark_done(target: Path, wanted: dict[str, Any]) -> None:
    with replacing(target / DONE) as temporary:
        temporary.write_text(json.dumps(wanted, indent=1))


def failures_text(failed: Sequence[tuple[str, str]]) -> str:
    """The failures of a run, a line each."""
    return "\n".join(f"  {video}: {error}" for video, error in failed)
