"""Frames at given times: the nearest stored one whatever was asked before, from open decoders."""

import os
import pickle

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mint_hub.loaders.video import VideoError, VideoNotFoundError, iter_frames
from mint_hub.loaders.video_reader import DecoderCache, VideoReader, shared_decoders
from tests import video_files as make

KINDS = {
    "long GOP": lambda path: make.video(path / "a.mp4", 120, gop=250),
    "short GOP": lambda path: make.video(path / "b.mp4", 120, gop=8, options={"bf": "0"}),
    "B-frames": lambda path: make.video(path / "c.mp4", 120, gop=30, options={"bf": "3"}),
    "variable rate": lambda path: make.vfr(
        path / "d.mkv", np.cumsum(np.random.default_rng(0).integers(4, 80, 120)).tolist()
    ),
    "late clock": lambda path: make.late_start(path / "e.ts", 5000),
}


@pytest.fixture(scope="module", params=KINDS)
def stored(request, tmp_path_factory):
    """A video's path with the time and picture of each of its stored frames."""
    path = KINDS[request.param](tmp_path_factory.mktemp("video"))
    frames = list(iter_frames(path, fps=None))
    return path, np.array([f.timestamp_s for f in frames]), [f.image for f in frames]


@settings(deadline=None, max_examples=15)
@given(data=st.data(), threads=st.sampled_from([1, "auto"]))
def test_the_nearest_frame_comes_whatever_was_asked_before(stored, data, threads):
    path, times, images = stored
    with VideoReader(path, threads) as reader:
        for _ in range(4):
            start = data.draw(st.floats(times[0] - 0.2, times[-1] + 0.2))
            step = data.draw(st.sampled_from([1 / 30, 1 / 60, 0.1, 0.0]))
            asked = start + step * np.arange(data.draw(st.integers(1, 20)))
            got = reader.at(asked)
            nearest = np.abs(times - asked[:, None]).min(axis=1)
            np.testing.assert_allclose(
                np.abs(got.source_timestamps_s - asked), nearest, atol=5.1e-4
            )
            which = np.searchsorted(times, got.source_timestamps_s - 1e-6)
            np.testing.assert_array_equal(got.images, [images[i] for i in which])


def test_exact_times_give_exactly_the_stored_frames(stored):
    path, times, images = stored
    with VideoReader(path) as reader:
        for i in reversed(range(len(times))):
            np.testing.assert_array_equal(reader.at([times[i]]).images[0], images[i])


def test_streams_from_the_middle_show_whole_pictures(tmp_path):
    """A transport stream can be entered between key frames; what is decoded there is not shown."""
    path = make.video(tmp_path / "a.ts", 200, options={"bf": "3"}, gop=20)
    whole = list(iter_frames(path, fps=None))
    for k in range(40, 200, 13):
        start_s = whole[k].timestamp_s
        with iter_frames(path, fps=None, start_s=start_s) as frames:
            frame = next(frames)
        assert frame.timestamp_s == start_s
        np.testing.assert_array_equal(frame.image, whole[k].image)


def test_images_come_at_the_size_wanted(tmp_path):
    path = make.video(tmp_path / "a.mp4")
    with VideoReader(path) as reader:
        for size in ((24, 32), (96, 128), (30, 64)):
            images = reader.at([0.1, 0.2], size).images
            assert images.shape == (2, *size, 3)
            assert [make.frame_number(image) for image in images] == [3, 6]
    with VideoReader(make.rotated(tmp_path / "phone.mp4", 90)) as reader:
        assert reader.info.image_size_hw == (64, 48)
        small = reader.at([0.0], (32, 24)).images[0].astype(int)
        whole = reader.at([0.0]).images[0][::2, ::2].astype(int)
        assert np.abs(small - whole).mean() < 8


def test_times_that_make_no_sense(tmp_path):
    with VideoReader(make.video(tmp_path / "a.mp4")) as reader:
        for times in ([], [[0.0]], [float("nan")]):
            with pytest.raises(ValueError, match=r"times_s: expected \(N,\) finite seconds"):
                reader.at(times)
        with pytest.raises(ValueError, match="do not decrease"):
            reader.at([0.2, 0.1])
    with pytest.raises(ValueError, match="closed"):
        reader.at([0.0])


def test_damage_is_told_and_what_comes_before_it_can_still_be_read(tmp_path):
    path = make.damaged(tmp_path / "damaged.mp4")
    with VideoReader(path, 1) as reader:
        for _ in range(2):
            with pytest.raises(VideoError, match="damaged at"):
                reader.at(np.arange(25, 40) / 30)
            assert make.frame_number(reader.at([0.1]).images[0]) == 3


# ---------------------------------------------------------------- kept open


def test_the_oldest_reader_is_closed_first(tmp_path):
    paths = [make.video(tmp_path / f"{i}.mp4", 3) for i in range(3)]
    decoders = DecoderCache(keep_open=2)
    kept = []
    for path in (paths[0], paths[1], paths[0], paths[2], paths[0]):
        with decoders.reader(path) as reader:
            kept.append(reader)
    assert kept[0] is kept[2] is kept[4]
    assert len(decoders) == 2
    with pytest.raises(ValueError, match="closed"):
        kept[1].at([0.0])
    decoders.close()
    assert len(decoders) == 0
    with decoders.reader(str(paths[0])) as reader:
        assert reader.at([0.0]).images.shape == (1, 48, 64, 3)


def test_a_changed_file_is_opened_anew(tmp_path):
    path = make.video(tmp_path / "a.mp4", 3)
    decoders = DecoderCache()
    with decoders.reader(path) as before:
        assert before.info.num_frames == 3
    make.video(path, 5)
    os.utime(path, ns=(1, 1))
    with decoders.reader(path) as after:
        assert after.info.num_frames == 5


def test_what_fails_or_cannot_be_named_is_not_kept(tmp_path):
    decoders = DecoderCache()
    with pytest.raises(VideoNotFoundError), decoders.reader(tmp_path / "none.mp4"):
        pass
    damaged = make.damaged(tmp_path / "damaged.mp4")
    with pytest.raises(VideoError), decoders.reader(damaged) as reader:
        reader.at(np.arange(60) / 30)
    with decoders.reader(make.video(tmp_path / "a.mp4").read_bytes()) as reader:
        assert make.frame_number(reader.at([0.2]).images[0]) == 6
    assert len(decoders) == 0


def test_a_copy_for_another_process_starts_empty(tmp_path):
    decoders = DecoderCache(keep_open=3, num_threads=1)
    with decoders.reader(make.video(tmp_path / "a.mp4", 3)):
        pass
    copy = pickle.loads(pickle.dumps(decoders))
    assert (len(decoders), len(copy)) == (1, 0)
    assert shared_decoders() is shared_decoders()
    with pytest.raises(ValueError, match="keep_open"):
        DecoderCache(0)
