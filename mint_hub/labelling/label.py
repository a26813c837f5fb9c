"""The verb: videos in, verified shards and an account of every hour out.

Below the corpus folder, ``labelling/`` holds the manifest, an account and the episodes of each
finished video (``videos/KEY/``), and the tasks' files of those under way (``work/``). Run again, a
finished video is not touched; shards are written anew only when there are other episodes.
"""

import hashlib
import json
import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final

from mint_hub.labelling.cascade import Cascade
from mint_hub.labelling.compose import episode_of
from mint_hub.labelling.manifest import NAME as MANIFEST
from mint_hub.labelling.manifest import Manifest, Row
from mint_hub.labelling.records import Lost, Video
from mint_hub.labelling.runner import Executor, InProcess, Run
from mint_hub.labelling.stage import lost_seconds
from mint_hub.loaders.atomic import replacing
from mint_hub.loaders.beside import ACCOUNT, LABELLING
from mint_hub.loaders.card import write_card
from mint_hub.loaders.changelog import Changelog
from mint_hub.loaders.integrity import verify
from mint_hub.loaders.manifest import read_manifest
from mint_hub.loaders.participants import group_of
from mint_hub.loaders.schema import Episode
from mint_hub.loaders.shards import CorpusReport, split_of, write_corpus
from mint_hub.loaders.unfinished import ShardSpec
from mint_hub.loaders.video import VideoError, probe

FOLDER: Final = LABELLING
ROUNDING_S: Final = 0.1
"""Container durations and frame times differ by this much without anything being lost."""


@dataclass
class LabelReport:
    """What became of the videos of a run.

    Attributes:
        folder: the corpus.
        hours_in, hours_kept: source time that came in, and that is in episodes.
        hours_lost: by reason; hours_in = hours_kept + all of these.
        num_episodes, num_frames: in the shards.
        stage_seconds: wall time by stage over all clips that were kept.
        done, skipped, rejected, failed: keys of videos (skipped: finished before).
        reasons: by key of a rejected or failed video, why.
        corpora: what was written, by split.
        problems: what verifying the shards found; empty when all is well.

    """

    folder: Path
    hours_in: float = 0.0
    hours_kept: float = 0.0
    hours_lost: dict[str, float] = field(default_factory=dict[str, float])
    num_episodes: int = 0
    num_frames: int = 0
    stage_seconds: dict[str, float] = field(default_factory=dict[str, float])
    done: list[str] = field(default_factory=list[str])
    skipped: list[str] = field(default_factory=list[str])
    rejected: list[str] = field(default_factory=list[str])
    failed: list[str] = field(default_factory=list[str])
    reasons: dict[str, str] = field(default_factory=dict[str, str])
    corpora: dict[str, CorpusReport] = field(default_factory=dict[str, CorpusReport])
    problems: str = ""

    def __str__(self) -> str:
        share = 100 * self.hours_kept / self.hours_in if self.hours_in else 0.0
        lines = [
            f"{self.hours_kept:.4f} of {self.hours_in:.4f} h kept ({share:.1f} %): "
            f"{self.num_episodes} episodes, {self.num_frames} frames"
        ]
        by_loss = sorted(self.hours_lost.items(), key=lambda item: -item[1])
        lines += [f"  lost {hours:.4f} h  {reason}" for reason, hours in by_loss]
        lines += [f"  {key}: {reason}" for key, reason in sorted(self.reasons.items())]
        return "\n".join(lines)


def open_video(key: str, path: Path, source: str, uid: str | None = None) -> Video:
    """Look into a video file.

    Raises:
        VideoError: it cannot be read.

    """
    info = probe(path)
    duration = info.duration_s or (info.num_frames or 0) / (info.fps or 30.0)
    return Video(
        key=key,
        uid=uid or path.stem,
        source=source,
        path=path.resolve(),
        duration_s=float(duration),
        fps=info.fps,
        image_size_hw=info.image_size_hw,
        start_s=info.start_time_s,
    )


def label_videos(
    videos: Mapping[str, str | Path],
    out: Path,
    cascade: Cascade,
    *,
    source: str = "user",
    executor: Executor | None = None,
    open_videos: int = 4,
    retry_failed: bool = False,
    keep_work: bool = False,
    progress: bool = False,
    say: Callable[[str], None] | None = None,
) -> LabelReport:
    """Label videos into the corpus ``out``, config ``source``.

    Args:
        videos: path by key.
        out: folder of the corpus; made if needed.
        cascade: the stages.
        source: the config, and what ``meta["source"]`` says.
        executor: who does the tasks (default: this process).
        open_videos: how many videos are under way at once.
        retry_failed: do again what failed with an error before.
        keep_work: keep the tasks' files of finished videos.
        progress: show bars.
        say: called with a line for each video.

    Raises:
        FullDiskError, NotReadyError: nothing can go on; the same call goes on later.
        CorpusError: the source is no name of a config.

    """
    ShardSpec(source, "train")
    say = say or (lambda _line: None)
    report = LabelReport(out)
    books = _Books(out / FOLDER, cascade, keep_work)
    executor = executor or InProcess(cascade)
    with Manifest(books.folder / MANIFEST) as manifest:
        todo: list[Video] = []
        for key, path in videos.items():
            try:
                video = open_video(key, Path(path), source)
            except (VideoError, OSError) as error:
                books.close_unreadable(key, Path(path), str(error))
                manifest.add(Row(key, "", "open", "failed", str(error)))
                say(f"{key}: failed: {error}")
                continue
            if books.finished(video, retry_failed):
                report.skipped.append(key)
                say(f"{key}: finished before, skipped")
            else:
                todo.append(video)

        def finish(video: Video) -> None:
            say(books.close(video))

        run = Run(
            cascade,
            executor,
            books.work,
            manifest,
            open_videos=open_videos,
            retry_failed=retry_failed,
            progress=progress,
            on_video=finish,
        )
        run(todo)
    books.add_up(list(videos), report)
    _write_shards(books, out, source, report, progress=progress)
    with replacing(books.folder / "report.json") as temporary:
        temporary.write_text(json.dumps(asdict(report), indent=1, default=str))
    return report


# ------------------------------------------------------------------------- accounts


class _Books:
    """Finished videos: their accounts and episodes."""

    def __init__(self, folder: Path, cascade: Cascade, keep_work: bool) -> None:
        self.folder = folder
        self.work = folder / "work"
        self._cascade = cascade
        self._keep_work = keep_work

    def place(self, key: str) -> Path:
        return self.folder / "videos" / key

    def account(self, key: str) -> dict[str, Any] | None:
        try:
            return json.loads((self.place(key) / ACCOUNT).read_text())
        except (OSError, json.JSONDecodeError):
            return None

    def finished(self, video: Video, retry_failed: bool) -> bool:
        known = self.account(video.key)
        if known is None or (retry_failed and known["failed"]):
            return False
        return known["fingerprint"] == self._fingerprint(video)

    def close(self, video: Video) -> str:
        """Write a video's episodes and, last, its account; return a line about it."""
        episodes, lost = _composed(video)
        place = self.place(video.key)
        shutil.rmtree(place, ignore_errors=True)
        for episode in episodes:
            (place / "episodes").mkdir(parents=True, exist_ok=True)
            episode.save(place / "episodes" / f"{episode.key}.npz")
        kept = [(e.timestamps_s[0], e.timestamps_s[0] + e.duration_s) for e in episodes]
        seconds = lost_seconds((video.start_s, video.stop_s), kept, lost)
        if seconds.get("unaccounted", 0.0) < ROUNDING_S:
            seconds.pop("unaccounted", None)
        failures = [item.reason for item in lost if item.failed]
        self._write(
            video.key,
            fingerprint=self._fingerprint(video),
            source=video.source,
            uid=video.uid,
            file=str(video.path),
            duration_s=video.duration_s,
            lost_s=seconds,
            failed=failures,
            reason="" if episodes else _main(seconds, failures),
            stage_s=_stage_seconds(video),
            episodes=[e.key for e in episodes],
        )
        if not self._keep_work and not failures:
            shutil.rmtree(self.work / video.key, ignore_errors=True)
        lost_s = sum(seconds.values())
        return (
            f"{video.key}: {len(episodes)} episodes, {video.duration_s - lost_s:.1f} of "
            f"{video.duration_s:.1f} s kept" + ("" if episodes else f": {_main(seconds, failures)}")
        )

    def close_unreadable(self, key: str, path: Path, reason: str) -> None:
        shutil.rmtree(self.place(key), ignore_errors=True)
        self._write(
            key,
            fingerprint="",
            source="",
            uid=path.stem,
            file=str(path),
            duration_s=0.0,
            lost_s={},
            failed=[reason],
            reason=reason,
            stage_s={},
            episodes=[],
        )

    def add_up(self, keys: Sequence[str], report: LabelReport) -> None:
        """Sum the accounts of the videos into the report."""
        for key in keys:
            account = self.account(key)
            assert account is not None
            report.hours_in += account["duration_s"] / 3600
            for reason, seconds in account["lost_s"].items():
                report.hours_lost[reason] = report.hours_lost.get(reason, 0.0) + seconds / 3600
            for stage, seconds in account["stage_s"].items():
                report.stage_seconds[stage] = report.stage_seconds.get(stage, 0.0) + seconds
            if account["reason"]:
                report.reasons[key] = account["reason"]
                (report.failed if account["failed"] else report.rejected).append(key)
            elif key not in report.skipped:
                report.done.append(key)
        report.hours_kept = report.hours_in - sum(report.hours_lost.values())

    def episode_files(self, source: str, withdrawn: Changelog) -> dict[str, list[Path]]:
        """By split, the files of all episodes of a source's finished videos, in order."""
        files: dict[str, list[Path]] = {}
        for path in sorted(self.folder.glob(f"videos/*/{ACCOUNT}")):
            account = json.loads(path.read_text())
            if account["source"] == source and not withdrawn.has(account["uid"], source):
                names = [path.parent / "episodes" / f"{key}.npz" for key in account["episodes"]]
                group = group_of(account, key=account["uid"])
                files.setdefault(split_of(*group), []).extend(names)
        return files

    def _fingerprint(self, video: Video) -> str:
        return self._cascade.fingerprint(video, len(self._cascade) - 1)

    def _write(self, key: str, **values: Any) -> None:
        self.place(key).mkdir(parents=True, exist_ok=True)
        with replacing(self.place(key) / ACCOUNT) as temporary:
            temporary.write_text(json.dumps(values, indent=1))


def _composed(video: Video) -> tuple[list[Episode], list[Lost]]:
    """Compose every clip; one that is no valid episode is lost with its reason."""
    episodes: list[Episode] = []
    lost = list(video.lost)
    for clip in video.clips:
        try:
            episodes.append(episode_of(clip, video))
        except (ValueError, RuntimeError) as error:
            lost.append(clip.lost("compose", str(error), failed=True))
    return episodes, lost


def _stage_seconds(video: Video) -> dict[str, float]:
    seconds: dict[str, float] = {}
    for report in (*video.reports, *(r for clip in video.clips for r in clip.reports)):
        seconds[report.stage] = round(seconds.get(report.stage, 0.0) + report.seconds, 4)
    return seconds


def _main(seconds: Mapping[str, float], failures: Sequence[str]) -> str:
    if failures:
        return failures[0]
    return max(seconds, key=lambda reason: seconds[reason]) if seconds else "nothing was kept"


# --------------------------------------------------------------------------- shards


class _Files:
    """Saved episodes as a list that is read on demand."""

    def __init__(self, paths: Sequence[Path]) -> None:
        self._paths = paths

    def __len__(self) -> int:
        return len(self._paths)

    def __getitem__(self, i: int, /) -> Episode:
        return Episode.load(self._paths[i])


def _write_shards(
    books: _Books, out: Path, config: str, report: LabelReport, *, progress: bool
) -> None:
    """Write the splits whose episodes changed, the card, and verify all of it."""
    by_split = books.episode_files(config, Changelog.load(out))
    for split, paths in by_split.items():
        if not paths:
            continue
        content = _content(paths)
        stamp = books.folder / f"{config}-{split}.json"
        final = out / config / split
        if not (final.exists() and _read(stamp) == content):
            shutil.rmtree(final, ignore_errors=True)
            if _read(stamp) != content:
                shutil.rmtree(final.with_name(f".{split}.partial"), ignore_errors=True)
                with replacing(stamp) as temporary:
                    temporary.write_text(content)
            report.corpora[split] = write_corpus(
                _Files(paths), out, config, split, extra=True, progress=progress
            )
        report.num_episodes += len(paths)
        report.num_frames += read_manifest(final).num_frames
    if any(by_split.values()):
        write_card(out)
        checked = verify(out, "full")
        report.problems = "" if checked.ok else str(checked)


def _content(paths: Sequence[Path]) -> str:
    digest = hashlib.sha256()
    for path in paths:
        digest.update(path.name.encode() + hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()


def _read(path: Path) -> str | None:
    return path.read_text() if path.is_file() else None
