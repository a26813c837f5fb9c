"""Stage "describe": text on what the hands do, from annotations or from a model of the user's."""

import hashlib
import importlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final, Literal, Protocol, cast

import numpy as np
from numpy.typing import NDArray

from mint_hub.geometry.arrays import runs
from mint_hub.labelling.records import Clip, Lost, StageReport, Video
from mint_hub.labelling.stage import (
    LOCAL,
    NotReadyError,
    Outcome,
    Resources,
    StageError,
    report_of,
    reported,
)
from mint_hub.labelling.stages.annotations import FORMATS, POINT_S, Described, Who, described
from mint_hub.loaders.clips import clip_size
from mint_hub.loaders.fields import TextSegment
from mint_hub.loaders.video_reader import VideoReader

Cut = Literal["none", "segments"]
CUTS: Final = ("none", "segments")
NO_TEXT: Final = "no text"

_SLACK_S: Final = 1e-6


class Describe:
    """Joins annotations to clips by the source video's uid and time, and may cut clips by them."""

    stage, backend, version = "describe", "annotations", "1"
    needs, gives = (), ("text",)
    resources = Resources(cpus=1)

    @dataclass(frozen=True)
    class Settings:
        """Where annotations are, and what they do.

        Attributes:
            path: the file (`annotations.described`); "" is none, of EgoDex those beside the videos.
            format: one of `annotations.FORMATS`.
            cut: "none" leaves clips as they are; "segments" makes a clip of every segment, of
                segments that overlap one together, and drops what has no text.
            point_s: longest stretch that a narration of a moment is about, seconds.
            content: hash of the file, found by `Describe`: with another content, results differ.

        """

        path: str = field(default="", metadata=LOCAL)
        format: str = "auto"
        cut: Cut = "none"
        point_s: float = POINT_S
        content: str = ""

    def __init__(self, settings: Settings | None = None) -> None:
        """Raise ValueError for an unknown format or cut."""
        self.settings = settings or self.Settings()
        if self.settings.format not in FORMATS:
            raise ValueError(
                f"format: expected one of {', '.join(FORMATS)}, got {self.settings.format!r}"
            )
        _check_cut(self.settings.cut)
        if Path(self.settings.path).is_file():
            digest = hashlib.sha256(Path(self.settings.path).read_bytes()).hexdigest()
            self.settings = replace(self.settings, content=digest[:16])

    def run_video(self, video: Video) -> Video:
        """Give clips their text.

        Raises:
            NotReadyError, ValueError: as of `annotations.described`.

        """
        s = self.settings
        said = [
            replace(item, start_s=item.start_s + video.start_s, stop_s=item.stop_s + video.start_s)
            for item in described(video, s.path, s.format, s.point_s)
        ]
        kept: list[Clip] = []
        lost: list[Lost] = []
        for clip in video.clips:
            outcome = told(clip, said, s.cut, report_of(self, file=Path(s.path).name))
            kept += outcome.clips
            lost += outcome.lost
        report = report_of(self, file=Path(s.path).name, segments=len(said), clips=len(kept))
        return replace(
            video,
            clips=tuple(kept),
            lost=(*video.lost, *lost),
            reports=(*video.reports, report),
        )

    def close(self) -> None:
        """Nothing to end."""


class Describer(Protocol):
    """A vision-language model, or anything else that looks at pictures and says what happens."""

    def __call__(
        self, pictures: NDArray[np.uint8], times_s: NDArray[np.float64]
    ) -> Sequence[Mapping[str, Any]]:
        """Describe pictures (N, H, W, 3) RGB, taken at times (N,), seconds of the source video.

        Returns:
            One mapping a segment: ``start_s``, ``stop_s`` (seconds of the source video), ``text``,
            and if known ``side`` ("left", "right", "both").

        """
        ...


class DescribeWithModel:
    """Asks a function of the user's; off unless it is chosen.

    Pictures come from the source video, so that joined clips have theirs too.
    """

    stage, backend, version = "describe", "vlm", "1"
    needs, gives = (), ("text",)
    resources = Resources(cpus=1)

    @dataclass(frozen=True)
    class Settings:
        """Whom to ask, and what to show.

        Attributes:
            describer: a `Describer` as "package.module:name"; made by the user.
            pictures: how many pictures of a clip it sees, evenly spread.
            height: their shorter side, pixels; never more than the video has.
            cut: as of `Describe.Settings`.

        """

        describer: str = ""
        pictures: int = 8
        height: int = 384
        cut: Cut = "none"

    def __init__(self, settings: Settings | None = None) -> None:
        """Raise ValueError for settings out of range."""
        self.settings = settings or self.Settings()
        s = self.settings
        if s.describer and s.describer.count(":") != 1:
            raise ValueError(f"describer: expected package.module:name, got {s.describer!r}")
        if s.pictures < 1 or s.height < 2:
            raise ValueError(f"pictures, height: expected some, got {s.pictures} and {s.height}")
        _check_cut(s.cut)
        self._describer: Describer | None = None

    def run_clip(self, clip: Clip, video: Video) -> Outcome:
        """Ask about one clip.

        Raises:
            NotReadyError: there is no such function.
            StageError: its answer is no list of segments.
            VideoError: the source video cannot be read.

        """
        s = self.settings
        if self._describer is None:
            self._describer = _load(s.describer)
        count = min(s.pictures, clip.num_frames)
        frames = np.linspace(0, clip.num_frames - 1, count).round().astype(np.int64)
        times = clip.source_timestamps_s[frames]
        with VideoReader(video.path) as reader:
            native = reader.info.image_size_hw
            size_hw = clip_size(s.height if s.height < min(native) else None, native)
            pictures = reader.at(times, size_hw).images
        answer = self._describer(pictures, times)
        said = [_checked(item, f"{clip.key}-{i}", s) for i, item in enumerate(answer)]
        return told(clip, said, s.cut, report_of(self, pictures=count))

    def close(self) -> None:
        """Forget the function."""
        self._describer = None


def told(clip: Clip, said: Sequence[Described], cut: Cut, report: StageReport) -> Outcome:
    """Give a clip its text, or cut it into clips that have one.

    A segment is about the frames with start_s <= source time < stop_s, and about one at least.

    Args:
        clip: its source times decide.
        said: in seconds of the source video.
        cut: as of `Describe.Settings`.
        report: of the stage; each clip's gets the provenance of its ``segments``.

    """
    pairs = [(item, text) for item in said if (text := _text(item, clip)) is not None]
    pairs.sort(key=lambda pair: (pair[1].start, pair[1].end, pair[1].id))
    texts = tuple(text for _, text in pairs)
    whole = reported(clip, _with_origins(report, [item for item, _ in pairs]), text=texts)
    if cut == "none":
        return Outcome((whole,))
    groups: list[tuple[int, int]] = []
    for _, text in pairs:
        if groups and text.start < groups[-1][1]:
            groups[-1] = groups[-1][0], max(groups[-1][1], text.end)
        else:
            groups.append((text.start, text.end))
    clips: list[Clip] = []
    silent = np.ones(clip.num_frames, bool)
    for start, stop in groups:
        silent[start:stop] = False
        if (start, stop) == (0, clip.num_frames):
            clips.append(whole)
            continue
        own = [item for item, text in pairs if start <= text.start < stop]
        part = replace(clip, text=texts).window(start, stop, f"{clip.key}-t{start:04d}")
        clips.append(reported(part, _with_origins(report, own)))
    times = clip.source_timestamps_s
    lost = tuple(
        Lost(float(times[start]), float(times[stop - 1]) + 1 / clip.fps, "describe", NO_TEXT)
        for start, stop in runs(silent)
    )
    return Outcome(tuple(clips), lost)


def _text(item: Described, clip: Clip) -> TextSegment | None:
    """Return the segment in frames of the clip; None where they have nothing in common."""
    if item.stop_s <= clip.start_s or item.start_s >= clip.stop_s:
        return None
    start, end = np.searchsorted(
        clip.source_timestamps_s, np.array([item.start_s, item.stop_s]) - _SLACK_S
    ).tolist()
    if end <= start:  # between two frames: the one that is shown then
        start = max(start - 1, 0)
        end = start + 1
    return TextSegment(item.id, item.text, item.side, start, end)


def _with_origins(report: StageReport, said: Sequence[Described]) -> StageReport:
    names = ("id", "source", "start_s", "stop_s", "rule")
    origins = [{name: getattr(item, name) for name in names} for item in said]
    return replace(report, numbers={**report.numbers, "segments": origins})


def _check_cut(cut: str) -> None:
    if cut not in CUTS:
        raise ValueError(f"cut: expected one of {', '.join(CUTS)}, got {cut!r}")


def _load(name: str) -> Describer:
    if not name:
        raise NotReadyError(
            "describe (vlm): expected the setting describer, package.module:name, got none"
        )
    module, _, attribute = name.partition(":")
    try:
        return cast("Describer", getattr(importlib.import_module(module), attribute))
    except (ImportError, AttributeError) as error:
        raise NotReadyError(f"describe (vlm): {name} cannot be had: {error}") from None


def _checked(item: Any, name: str, settings: DescribeWithModel.Settings) -> Described:
    try:
        start_s, stop_s = float(item["start_s"]), float(item["stop_s"])
        text, side = str(item["text"]), cast("Who", item.get("side"))
        if not (start_s < stop_s and math.isfinite(stop_s - start_s)):
            raise ValueError("not start_s < stop_s")
        if side not in ("left", "right", "both", None):
            raise ValueError(f"side {side!r}")
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise StageError(
            f"{settings.describer}: expected start_s < stop_s, text and side (left, right, both or "
            f"None), got {item!r:.80} ({error})"
        ) from None
    return Described(start_s, stop_s, text, side, name, "interval", settings.describer)
