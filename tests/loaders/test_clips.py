"""Clips: what was asked for, the same bytes every time, and windows that are decoded at once."""

import doctest

import av
import numpy as np
import pytest
import torch

from mint_hub.loaders import clips
from mint_hub.loaders.clips import PackedClip, clip_size, decode_window, encode_clip
from mint_hub.loaders.video import VideoError, iter_frames
from tests import video_files as make

SIZE = (48, 64)


def numbers(images):
    return [make.frame_number(image) for image in images]


def pictures(count, size_hw=SIZE):
    return np.stack([make.picture(i, size_hw) for i in range(count)])


@pytest.fixture(scope="module")
def clip() -> bytes:
    return encode_clip(pictures(100))


# ---------------------------------------------------------------- clips


@pytest.mark.parametrize("gop", [1, 8, 16])
def test_a_clip_has_short_gops_its_index_in_front_and_no_b_frames(tmp_path, gop):
    data = encode_clip(iter(pictures(40)), gop=gop)
    assert data.index(b"moov") < data.index(b"mdat")
    path = tmp_path / "clip.mp4"
    path.write_bytes(data)
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        assert stream.codec_context.name == "h264"
        keys = [i for i, entry in enumerate(stream.index_entries) if entry.is_keyframe]
        assert keys == list(range(0, 40, gop))
        packets = [p for p in container.demux(stream) if p.pts is not None]
        assert [p.pts for p in packets] == [p.dts for p in packets]
        assert "encoder" not in container.metadata
    frames = list(iter_frames(path, fps=None))
    assert numbers(f.image for f in frames) == [i % 30 for i in range(40)]
    np.testing.assert_allclose([f.timestamp_s for f in frames], np.arange(40) / 30, atol=1e-5)


def test_the_same_pictures_give_the_same_bytes():
    images = pictures(30)
    assert encode_clip(images) == encode_clip(list(images)) == encode_clip(iter(images))
    assert encode_clip(images) != encode_clip(images, gop=16)


def test_colours_survive():
    rng = np.random.default_rng(0)
    flat = np.repeat(rng.integers(0, 256, (20, 1, 1, 3), dtype=np.uint8), 32, 1).repeat(32, 2)
    back = decode_window(encode_clip(flat, crf=1)).astype(int)
    assert np.abs(back - flat).max() <= 4


def test_a_stretch_of_a_video(tmp_path):
    path = make.video(tmp_path / "long.mp4", 120, rate=60, gop=250)
    for source in (path, path.read_bytes()):
        with PackedClip(encode_clip(source, 0.5, 1.0)) as clip:
            assert (clip.num_frames, clip.fps, clip.image_size_hw) == (15, 30, SIZE)
            assert numbers(clip.images()) == [i % 30 for i in range(30, 60, 2)]


@pytest.mark.parametrize(
    ("size_hw", "source_hw", "expected"),
    [
        (None, (1080, 1920), (1080, 1920)),
        (None, (47, 63), (46, 62)),
        (224, (1080, 1920), (224, 398)),
        (224, (640, 480), (298, 224)),
        ((224, 224), (1080, 1920), (224, 224)),
    ],
)
def test_sizes(size_hw, source_hw, expected):
    assert clip_size(size_hw, source_hw) == expected


def test_odd_sizes_become_even():
    images = pictures(5, (47, 63))
    back = decode_window(encode_clip(images))
    assert back.shape == (5, 46, 62, 3)
    assert numbers(back) == list(range(5))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"gop": 0}, "gop: expected 1 to 250, got 0"),
        ({"crf": 60}, "crf: expected 0 to 51, got 60"),
        ({"fps": 0.0}, "fps: expected frames a second, got 0"),
        ({"size_hw": (47, 64)}, r"size_hw: expected even sizes, as H.264 needs, got \(47, 64\)"),
        ({"size_hw": 0}, r"size_hw: expected at least \(2, 2\)"),
        ({"start_s": 1.0}, "expected only with a video"),
    ],
)
def test_arguments_out_of_range(options, message):
    with pytest.raises(ValueError, match=message):
        encode_clip(pictures(2), **options)


def test_pictures_that_are_none():
    with pytest.raises(VideoError, match="expected pictures to encode, got none"):
        encode_clip([])
    with pytest.raises(ValueError, match=r"expected \(H, W, 3\), got shape \(4, 4\)"):
        encode_clip([np.zeros((4, 4), np.uint8)])
    with pytest.raises(ValueError, match=r"expected uint8 \(4, 4, 3\), got float64 .* at frame 1"):
        encode_clip([np.zeros((4, 4, 3), np.uint8), np.zeros((4, 4, 3))])


# ---------------------------------------------------------------- windows


def test_any_window_shows_its_frames(clip):
    whole = decode_window(clip)
    assert whole.shape == (100, *SIZE, 3)
    rng = np.random.default_rng(0)
    with PackedClip(memoryview(clip)) as opened:
        for start in rng.integers(0, 85, 20).tolist():
            np.testing.assert_array_equal(opened.images(start, 16), whole[start : start + 16])
            np.testing.assert_array_equal(decode_window(clip, start, 16), whole[start : start + 16])
    assert numbers(decode_window(clip, 50, 5, (24, 32))) == [20, 21, 22, 23, 24]
    tensor = decode_window(clip, 98, as_torch=True)
    assert isinstance(tensor, torch.Tensor)
    assert numbers(tensor.numpy()) == [8, 9]


def test_a_window_is_decoded_from_the_key_frame_before_it(clip, monkeypatch):
    decoded = []
    decode_packet = av.Packet.decode
    counting = lambda packet: decoded.append(packet.pts) or decode_packet(packet)  # noqa: E731
    with PackedClip(clip) as opened:
        reader = opened._reader._decoder
        demux = reader.container.demux

        class Counted:
            def __init__(self, packet):
                self.decode = lambda: counting(packet)

        class Container:
            seek, size = reader.container.seek, reader.container.size

            def demux(self, stream):
                return map(Counted, demux(stream))

        monkeypatch.setattr(reader, "container", Container())
        opened.images(85, 8)
    assert len(decoded) == 13  # from the key frame 80 to frame 92


def test_windows_outside_the_clip(clip):
    for start, length in ((-1, 4), (97, 4), (0, 0)):
        with pytest.raises(ValueError, match="0 <= start <= 100 - length, got start"):
            decode_window(clip, start, length)
    with pytest.raises(VideoError, match="not a video"):
        decode_window(b"junk" * 100)


def test_the_examples_in_the_docstring():
    assert doctest.testmod(clips).failed == 0
