"""Packed video: pixels and labels stay together, in memory and in shards."""

from dataclasses import replace

import numpy as np
import pytest

from mint_hub.assets import sample_clip
from mint_hub.loaders.attach import VideoAttachment, VideoMismatchError
from mint_hub.loaders.packing import (
    MP4,
    PackedClip,
    Packer,
    decode_window,
    encode_clip,
    pack,
    pack_corpus,
    pixel_window,
    read_window,
)
from mint_hub.loaders.reader import CorpusReader
from mint_hub.loaders.resolvers import FolderVideos
from mint_hub.loaders.schema import Episode
from mint_hub.loaders.shards import write_corpus
from mint_hub.loaders.tar_layout import CorpusError
from mint_hub.loaders.video import VideoError, VideoNotFoundError
from tests import video_files as make
from tests.episodes import make_episode

SIZE = (48, 64)


def numbers(images):
    return [make.frame_number(image) for image in images]


@pytest.fixture(scope="module")
def clip() -> bytes:
    return encode_clip([make.picture(i, SIZE) for i in range(100)])


@pytest.fixture(scope="module")
def truth() -> Episode:
    return Episode.load(sample_clip().with_name("sample.npz"))


def test_pixels_and_labels_of_the_same_frames(truth):
    members = Packer(sample_clip(), size_hw=(144, 240), crf=10)(truth)
    assert list(members) == [MP4]
    window = read_window(truth, members[MP4], 30, 16)
    labels = truth.window(30, 16)
    assert window.images.shape == (16, 144, 240, 3)
    assert window.episode.image_size_hw == (144, 240)
    np.testing.assert_array_equal(window.episode.hand_state, labels.hand_state)
    height, width = truth.image_size_hw
    scale = np.diag([240 / width, 144 / height, 1])
    np.testing.assert_allclose(window.episode.K, scale @ labels.K, atol=1e-9)
    video = VideoAttachment(truth, sample_clip())
    error = [
        np.abs(window.images.astype(int) - video.frames(start, 16, (144, 240))).mean()
        for start in (29, 30, 31)
    ]
    assert error[1] < 4
    assert error[1] < min(error[0], error[2]) / 2
    with pytest.raises(VideoError, match=r"mp4: expected 40 frames, got 120 \(episode sample\)"):
        read_window(truth.window(0, 40), members[MP4])


def test_a_clip_that_is_damaged_or_of_another_episode_is_named(clip):
    made = make_episode(100, image_size_hw=SIZE, key="mine")
    assert numbers(read_window(made, clip, 40, 4).images) == [10, 11, 12, 13]
    for cut in (40, len(clip) // 2):
        with pytest.raises(VideoError, match=r"^<\d+ bytes>: .*\(episode mine\)$"):
            read_window(made, clip[:cut], 90, 4)
    with pytest.raises(VideoError, match=r"mp4: expected 99 frames, got 100 \(episode mine\)$"):
        read_window(made.window(0, 99), clip)
    with pytest.raises(ValueError, match=r"got start 99, length 4 \(episode mine\)$"):
        read_window(made, clip, 99, 4)


def test_packing_is_deterministic_and_longer_than_a_chunk(tmp_path):
    path = make.video(tmp_path / "a.mp4", 150, rate=50, gop=250)
    made = replace(make_episode(80, image_size_hw=SIZE), timestamps_s=0.2 + np.arange(80) / 30)
    clip = Packer(path)(made)[MP4]
    assert clip == Packer(path)(made)[MP4]
    expected = numbers(VideoAttachment(made, path).frames())
    assert numbers(decode_window(clip)) == expected


def folder_of(tmp_path) -> tuple[Packer, list[Episode]]:
    for i in range(3):
        make.video(tmp_path / "videos" / f"v{i}.mp4", 20 + i) if i != 1 else None
    made = [
        make_episode(20 + i, seed=i, image_size_hw=SIZE, key=f"e{i}", meta={"uid": f"v{i}"})
        for i in range(3)
    ]
    return Packer(FolderVideos(tmp_path / "videos")), made


def test_missing_videos_are_named_or_skipped(tmp_path):
    (tmp_path / "videos").mkdir()
    packer, made = folder_of(tmp_path)
    packed = list(pack(made, packer, on_missing="skip"))
    assert [episode.key for episode, _ in packed] == ["e0", "e2"]
    assert [PackedClip(members[MP4]).num_frames for _, members in packed] == [20, 22]
    with pytest.raises(VideoNotFoundError, match=r"'v1'.*looked for"):
        list(pack(made, packer))
    with pytest.raises(VideoNotFoundError, match=r"1 of 3 videos are missing; video 'v1'"):
        pack_corpus(made, packer, tmp_path / "corpus", "mine", "train")
    assert not (tmp_path / "corpus").exists()
    long = make_episode(50, image_size_hw=SIZE, key="long", meta={"uid": "v0"})
    with pytest.raises(VideoMismatchError, match="duration"):
        list(pack([long], packer, on_missing="skip"))


@pytest.mark.parametrize("num_procs", [1, 2])
def test_shards_with_pictures_come_back(tmp_path, num_procs):
    (tmp_path / "videos").mkdir()
    packer, made = folder_of(tmp_path)
    report = pack_corpus(
        made, packer, tmp_path / "corpus", "mine", "train", on_missing="skip", num_procs=num_procs
    )
    assert report.missing == ("e1",)
    assert report.corpus.num_episodes == 2
    reader = CorpusReader(tmp_path / "corpus", "mine", "train")
    assert sorted(episode.key for episode in reader) == ["e0", "e2"]
    for i in range(2):
        window = pixel_window(reader, i, 4, 12)
        assert window.episode.allclose(
            replace(reader[i].window(4, 12), image_size_hw=window.images.shape[1:3])
        )
        assert numbers(window.images) == list(range(4, 16))
        assert len(pixel_window(reader, i, size_hw=(24, 32)).images) == reader[i].num_frames
    copies = [Packer(packer.videos)(made[0]), Packer(packer.videos)(made[2])]
    stored = [bytes(reader.member(i, MP4)) for i in range(2)]
    assert sorted(stored) == sorted(copy[MP4] for copy in copies)
    write_corpus(made, tmp_path / "corpus", "labels", "train")
    with pytest.raises(CorpusError, match="expected member mp4, got"):
        pixel_window(CorpusReader(tmp_path / "corpus", "labels", "train"), 0)


def test_a_real_clip(real_dir):
    path = real_dir / "hot3d" / "clip-0.mp4"
    made = replace(make_episode(60, image_size_hw=(512, 512)), timestamps_s=5 + np.arange(60) / 30)
    clip = Packer(path, size_hw=224, gop=16)(made)[MP4]
    window = read_window(made, clip, 21, 16)
    original = VideoAttachment(made, path).frames(21, 16, (224, 224))
    assert window.images.shape == original.shape
    assert np.abs(window.images.astype(int) - original).mean() < 6
