"""From other formats to shards to pictures: what a source tells, the video is held to."""

from dataclasses import replace
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from mint_hub.cli import main
from mint_hub.geometry.lenses import Lens, rectification
from mint_hub.loaders.attach import VideoAttachment, VideoMismatchError
from mint_hub.loaders.device_trajectories import DeviceTrajectory, episode_from_trajectory
from mint_hub.loaders.hot3d import from_hot3d
from mint_hub.loaders.lerobot import from_lerobot
from mint_hub.loaders.lerobot_files import open_root
from mint_hub.loaders.reader import CorpusReader
from mint_hub.loaders.resolvers import Ego4DVideos, VideoReference
from mint_hub.loaders.video import VideoNotFoundError, iter_frames
from tests import video_files as make
from tests.episodes import make_episode
from tests.lerobot_files import RootPlan, edit_info, write_root
from tests.loaders.test_vitra import annotation, write


def convert(kind: str, source: Path, out: Path) -> CorpusReader:
    call = ["convert", kind, str(source), "-o", str(out), "--config", "made", "--split", "train"]
    assert main([*call, "--quiet"]) == 0
    return CorpusReader(out, "made")


def numbers(images) -> list[int]:
    return [make.frame_number(image) for image in images]


# ---------------------------------------------------------------- VITRA


@pytest.fixture
def vitra(tmp_path) -> CorpusReader:
    fields = annotation(6)
    fields["intrinsics"] = np.array([[50.0, 0, 32], [0, 50, 24], [0, 0, 1]])
    fields["video_decode_frame"] = np.arange(20, 26)
    return convert("vitra", write(tmp_path, fields), tmp_path / "corpus")


def test_vitra_counts_frames_from_the_first_whenever_that_is(vitra, tmp_path):
    (episode,) = vitra
    assert episode.meta["native_fps"] == 30
    assert episode.meta["video_start_sec"] == 0
    make.video(tmp_path / "clip.mp4", 60)
    make.late_start(tmp_path / "late.mkv", 5000)
    for name in ("clip.mp4", "late.mkv"):
        video = VideoAttachment(episode, tmp_path / name, lens=None)
        assert numbers(video.frames()) == list(range(20, 26))
        assert numbers(VideoAttachment(episode.window(2, 3), video.source, lens=None).frames()) == [
            22,
            23,
            24,
        ]
    assert VideoAttachment(episode, tmp_path, lens=None).source == tmp_path / "clip.mp4"


def test_vitra_refers_to_undistorted_pictures_of_that_rate(vitra, tmp_path):
    (episode,) = vitra
    path = make.video(tmp_path / "clip.mp4", 60)
    with pytest.raises(VideoMismatchError, match=r"lens: .*refer to undistorted pictures"):
        VideoAttachment(episode, path)
    slow = make.video(tmp_path / "slow.mp4", 60, rate=25)
    with pytest.raises(VideoMismatchError, match="fps: expected 30 frames a second, got 25"):
        VideoAttachment(episode, slow, lens=None)


# -------------------------------------------------------------- LeRobot


def test_a_root_with_its_own_videos_is_its_own_resolver(tmp_path):
    root = tmp_path / "root"
    write_root(root, RootPlan(lengths=(12, 9), per_file=2))
    folder = root / "videos/observation.images.ego/chunk-000"
    folder.mkdir(parents=True)
    for number in range(2):
        make.video(folder / f"file-{number:03d}.mp4", 100 + number)
    for k, episode in enumerate(sorted(convert("lerobot", root, tmp_path / "c"), key=_key)):
        file = f"videos/observation.images.ego/chunk-000/file-{k:03d}"
        assert episode.meta["uid"] == f"lerobot-{open_root(root).identity}/{file}"
        assert "may join several videos" in episode.meta["warnings"][-1]
        video = VideoAttachment(episode, root)
        assert video.info.num_frames == 100 + k
        expected = [(60 * k + i) % 30 for i in range(episode.num_frames)]
        assert numbers(video.frames()) == expected


def test_the_rate_of_the_roots_own_video_is_told_by_info(tmp_path):
    write_root(tmp_path, RootPlan(lengths=(12,)))
    shape = {"dtype": "video", "shape": [384, 512, 3], "names": ["height", "width", "channel"]}
    told = {"observation.images.ego": {**shape, "info": {"video.fps": 30}}}
    edit_info(tmp_path, features=told)
    (episode,) = from_lerobot(tmp_path)
    assert episode.meta["native_fps"] == 30
    named = tmp_path / "named"
    write_root(named, RootPlan(lengths=(12,), episode_columns={"uid": ("a",)}))
    edit_info(named, features=told)
    (episode,) = from_lerobot(named)
    assert "native_fps" not in episode.meta  # it is the export's, not that of the video named


def test_a_root_may_tell_what_attaching_needs(tmp_path):
    columns = {
        "video_uid": ("P01_101",),
        "participant": ("P01",),
        "native_fps": (50.0,),
        "video_start_sec": (4.0,),
        "video_duration_s": (2.4,),
        "undistorted": (True,),
    }
    root = tmp_path / "epic"
    write_root(root, RootPlan(lengths=(12,), source="epic", episode_columns=columns))
    (episode,) = convert("lerobot", root, tmp_path / "corpus")
    told = VideoReference.of(episode)
    assert (told.uid, told.participant, told.native_fps) == ("P01_101", "P01", 50.0)
    assert (told.video_start_s, told.duration_s, told.undistorted) == (4.0, 2.4, True)
    assert not episode.meta["warnings"]
    later = replace(episode, timestamps_s=episode.timestamps_s + 4.5)
    (tmp_path / "P01/videos").mkdir(parents=True)
    path = make.video(tmp_path / "P01/videos/P01_101.MP4", 120, rate=Fraction(50))
    window = VideoAttachment(later, tmp_path, lens=None).window()
    stored = np.rint((0.5 + np.arange(12) / 30) * 50).astype(int)
    assert numbers(window.images) == [k % 30 for k in stored]
    for columns_of, refused in ((60, "fps"), (50, "duration")):
        make.video(path, 60, rate=Fraction(columns_of))
        with pytest.raises(VideoMismatchError, match=refused):
            VideoAttachment(later, tmp_path, lens=None)


def test_labels_that_name_no_video_say_which_folder_has_it(tmp_path):
    write_root(tmp_path / "root", RootPlan(lengths=(12,), source="ego4d"))
    (episode,) = from_lerobot(tmp_path / "root")
    for videos in (tmp_path, Ego4DVideos(tmp_path)):
        with pytest.raises(VideoNotFoundError, match="take the videos of the LeRobot root") as told:
            VideoAttachment(episode, videos)
        assert "ego4d --output_directory" not in str(told.value)


def test_a_root_that_names_no_video_gives_no_uid(tmp_path):
    write_root(tmp_path / "root", RootPlan(lengths=(12, 9), video=False))
    reader = convert("lerobot", tmp_path / "root", tmp_path / "c")
    for episode in reader:
        assert "uid" not in episode.meta
        assert "no uid, so that a split may part a video" in episode.meta["warnings"][-1]
        with pytest.raises((VideoNotFoundError, ValueError), match="uid that names a file, got ''"):
            VideoAttachment(episode, tmp_path)


# ------------------------------------------------------- HOT3D and devices


def test_hot3d_pictures_are_rectified_and_turned_upright(real_dir, tmp_path):
    episode = from_hot3d(real_dir / "hot3d_gt" / "Aria_P0003_c701bd11", "1201-1")
    path = make.video(tmp_path / "slam-left.mp4", episode.num_frames, size_hw=(480, 640))
    video = VideoAttachment(episode, path)
    assert video.rectified
    images = video.frames()
    assert images.shape == (episode.num_frames, 640, 480, 3)
    assert numbers(images) == [i % 30 for i in range(episode.num_frames)]
    warp = rectification(Lens.from_dict(episode.meta["lens"]))
    first = next(iter_frames(path)).image
    np.testing.assert_array_equal(images[0], np.rot90(warp.apply(first), -1))
    assert video.frames(0, 2, (320, 240)).shape == (2, 320, 240, 3)


@pytest.mark.parametrize("turn", [0, 90, 180, 270])
def test_labels_of_turned_pictures_get_turned_pictures(tmp_path, turn):
    path = make.video(tmp_path / "a.mp4", 20)
    size = (64, 48) if turn in (90, 270) else (48, 64)
    made = make_episode(20, image_size_hw=size, meta={"image_turn_clockwise_deg": turn})
    raw = [frame.image for frame in iter_frames(path)]
    turned = np.rot90(np.stack(raw), -turn // 90, axes=(1, 2))
    np.testing.assert_array_equal(VideoAttachment(made, path).frames(), turned)
    crooked = replace(made, meta={"image_turn_clockwise_deg": 45})
    with pytest.raises(ValueError, match=r"image_turn_clockwise_deg'\]: expected 0, 90, 180 or"):
        VideoAttachment(crooked, path)


def test_a_device_trajectory_beside_a_video_is_on_the_videos_clock(tmp_path):
    path = make.late_start(tmp_path / "late.mkv", 5000)
    times = [frame.source_timestamp_s for frame in iter_frames(path, fps=None)]
    poses = np.tile(np.eye(4), (2, 1, 1))
    device = DeviceTrajectory(np.array([100.0, 110.0]), poses)
    K = np.array([[50.0, 0, 32], [0, 50, 24], [0, 0, 1]])
    episode = episode_from_trajectory(
        "a", device, times, K, (48, 64), time_offset_s=95.0, max_gap_s=20
    )
    window = VideoAttachment(episode, path).window()
    np.testing.assert_allclose(window.error_s, 0, atol=1e-6)
    assert numbers(window.images) == [i % 30 for i in range(len(times))]


def _key(episode):
    return episode.key
