"""Stage "filter": keep what shows one or two hands, on the time line of the whole video.

Detections of clips that overlap are put together first, so that both clips are cut at the same
moment.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mint_hub.geometry.arrays import runs
from mint_hub.labelling.records import Clip, Lost, Video
from mint_hub.labelling.stage import Resources, report_of, require
from mint_hub.labelling.stages.timeline import place, source_times

CROWDED: Final = "more than two hands"
NO_HAND: Final = "no hand for more than {:g} s"
SHORT: Final = "too short"

Bool = NDArray[np.bool_]


class HandFilter:
    """Cuts clips where no hand is seen for long, and where there are more than two.

    A hand counts as seen in stretches of frames with a detection of at least ``low_score`` among
    which one has ``high_score``: a tracker follows with less confidence what a detector was sure
    of. Stretches without any hand that last longer than ``no_hand_s`` are cut out, shorter ones
    stay, at the ends of the video too. A third hand counts at ``high_score`` only, and where it is
    seen in most of ``2 hold_frames - 1`` frames: under ``hold_frames`` frames in a row are a ghost
    and cut nothing, one that flickers is there all the time. What remains of a clip stays when it
    is ``min_s`` long, and overlaps its neighbour as before.
    """

    stage, backend, version = "filter", "hands", "1"
    needs, gives = ("detections",), ()
    resources = Resources(cpus=1)

    @dataclass(frozen=True)
    class Settings:
        """Thresholds.

        Attributes:
            low_score, high_score: confidence of a detection that continues, and that begins a hand.
            no_hand_s: longest stretch without a hand that stays, seconds.
            max_hands: hands of one person.
            hold_frames: frames in a row for which more hands have to be seen.
            min_s: shortest piece that stays, seconds.

        """

        low_score: float = 0.5
        high_score: float = 0.7
        no_hand_s: float = 1.0
        max_hands: int = 2
        hold_frames: int = 4
        min_s: float = 2.0

    def __init__(self, settings: Settings | None = None) -> None:
        """Raise ValueError for thresholds out of order."""
        self.settings = settings or self.Settings()
        s = self.settings
        if not 0 <= s.low_score <= s.high_score <= 1:
            raise ValueError(
                f"low_score, high_score: expected 0 <= low <= high <= 1, got {s.low_score:g} and "
                f"{s.high_score:g}"
            )
        if s.hold_frames < 1:
            raise ValueError(f"hold_frames: expected at least 1, got {s.hold_frames}")

    def run_video(self, video: Video) -> Video:
        """Cut the clips; seconds by reason are in the video's report."""
        for clip in video.clips:
            require(self, clip)
        if not video.clips:
            return replace(video, reports=(*video.reports, report_of(self, clips=0)))
        clips = sorted(video.clips, key=lambda clip: (clip.start_s, clip.key))
        places = [place(clip, clips[0].start_s) for clip in clips]
        frames = max(p + c.num_frames for p, c in zip(places, clips, strict=True))
        seen, crowded = self._judged(clips, places, frames)
        times, covered = source_times(clips, places, frames)
        fps = clips[0].fps
        empty = np.zeros(frames, bool)
        for start, stop in runs(covered & ~seen):
            empty[start:stop] = stop - start > round(self.settings.no_hand_s * fps)
        good = covered & ~empty & ~crowded
        kept: list[Clip] = []
        remains = np.zeros(frames, bool)
        for clip, first in zip(clips, places, strict=True):
            for start, stop in self._pieces(good[first : first + clip.num_frames], fps):
                whole = stop - start == clip.num_frames
                kept.append(clip if whole else clip.window(start, stop, f"{clip.key}-h{start:03d}"))
                remains[first + start : first + stop] = True
        reasons = {
            CROWDED: covered & crowded,
            NO_HAND.format(self.settings.no_hand_s): empty & ~crowded,
            SHORT: good & ~remains,
        }
        lost = [
            Lost(float(times[start]), float(times[stop - 1]) + 1 / fps, self.stage, reason)
            for reason, mask in reasons.items()
            for start, stop in runs(mask)
        ]
        report = report_of(
            self,
            clips_before=len(clips),
            clips=len(kept),
            seconds={reason: float(mask.sum()) / fps for reason, mask in reasons.items()},
            hand_share=float(seen.sum() / covered.sum()),
        )
        lost.sort(key=lambda item: item.start_s)
        return replace(
            video,
            clips=tuple(kept),
            lost=(*video.lost, *lost),
            reports=(*video.reports, report),
        )

    def close(self) -> None:
        """Nothing to end."""

    def _pieces(self, good: Bool, fps: float) -> list[tuple[int, int]]:
        shortest = round(self.settings.min_s * fps)
        return [(start, stop) for start, stop in runs(good) if stop - start >= shortest]

    def _judged(self, clips: Sequence[Clip], places: Sequence[int], frames: int) -> "_Judged":
        """Where a hand is seen and where too many are, (frames,) each.

        Of clips that show the same frame, the one with more detections counts.
        """
        s = self.settings
        weak, strong = np.zeros(frames, np.int64), np.zeros(frames, np.int64)
        for clip, first in zip(clips, places, strict=True):
            assert clip.detections is not None
            found = clip.detections
            here = slice(first, first + clip.num_frames)
            for counts, score in ((weak, s.low_score), (strong, s.high_score)):
                each = np.bincount(found.frame[found.score >= score], minlength=clip.num_frames)
                counts[here] = np.maximum(counts[here], each)
        seen = np.zeros(frames, bool)
        for start, stop in runs(weak > 0):
            seen[start:stop] = strong[start:stop].any()
        return _Judged(seen, held(strong > s.max_hands, s.hold_frames))


class _Judged(NamedTuple):
    seen: Bool
    crowded: Bool


def held(mask: Bool, frames: int) -> Bool:
    """What most of the ``2 frames - 1`` around each frame say, without gaps under ``frames``.

    Stretches of at least ``frames`` keep their ends exactly, shorter ones among others vanish.

    >>> held(np.array([0, 0, 1, 0, 0, 1, 1, 1, 0, 0], bool), 2).astype(int).tolist()
    [0, 0, 0, 0, 0, 1, 1, 1, 0, 0]
    """
    width = 2 * frames - 1
    padded = np.pad(mask.astype(np.int64), frames - 1)
    most = np.convolve(padded, np.ones(width, np.int64), "valid") >= frames
    for start, stop in runs(~most):
        if stop - start < frames and start > 0 and stop < len(most):
            most[start:stop] = True
    return most
