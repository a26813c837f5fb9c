"""Pictures for an episode: where videos are looked for, what is refused, which frame is shown."""

import pickle
from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from mint_hub.assets import sample_clip
from mint_hub.geometry.lenses import OpenCVLens, PinholeLens, rectification
from mint_hub.loaders.attach import VideoAttachment, VideoMismatchError
from mint_hub.loaders.members import META, decode_meta, encode
from mint_hub.loaders.resolvers import (
    EgoDexVideos,
    FolderVideos,
    VideoReference,
    resolve,
)
from mint_hub.loaders.schema import Episode
from mint_hub.loaders.video import VideoError, VideoNotFoundError, iter_frames
from mint_hub.loaders.video_reader import DecoderCache
from tests import video_files as make
from tests.episodes import make_episode

SIZE = (48, 64)


def episode(num_frames=20, start_s=0.0, fps=30.0, *, size_hw=SIZE, **meta):
    made = make_episode(num_frames, image_size_hw=size_hw, fps=fps, meta=meta)
    return replace(made, timestamps_s=start_s + np.arange(num_frames) / fps)


def numbers(images):
    return [make.frame_number(image) for image in images]


@pytest.fixture(scope="module")
def clip(tmp_path_factory) -> Path:
    return make.video(tmp_path_factory.mktemp("video") / "clip.mp4", 60)


# ---------------------------------------------------------------- where


def touch(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(b"")
    return path


LAYOUTS = {
    "ego4d": ("ego4d", "03cc-49c3", "full_scale/03cc-49c3.mp4"),
    "ego4d v2": ("ego4d", "03cc-49c3", "v2/full_scale/03cc-49c3.mp4"),
    "ego4d, the folder itself": ("ego4d", "03cc-49c3", "03cc-49c3.mp4"),
    "epic": ("epic", "P01_101", "P01/videos/P01_101.MP4"),
    "epic, downloader": ("epic", "P01_101", "EPIC-KITCHENS/P01/videos/P01_101.MP4"),
    "egodex": ("egodex", "fold_towel/12", "fold_towel/12.mp4"),
    "egodex, all parts": ("egodex", "fold_towel/12", "part3/fold_towel/12.mp4"),
    "unknown": ("somebody", "kitchen", "kitchen.mp4"),
}


@pytest.mark.parametrize("case", LAYOUTS)
def test_published_layouts(tmp_path, case):
    source, uid, place = LAYOUTS[case]
    video = VideoReference.of(episode(source=source, uid=uid))
    with pytest.raises(VideoNotFoundError) as caught:
        resolve(video, tmp_path)
    message = str(caught.value)
    assert message.startswith(f"video {uid!r} of {source!r} (episode synthetic-0)")
    assert str(tmp_path / place) in message
    assert "To get it, " in message
    assert ("http" in message) == (source != "somebody")
    path = touch(tmp_path / place)
    assert resolve(video, tmp_path) == path
    assert resolve(video, {source: tmp_path, "other": "nowhere"}) == path
    assert resolve(video, str(path)) == str(path)


def test_patterns(tmp_path):
    video = VideoReference.of(episode(source="mine", uid="a[1]", participant="P7"))
    path = touch(tmp_path / "P7" / "deep" / "a[1].mov")
    assert FolderVideos(tmp_path, "{participant}/deep/{uid}.mov")(video) == path
    assert FolderVideos(tmp_path, "**/{uid}.*")(video) == path
    touch(tmp_path / "a[1].mp4")
    with pytest.raises(VideoError, match=r"expected one file, got .*a\[1\]\.mov, .*a\[1\]\.mp4"):
        FolderVideos(tmp_path, "**/{uid}.*")(video)
    with pytest.raises(ValueError, match=r"pattern: expected only \{uid\}.*got '\{name\}"):
        FolderVideos(tmp_path, "{name}.mp4")


def test_a_task_in_two_parts_needs_a_longer_uid(tmp_path):
    for part in ("part1", "part2"):
        touch(tmp_path / part / "fold" / "0.mp4")
    with pytest.raises(VideoError, match=r"expected one file, got .*make the uid say which"):
        EgoDexVideos(tmp_path)(VideoReference.of(episode(source="egodex", uid="fold/0")))
    found = EgoDexVideos(tmp_path)(VideoReference.of(episode(source="egodex", uid="part2/fold/0")))
    assert found == tmp_path / "part2" / "fold" / "0.mp4"


def test_a_function_of_ones_own(clip, tmp_path):
    seen = []

    def mine(video):
        seen.append(video)
        return clip if video.uid == "known" else None

    video = VideoAttachment(episode(uid="known"), mine)
    assert video.source == clip
    assert (seen[0].key, seen[0].uid, seen[0].image_size_hw) == ("synthetic-0", "known", SIZE)
    with pytest.raises(VideoNotFoundError, match="the resolver mine knows no such video"):
        VideoAttachment(episode(uid="other"), mine)
    with pytest.raises(VideoNotFoundError, match="no such file"):
        VideoAttachment(episode(), lambda _: tmp_path / "none.mp4")
    with pytest.raises(VideoError, match="expected a folder or resolver for this source, got only"):
        resolve(seen[0], {"ego4d": tmp_path})


@pytest.mark.parametrize(
    "uid", ["../secret", "/etc/passwd", "a/../../b", "", "a\\b", "c:x", "a//b"]
)
def test_labels_cannot_reach_outside_the_folder(tmp_path, uid):
    for source in ("ego4d", "epic", "egodex", "mine"):
        with pytest.raises(VideoError, match="expected a uid that names a file"):
            resolve(VideoReference.of(episode(source=source, uid=uid)), tmp_path)
    with pytest.raises(VideoError, match="participant that names a folder"):
        FolderVideos(tmp_path, "{participant}/a.mp4")(
            VideoReference.of(episode(participant="../.."))
        )


# ---------------------------------------------------------------- which frame


def test_windows_of_an_episode_in_the_middle(clip):
    video = VideoAttachment(episode(30, start_s=0.5), clip)
    assert numbers(video.frames()) == [i % 30 for i in range(15, 45)]
    assert numbers(video.frames(3, 4)) == [18, 19, 20, 21]
    window = video.window(10, 16)
    assert window.images.shape == (16, *SIZE, 3)
    assert window.images.dtype == np.uint8
    np.testing.assert_allclose(window.timestamps_s, 0.5 + np.arange(10, 26) / 30)
    np.testing.assert_allclose(window.error_s, 0, atol=1e-4)
    for start, length in ((-1, 2), (0, 0), (29, 2)):
        with pytest.raises(ValueError, match=r"0 <= start <= 30 - length, got start .*synthetic-0"):
            video.frames(start, length)


def test_as_torch_and_in_other_sizes(clip):
    video = VideoAttachment(episode(), clip)
    images = video.frames(2, 3, (24, 40), as_torch=True)
    assert isinstance(images, torch.Tensor)
    assert (images.shape, images.dtype) == ((3, 24, 40, 3), torch.uint8)
    assert numbers(images.numpy()) == [2, 3, 4]
    larger = VideoAttachment(episode(size_hw=(96, 128)), clip)
    assert larger.frames(0, 2).shape == (2, 96, 128, 3)
    with pytest.raises(ValueError, match="image_size_hw: expected positive sizes"):
        video.frames(0, 1, (0, 4))


@settings(deadline=None, max_examples=20)
@given(
    rate=st.sampled_from([Fraction(25), Fraction(50), Fraction(60000, 1001), Fraction(60)]),
    start_ms=st.integers(0, 700),
    length=st.integers(1, 20),
)
def test_the_nearest_frame_of_native_rates(tmp_path_factory, rate, start_ms, length):
    path = tmp_path_factory.mktemp("rate") / "clip.mp4"
    make.video(path, 100, rate=rate, options={"bf": "2"})
    made = episode(length, start_s=start_ms / 1000, native_fps=float(rate))
    window = VideoAttachment(made, path).window()
    stored = np.arange(100) / float(rate)
    nearest = np.abs(stored - made.timestamps_s[:, None])
    np.testing.assert_allclose(np.abs(window.error_s), nearest.min(axis=1), atol=6e-4)
    assert (np.abs(window.error_s) <= 0.5 / float(rate) + 1e-3).all()
    which = np.rint(window.source_timestamps_s * float(rate)).astype(int)
    assert numbers(window.images) == [i % 30 for i in which]


def test_a_frame_too_far_from_any_stored_one_is_refused(tmp_path):
    times = [round(i * 1000 / 30) for i in range(30) if not 11 <= i < 18]
    path = make.vfr(tmp_path / "gap.mkv", times)
    video = VideoAttachment(episode(25), path)
    assert numbers(video.frames(0, 11)) == list(range(11))
    assert numbers(video.frames(18, 7)) == list(range(11, 18))
    with pytest.raises(VideoMismatchError) as caught:
        video.frames(5, 14)
    message = str(caught.value)
    assert message.startswith(f"{path}: expected a stored frame within ")
    assert "of frame 11 at 0.367 s, got the nearest at 0.333 s; so it is with 7 of 14" in message
    assert "episode synthetic-0" in message


def test_clocks_that_start_elsewhere(tmp_path):
    """Ego4D's labels count on the clock of a video that may start late; copies start at zero."""
    late = make.late_start(tmp_path / "late.mkv", 5000)
    copy = make.video(tmp_path / "copy.mp4")
    on_its_clock = episode(10, start_s=5.2)
    assert numbers(VideoAttachment(on_its_clock, late).frames()) == list(range(6, 16))
    with_offset = episode(10, start_s=5.2, video_start_sec=5.0)
    for path in (late, copy):
        assert numbers(VideoAttachment(with_offset, path).frames()) == list(range(6, 16))
    from_the_first_frame = episode(10, start_s=0.2)
    for path in (late, copy):
        video = VideoAttachment(from_the_first_frame, path, video_start_s=0.0)
        assert numbers(video.frames()) == list(range(6, 16))
    with pytest.raises(VideoMismatchError, match=r"duration: expected a video that holds 5\.200 s"):
        VideoAttachment(on_its_clock, copy)


# ---------------------------------------------------------------- which file


@pytest.mark.parametrize(
    ("made", "check", "message"),
    [
        ({"num_frames": 90}, "duration", r"holds 0\.000 s to 2\.967 s, got 0\.000 s to 2\.000 s"),
        ({"video_duration_s": 9.0}, "duration", r"a video of 9\.000 s, got 2\.000 s"),
        ({"size_hw": (48, 48)}, "size", r"aspect ratio of .*\(48, 48\), got \(48, 64\)"),
        ({"size_hw": (64, 48)}, "size", r"got \(48, 64\)"),
        ({"native_fps": 50.0}, "fps", "expected 50 frames a second, got 30"),
        ({"undistorted": True}, "lens", "labels refer to undistorted pictures, got none"),
    ],
)
def test_another_file_is_refused(clip, made, check, message):
    with pytest.raises(VideoMismatchError, match=message) as caught:
        VideoAttachment(episode(**made), clip)
    assert str(caught.value).startswith(f"{clip}: {check}: expected ")
    assert "(episode synthetic-0)" in str(caught.value)
    assert numbers(VideoAttachment(episode(**made), clip, ignore={check}).frames(1, 2)) == [1, 2]
    with pytest.raises(ValueError, match="ignore: expected some of duration, size"):
        VideoAttachment(episode(), clip, ignore={"everything"})


def test_rates_that_differ_by_name_only_are_the_same(tmp_path):
    path = make.video(tmp_path / "ntsc.mp4", 60, rate=Fraction(30000, 1001))
    assert VideoAttachment(episode(native_fps=30.0), path).native_fps == pytest.approx(
        29.97, abs=0.01
    )
    with pytest.raises(ValueError, match=r"meta\['native_fps'\]: expected a number, got '30'"):
        VideoAttachment(episode(native_fps="30"), path)


# ---------------------------------------------------------------- lenses


LENS = OpenCVLens(SIZE, 40.0, 40.0, 30.0, 25.0, (-0.3, 0.1, 0.0, 0.0))


def test_labels_of_rectified_pictures_get_rectified_pictures(clip):
    expected = [rectification(LENS).apply(f.image) for f in iter_frames(clip, stop_s=0.2)]
    for made, options in (
        (episode(lens=LENS.to_dict()), {}),
        (episode(undistorted=True), {"lens": LENS}),
    ):
        video = VideoAttachment(made, clip, **options)
        assert video.rectified
        np.testing.assert_array_equal(video.frames(0, 6), expected)
        assert video.frames(0, 2, (24, 32)).shape == (2, 24, 32, 3)
    plain = VideoAttachment(episode(undistorted=True, lens=LENS.to_dict()), clip, lens=None)
    assert not plain.rectified
    assert np.abs(plain.frames(0, 6).astype(int) - expected).max() > 20


def test_a_centred_pinhole_changes_nothing(clip):
    lens = PinholeLens(SIZE, 40.0, 40.0, 32.0, 24.0).to_dict()
    np.testing.assert_array_equal(
        VideoAttachment(episode(lens=lens), clip).frames(),
        VideoAttachment(episode(), clip).frames(),
    )


# ---------------------------------------------------------------- beside others


def test_the_json_member_is_as_good_as_the_episode(clip):
    made = episode(20, start_s=0.4, uid="x", source="mine", native_fps=30.0, lens=LENS.to_dict())
    values = decode_meta(encode(made)[META])
    a, b = VideoAttachment(made, clip), VideoAttachment(values, clip)
    np.testing.assert_array_equal(a.frames(), b.frames())
    assert (b.reference.uid, b.reference.native_fps, b.rectified) == ("x", 30.0, True)
    del values["start_s"]
    with pytest.raises(ValueError, match="start_s: expected this entry"):
        VideoAttachment(values, clip)


def test_it_travels_to_another_process_without_its_decoders(clip):
    videos = FolderVideos(clip.parent)
    video = VideoAttachment(episode(uid=clip.stem), videos, decoders=DecoderCache())
    before = video.frames(3, 5)
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(video)).frames(3, 5), before)


def test_the_embedded_clip_and_its_truth():
    path = sample_clip()
    truth = Episode.load(path.with_name("sample.npz"))
    video = VideoAttachment(truth, path)
    stored = [frame.image for frame in iter_frames(path)]
    np.testing.assert_array_equal(video.frames(40, 8), stored[40:48])
    assert np.abs(video.window().error_s).max() < 1e-6


def test_a_real_clip(real_dir):
    path = next((real_dir / "ego4d").glob("*.mp4"))
    made = episode(20, size_hw=(368, 480), source="ego4d", uid=path.stem)
    video = VideoAttachment(made, path.parent)
    window = video.window(4, 16, (224, 224))
    assert window.images.shape == (16, 224, 224, 3)
    assert (np.abs(window.error_s) <= 0.5 / video.native_fps + 1e-3).all()
    exact = [f.image for f in iter_frames(path)]
    np.testing.assert_array_equal(video.frames(4, 10), exact[4:14])
