"""Normalising: videos of every make become clips whose frames and times are known exactly."""

from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

from mint_hub.labelling.frames import clip_frames
from mint_hub.labelling.label import open_video
from mint_hub.labelling.stage import NotReadyError, lost_seconds
from mint_hub.labelling.stages.normalise import DAMAGED, MISSING, Normalise
from mint_hub.loaders.video import VideoError, iter_frames
from tests import video_files as make


def run(file: Path, source="user", **settings):
    """Normalise a file in pieces of 2 s with 1/3 s overlap, unless told otherwise."""
    values = {"piece_s": 2.0, "overlap_s": 1 / 3, "min_tail_s": 0.8, **settings}
    stage = Normalise(Normalise.Settings(work_dir=str(file.parent / "work"), **values))
    return stage.run_video(open_video("v", file, source))


def shown(clip):
    return [make.frame_number(image) for image in clip_frames(clip)]


def check_account(video):
    kept = [(clip.start_s, clip.stop_s) for clip in video.clips]
    seconds = lost_seconds((video.start_s, video.stop_s), kept, video.lost)
    assert seconds.get("unaccounted", 0.0) < 0.1


@pytest.mark.parametrize(
    ("frames", "expected", "lost"),
    [
        (30, [(0, 30)], None),  # one short clip
        (60, [(0, 60)], None),
        (64, [(0, 60)], (60, 64)),  # a tail of 14 frames
        (73, [(0, 60)], (60, 73)),  # of 23
        (74, [(0, 60), (50, 74)], None),  # of 24: long enough
        (110, [(0, 60), (50, 110)], None),  # its end is a piece's
        (140, [(0, 60), (50, 110), (100, 140)], None),
    ],
)
def test_pieces_overlap_and_cover(tmp_path, frames, expected, lost):
    video = run(make.video(tmp_path / "a.mp4", frames, options={"bf": "2"}))
    assert [(round(c.start_s * 30), round(c.stop_s * 30)) for c in video.clips] == expected
    for clip, (start, stop) in zip(video.clips, expected, strict=True):
        assert shown(clip) == [n % 30 for n in range(start, stop)]
        np.testing.assert_allclose(clip.source_timestamps_s, np.arange(start, stop) / 30, atol=1e-4)
        assert (clip.fps, clip.first_frame, clip.image_size_hw) == (30.0, 0, (48, 64))
    found = [(round(x.start_s * 30), round(x.stop_s * 30), x.reason) for x in video.lost]
    assert found == ([] if lost is None else [(*lost, "tail shorter than 0.8 s")])
    check_account(video)
    files = sorted(path.name for path in (tmp_path / "work" / "v").iterdir())
    assert files == [f"{clip.key}.mp4" for clip in video.clips]


def test_a_whole_video_may_be_shorter_than_a_tail(tmp_path):
    assert len(run(make.video(tmp_path / "a.mp4", 30), min_tail_s=3.0, piece_s=12.0).clips) == 1
    video = run(make.video(tmp_path / "b.mp4", 29))
    assert video.clips == ()
    assert [x.reason for x in video.lost] == ["video shorter than 1 s"]
    check_account(video)


def test_without_overlap(tmp_path):
    video = run(make.video(tmp_path / "a.mp4", 120), overlap_s=0.0)
    assert [clip.num_frames for clip in video.clips] == [60, 60]
    assert shown(video.clips[1]) == [n % 30 for n in range(60, 120)]


@pytest.mark.parametrize("rate", [12, 24, 25, 50, 60])
def test_any_rate_becomes_thirty_and_keeps_exact_source_times(tmp_path, rate):
    file = make.video(tmp_path / "a.mp4", 4 * rate, rate=rate)
    video = run(file)
    stored = {frame.timestamp_s for frame in iter_frames(file, None)}
    for clip, first in zip(video.clips, (0, 50), strict=True):
        grid = (first + np.arange(clip.num_frames)) / 30
        assert set(clip.source_timestamps_s.tolist()) <= stored
        assert np.abs(clip.source_timestamps_s - grid).max() <= 0.5 / rate + 1e-6
        numbers = np.round(clip.source_timestamps_s * rate).astype(int) % 30
        assert shown(clip) == numbers.tolist()
    assert video.reports[-1].numbers["different_frames"] == min(4 * rate, 120)


def test_variable_rate(tmp_path):
    gaps = np.random.default_rng(0).integers(15, 60, 100)
    times = [0, *np.cumsum(gaps).tolist()]
    file = make.vfr(tmp_path / "a.mkv", times)
    video = run(file)
    stored = np.array(times) / 1000
    for clip in video.clips:
        at = np.abs(clip.source_timestamps_s[:, None] - stored).argmin(1)
        np.testing.assert_allclose(clip.source_timestamps_s, stored[at], atol=1e-6)
        assert shown(clip) == (at % 30).tolist()


def test_five_frames_a_second_are_too_few(tmp_path):
    video = run(make.video(tmp_path / "a.mp4", 60, rate=5))
    assert video.clips == ()
    (lost,) = video.lost
    assert lost.reason == "frame rate too low for tracking: 5 of at least 10"
    assert lost.seconds == pytest.approx(12)
    assert not lost.failed


def test_a_stretch_that_stands_still_is_too_slow(tmp_path):
    """The average rate is fine; two seconds in the middle are a slide show."""
    times = [*range(0, 3000, 20), *range(3000, 6000, 500), *range(6000, 9000, 20)]
    video = run(make.vfr(tmp_path / "a.mkv", times))
    assert video.fps == 0 or video.fps > 10
    slow, tail = video.lost
    assert slow.reason.startswith("frame rate too low for tracking: ")
    assert tail.reason == "tail shorter than 0.8 s"
    assert [round(clip.start_s, 1) for clip in video.clips] == [0.0, 1.7, 5.0, 6.7]
    check_account(video)


@pytest.mark.parametrize(
    ("size_hw", "source", "settings", "expected"),
    [
        ((720, 1280), "user", {}, (384, 682)),
        ((1280, 720), "user", {}, (682, 384)),  # portrait: the shorter side
        ((1080, 1440), "ego4d", {}, (768, 1024)),
        ((300, 400), "user", {}, (300, 400)),  # nothing is enlarged
        ((383, 511), "user", {}, (382, 510)),
        ((300, 400), "user", {"height": 100}, (100, 134)),
        ((2160, 3840), "user", {}, (384, 682)),
    ],
)
def test_sizes(tmp_path, size_hw, source, settings, expected):
    file = make.video(
        tmp_path / "a.mkv", 12, size_hw, 12, codec="mjpeg", pix_fmt="yuvj444p", options={"q": "5"}
    )
    (clip,) = run(file, source, **settings).clips
    assert clip.image_size_hw == expected
    seen = shown(clip)
    assert seen == sorted(seen)
    assert set(seen) == set(range(12))


@pytest.mark.parametrize("degrees", [90, 180, 270])
def test_upright(tmp_path, degrees):
    file = make.rotated(tmp_path / "a.mp4", degrees, num_frames=30)
    (clip,) = run(file).clips
    assert clip.image_size_hw == ((64, 48) if degrees % 180 else (48, 64))
    for image, frame in zip(clip_frames(clip), iter_frames(file), strict=True):
        assert np.abs(image.astype(int) - frame.image).mean() < 6


def test_square_pixels(tmp_path):
    def prepare(stream):
        stream.codec_context.sample_aspect_ratio = Fraction(2)

    (clip,) = run(make.video(tmp_path / "a.mp4", 30, prepare=prepare)).clips
    assert clip.image_size_hw == (48, 128)
    with av.open(str(clip.video)) as container:
        assert container.streams.video[0].sample_aspect_ratio in (None, 0, 1)


def test_damage_in_the_middle_keeps_what_came_before(tmp_path):
    video = run(make.damaged(tmp_path / "a.mp4", 45), piece_s=1.0)
    (clip, *_), (lost,) = video.clips, [x for x in video.lost if x.reason == DAMAGED]
    assert shown(clip) == list(range(30))
    assert lost.failed
    assert lost.stop_s == video.stop_s
    assert "damaged at" in video.reports[-1].numbers["warnings"][0]
    check_account(video)


def test_a_container_that_promises_too_much(tmp_path):
    file = make.video(tmp_path / "a.mp4", 60)
    opened = open_video("v", file, "user")
    longer = type(opened)(**{**vars(opened), "duration_s": 5.0})
    stage = Normalise(Normalise.Settings(work_dir=str(tmp_path / "work")))
    video = stage.run_video(longer)
    assert [(x.reason, round(x.seconds, 3), x.failed) for x in video.lost] == [
        (MISSING, 3.0, False)
    ]


@pytest.mark.real
def test_a_real_clip(real_dir, tmp_path):
    opened = open_video("v", real_dir / "hawor" / "video_0.mp4", "user")
    (clip,) = Normalise(Normalise.Settings(work_dir=str(tmp_path))).run_video(opened).clips
    assert (clip.num_frames, clip.image_size_hw) == (121, (384, 682))


def test_bad_input(tmp_path):
    video = open_video("v", make.video(tmp_path / "a.mp4"), "user")
    with pytest.raises(NotReadyError, match="work_dir"):
        Normalise().run_video(video)
    (tmp_path / "a.mp4").write_text("nothing")
    with pytest.raises(VideoError, match=r"a\.mp4"):
        Normalise(Normalise.Settings(work_dir=str(tmp_path))).run_video(video)
    with pytest.raises(ValueError, match="overlap_s: expected 0 to half"):
        Normalise(Normalise.Settings(overlap_s=7.0))
    with pytest.raises(ValueError, match="height"):
        Normalise(Normalise.Settings(height=1))
