"""The hand filter on a video made for it: which stretches stay, and every lost second's reason."""

import doctest
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mint_hub.labelling.records import Clip, Detections, Video
from mint_hub.labelling.stage import StageError, lost_seconds
from mint_hub.labelling.stages import hand_filter, timeline
from mint_hub.labelling.stages.hand_filter import HandFilter, held
from mint_hub.labelling.stages.timeline import place, source_times

FPS = 30
START_S = 100.0  # the video's clock does not start at zero


def detections(counts, score=0.9):
    """As many hands in each frame as ``counts`` says."""
    frame = np.repeat(np.arange(len(counts)), counts).astype(np.int32)
    n = len(frame)
    return Detections(
        frame=frame,
        box_xyxy=np.tile(np.array([1, 2, 3, 4], np.float32), (n, 1)),
        score=np.full(n, score, np.float32),
        right_score=np.linspace(0, 1, n, dtype=np.float32),
        landmarks_uv=np.zeros((n, 21, 2), np.float32),
        landmarks_m=np.zeros((n, 21, 3), np.float32),
    )


def made(counts, pieces, score=0.9):
    """A video of which frame n shows ``counts[n]`` hands, in clips (start, stop)."""
    times = START_S + np.arange(len(counts)) / FPS
    clips = tuple(
        Clip(
            key=f"v-{i:04d}",
            video=Path(f"v-{i:04d}.mp4"),
            first_frame=0,
            image_size_hw=(48, 64),
            fps=float(FPS),
            source_timestamps_s=times[start:stop],
            detections=detections(counts[start:stop], score),
        )
        for i, (start, stop) in enumerate(pieces)
    )
    duration = len(counts) / FPS
    return Video("v", "uid", "user", Path("v.mp4"), duration, FPS, (48, 64), START_S, clips)


def frames_of(clip):
    """Frames (start, stop) of the video that a clip shows."""
    start = round((clip.start_s - START_S) * FPS)
    return start, start + clip.num_frames


def lost_frames(video):
    seconds = [(x.start_s - START_S, x.stop_s - START_S, x.reason) for x in video.lost]
    return [(round(a * FPS), round(b * FPS), reason) for a, b, reason in seconds]


NO, MANY, SHORT = "no hand for more than 1 s", "more than two hands", "too short"


def test_a_video_made_for_the_filter():
    counts = np.full(1200, 2)
    counts[0:45] = 0  # no hand at the beginning
    counts[200:230] = 0  # exactly one second without: stays
    counts[300:331] = 0  # one frame more: goes
    counts[380:500] = 0  # leaves 331 .. 380, under two seconds
    counts[600] = 3  # a ghost
    counts[640:643] = 3  # still one
    counts[700:760] = 3  # a visitor
    counts[800:860:2] = 4  # a visitor that flickers, every other frame
    counts[1100:1116] = 1
    counts[1150:] = 0
    pieces = [(0, 360), (330, 690), (660, 1020), (990, 1200)]
    video = made(counts, pieces)
    done = HandFilter().run_video(video)

    assert [frames_of(clip) for clip in done.clips] == [
        (45, 300),
        (500, 690),
        (856, 1020),
        (990, 1150),
    ]
    assert lost_frames(done) == [
        (0, 45, NO),
        (300, 331, NO),
        (331, 380, SHORT),
        (380, 500, NO),
        (690, 700, SHORT),
        (700, 760, MANY),
        (760, 803, SHORT),
        (803, 856, MANY),
        (1150, 1200, NO),
    ]


def test_a_flickering_visitor_is_one():
    counts = np.full(300, 2)
    counts[100:160:2] = 3
    done = HandFilter().run_video(made(counts, [(0, 300)]))
    assert lost_frames(done) == [(103, 156, MANY)]


def test_seconds_add_up_to_the_video():
    rng = np.random.default_rng(0)
    pieces = [(start, min(start + 360, 3000)) for start in range(0, 2970, 330)]
    for _ in range(20):
        counts = np.repeat(rng.choice([0, 1, 2, 2, 3], 60), 50)
        video = made(counts, pieces)
        done = HandFilter().run_video(video)
        kept = [(clip.start_s, clip.stop_s) for clip in done.clips]
        seconds = lost_seconds((video.start_s, video.stop_s), kept, done.lost)
        assert "unaccounted" not in seconds
        shown = np.zeros(3000, bool)
        for clip in done.clips:
            shown[slice(*frames_of(clip))] = True
        assert shown.sum() / FPS + sum(seconds.values()) == pytest.approx(100)
        stated = done.reports[-1].numbers["seconds"]
        assert {f"filter: {r}": pytest.approx(s) for r, s in stated.items() if s} == seconds
        assert not shown[counts == 3].any()


def test_clips_that_overlap_are_cut_at_the_same_moment():
    """Each clip sees only some of the hands that are in the frames they share."""
    counts = np.full(690, 1)
    video = made(counts, [(0, 360), (330, 690)])
    first, second = (clip.detections for clip in video.clips)
    blind = replace(video.clips[1], detections=detections(np.r_[np.zeros(30, int), counts[360:]]))
    done = HandFilter().run_video(replace(video, clips=(video.clips[0], blind)))
    assert [frames_of(clip) for clip in done.clips] == [(0, 360), (330, 690)]
    assert done.lost == ()
    assert done.clips[0].detections is first
    assert second is not None

    counts[340:350] = 3
    done = HandFilter().run_video(made(counts, [(0, 360), (330, 690)]))
    assert [frames_of(clip) for clip in done.clips] == [(0, 340), (350, 690)]
    assert lost_frames(done) == [(340, 350, MANY)]


def test_cut_clips_keep_their_detections():
    counts = np.full(360, 2)
    counts[100:150] = 0
    done = HandFilter().run_video(made(counts, [(0, 360)]))
    before, after = done.clips
    assert [c.key for c in done.clips] == ["v-0000-h000", "v-0000-h150"]
    assert before.detections.frame.tolist() == np.repeat(np.arange(100), 2).tolist()
    assert after.detections.frame.tolist() == np.repeat(np.arange(210), 2).tolist()
    assert after.first_frame == 150


def test_scores():
    """Weak detections carry on what a strong one began, and begin nothing; a third needs to be."""
    counts = np.full(300, 1)
    assert HandFilter().run_video(made(counts, [(0, 300)], score=0.6)).clips == ()
    video = made(counts, [(0, 300)], score=0.6)
    score = video.clips[0].detections.score.copy()
    score[150] = 0.8
    sure = replace(video.clips[0], detections=replace(video.clips[0].detections, score=score))
    assert len(HandFilter().run_video(replace(video, clips=(sure,))).clips) == 1

    found = detections(np.full(300, 3))
    score = np.where(np.arange(900) % 3 == 2, 0.6, 0.9).astype(np.float32)
    third = replace(video.clips[0], detections=replace(found, score=score))
    assert HandFilter().run_video(replace(video, clips=(third,))).lost == ()


def test_no_clips_and_no_detections():
    video = made(np.ones(90, int), [(0, 90)])
    assert HandFilter().run_video(replace(video, clips=())).clips == ()
    bare = replace(video.clips[0], detections=None)
    with pytest.raises(StageError, match="expected detections of clip v-0000"):
        HandFilter().run_video(replace(video, clips=(bare,)))


@pytest.mark.parametrize("bad", [{"low_score": 0.8}, {"high_score": 1.2}, {"hold_frames": 0}])
def test_settings_out_of_range(bad):
    with pytest.raises(ValueError, match="expected"):
        HandFilter(HandFilter.Settings(**bad))


@pytest.mark.parametrize("frames", [1, 2, 4, 7])
def test_long_stretches_keep_their_ends_and_short_ones_vanish(frames):
    mask = np.zeros(200, bool)
    mask[20 : 20 + frames] = mask[100 : 100 + 3 * frames] = True
    expected = mask.copy()
    mask[60 : 60 + frames - 1] = True
    assert (held(mask, frames) == expected).all()


@pytest.mark.parametrize("rate", [10, 24, 25, 29.97, 30, 59.94])
def test_a_clip_finds_its_place_whatever_the_native_rate(rate):
    grid = np.arange(900) / FPS
    shown = 50.0 + np.round(grid * rate) / rate
    for first in (0, 1, 7, 330, 839):
        clip = Clip("a", Path("a"), 0, (2, 2), 30.0, shown[first : first + 60])
        assert place(clip, 50.0) == first


def test_source_times_of_the_time_line():
    a = Clip("a", Path("a"), 0, (2, 2), 30.0, np.array([0.0, 1.0]))
    b = Clip("b", Path("b"), 0, (2, 2), 30.0, np.array([1.5, 2.5]))
    times, covered = source_times([a, b], [0, 1], 4)
    np.testing.assert_array_equal(times, [0.0, 1.0, 2.5, np.nan])
    assert covered.tolist() == [True, True, True, False]


@pytest.mark.parametrize("module", [hand_filter, timeline])
def test_examples(module):
    names = {"np": np}
    result = doctest.testmod(module, extraglobs=names)
    assert result.attempted > 0
    assert result.failed == 0
