"""Video decoding: what comes out, when, and what each bad input says."""

import io
import threading
import weakref
from fractions import Fraction
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import av
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mint_hub.loaders import video
from mint_hub.loaders.video import VideoError, VideoNotFoundError, iter_frames, probe
from tests import video_files as make


def numbers(source, **options):
    return [make.frame_number(frame.image) for frame in iter_frames(source, **options)]


def times(source, **options):
    return [frame.timestamp_s for frame in iter_frames(source, **options)]


@pytest.fixture(scope="module")
def clip(tmp_path_factory) -> Path:
    return make.video(tmp_path_factory.mktemp("video") / "clip.mp4")


# ---------------------------------------------------------------- what comes out


def test_every_frame_comes_out_once_and_in_order(clip):
    frames = list(iter_frames(clip))
    assert [f.index for f in frames] == list(range(30))
    assert [f.source_index for f in frames] == list(range(30))
    assert [make.frame_number(f.image) for f in frames] == list(range(30))
    assert frames[0].image.shape == (48, 64, 3)
    assert frames[0].image.dtype == np.uint8
    assert frames[0].image.flags.c_contiguous
    np.testing.assert_allclose([f.timestamp_s for f in frames], np.arange(30) / 30, atol=1e-9)
    np.testing.assert_allclose(
        [f.source_timestamp_s for f in frames], np.arange(30) / 30, atol=1e-4
    )


def test_colours_are_rgb(clip):
    image = next(iter(iter_frames(clip))).image.astype(int)
    np.testing.assert_allclose(image[2, 2], make.RED, atol=25)
    np.testing.assert_allclose(image[-3, -3], make.BLUE, atol=25)
    np.testing.assert_allclose(image[24, 32], make.grey(0), atol=3)


def test_probe(clip):
    info = probe(clip)
    assert info.source == str(clip)
    assert info.image_size_hw == (48, 64)
    assert info.fps == 30
    assert info.duration_s == pytest.approx(1.0)
    assert info.num_frames == 30
    assert (info.rotation_deg, info.mirrored, info.sample_aspect_ratio) == (0, False, 1.0)
    assert info.codec == "h264"
    assert info.start_time_s == 0


@pytest.mark.parametrize("num_threads", [1, 2, "auto"])
def test_threads_do_not_change_the_answer(clip, num_threads):
    reference = [f.image for f in iter_frames(clip, num_threads=1)]
    np.testing.assert_array_equal(
        [f.image for f in iter_frames(clip, num_threads=num_threads)], reference
    )


def test_sources_agree(clip, tmp_path):
    reference = [f.image for f in iter_frames(clip)]
    odd_name = tmp_path / "a:b%03d.mp4"
    odd_name.write_bytes(clip.read_bytes())
    data = clip.read_bytes()
    with clip.open("rb") as file:
        file.read(100)
        sources = {
            "str": str(clip),
            "bytes": data,
            "memoryview": memoryview(data),
            "BytesIO": io.BytesIO(data),
            "file": file,
            "file url": clip.as_uri(),
            "undecoded bytes": {"path": None, "bytes": data},
            "undecoded path": {"path": str(clip), "bytes": None},
            "odd name": odd_name,
        }
        for name, source in sources.items():
            images = [f.image for f in iter_frames(source)]
            np.testing.assert_array_equal(images, reference, err_msg=name)
        assert not file.closed


@pytest.fixture
def server(clip):
    handler = partial(SimpleHTTPRequestHandler, directory=str(clip.parent))
    handler.func.log_message = lambda *_: None
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as httpd:
        thread = threading.Thread(target=httpd.serve_forever, daemon=True)
        thread.start()
        yield f"http://127.0.0.1:{httpd.server_port}"
        httpd.shutdown()
        thread.join()


def test_http(server, clip):
    assert numbers(f"{server}/{clip.name}") == list(range(30))
    with pytest.raises(VideoNotFoundError, match=r"/nowhere\.mp4: nothing there"):
        iter_frames(f"{server}/nowhere.mp4")


# ---------------------------------------------------------------- when


@pytest.mark.parametrize(
    ("rate", "count", "expected"),
    [
        (60, 20, [0, 2, 4, 6, 8, 10, 12, 14, 16, 18]),
        (60, 21, [0, 2, 4, 6, 8, 10, 12, 14, 16, 18, 20]),
        (15, 5, [0, 0, 1, 1, 2, 2, 3, 3, 4, 4]),
        (24, 8, [0, 1, 2, 2, 3, 4, 5, 6, 6, 7]),
        (30, 10, list(range(10))),
    ],
)
def test_resampling_to_thirty(tmp_path, rate, count, expected):
    path = make.video(tmp_path / "clip.mp4", count, rate=rate)
    assert numbers(path) == expected
    np.testing.assert_allclose(times(path), np.arange(len(expected)) / 30, atol=1e-9)
    assert numbers(path, fps=None) == list(range(count))
    np.testing.assert_allclose(times(path, fps=None), np.arange(count) / rate, atol=1e-3)


def test_variable_rate_keeps_the_map_to_source_times(tmp_path):
    path = make.vfr(tmp_path / "phone.mkv", [0, 20, 90, 100, 400, 433])
    frames = list(iter_frames(path))
    assert [f.source_index for f in frames] == [0, 1, 2, 3, 3, 3, 3, 3, 4, 4, 4, 4, 4, 5]
    stored = np.array([0, 0.02, 0.09, 0.1, 0.4, 0.433])
    for frame in frames:
        assert abs(frame.source_timestamp_s - stored[frame.source_index]) < 1e-6
        distances = np.abs(stored - frame.timestamp_s)
        assert distances[frame.source_index] <= distances.min() + 2e-6
    np.testing.assert_allclose(times(path, fps=None), stored, atol=1e-6)


@settings(deadline=None, max_examples=60)
@given(
    gaps=st.lists(st.integers(1, 300), min_size=0, max_size=12),
    fps=st.sampled_from([5.0, 24.0, 30.0, 29.97, 60.0]),
    t0_ms=st.integers(0, 1000),
)
def test_grid_law(gaps, fps, t0_ms):
    """Every output shows the stored frame nearest in time, on the grid, to the end."""
    stored_ms = np.cumsum([0, *gaps])
    stored = [video.Stored(ms / 1000, 0.02, i, None) for i, ms in enumerate(stored_ms)]
    t0 = t0_ms / 1000
    picks = list(video._grid(iter(stored), t0, fps))
    end = stored[-1].time_s + 0.02
    if t0 >= end:
        assert picks == []
        return
    np.testing.assert_allclose([t for t, _ in picks], t0 + np.arange(len(picks)) / fps)
    limit = end - min(1 / fps, 0.02) / 2 - 1e-6
    assert len(picks) == max(1, np.ceil((limit - t0) * fps))
    for t, item in picks:
        assert abs(t - item.time_s) <= np.abs(stored_ms / 1000 - t).min() + 2e-6


def test_interval(clip):
    assert numbers(clip, start_s=0.5, stop_s=0.7) == [15, 16, 17, 18, 19, 20]
    assert numbers(clip, fps=None, start_s=0.5, stop_s=0.65) == [15, 16, 17, 18, 19]
    assert numbers(clip, start_s=-1.0, stop_s=0.1) == [0, 1, 2]


def test_intervals_tile_a_long_video(tmp_path):
    path = make.video(tmp_path / "long.mp4", 400, gop=50)
    whole = [f.source_timestamp_s for f in iter_frames(path)]
    parts = [
        f.source_timestamp_s
        for start in range(0, 13, 4)
        for f in iter_frames(path, start_s=start, stop_s=start + 4)
    ]
    assert len(whole) == 400
    assert parts == whole


def test_one_frame(tmp_path):
    path = make.video(tmp_path / "one.mp4", 1)
    assert numbers(path) == numbers(path, fps=None) == [0]


def test_b_frames_and_negative_decoding_times(tmp_path):
    path = make.b_frames(tmp_path / "b.mp4")
    with av.open(str(path)) as container:
        decoding = [p.dts for p in container.demux(video=0) if p.dts is not None]
    assert min(decoding) < 0
    assert numbers(path) == list(range(30))
    assert probe(path).start_time_s == 0


@pytest.mark.parametrize("suffix", [".ts", ".mkv"])
def test_a_clock_that_does_not_start_at_zero(tmp_path, suffix):
    path = make.late_start(tmp_path / f"late{suffix}", 5000)
    assert probe(path).start_time_s == pytest.approx(5.0)
    assert numbers(path) == list(range(30))
    np.testing.assert_allclose(times(path), 5 + np.arange(30) / 30, atol=1e-3)
    assert numbers(path, start_s=5.3, stop_s=5.4) == [9, 10, 11]


# ---------------------------------------------------------------- what a player would show


@pytest.mark.parametrize("degrees", [0, 90, 180, 270])
@pytest.mark.parametrize("hflip", [False, True])
def test_rotation_metadata(tmp_path, degrees, hflip):
    upright = next(iter(iter_frames(make.rotated(tmp_path / "plain.mp4", 0)))).image
    path = make.rotated(tmp_path / "phone.mp4", degrees, hflip=hflip)
    info = probe(path)
    image = next(iter(iter_frames(path))).image
    stored = upright[:, ::-1] if info.mirrored else upright
    np.testing.assert_array_equal(image, np.rot90(stored, info.rotation_deg // 90))
    assert info.mirrored == hflip
    assert info.image_size_hw == image.shape[:2]
    if not hflip:
        assert info.rotation_deg == degrees


def test_a_crooked_angle_is_rounded_with_a_warning(tmp_path):
    frames = iter_frames(make.rotated(tmp_path / "crooked.mp4", 80))
    assert frames.info.rotation_deg == 90
    assert frames.warnings == [
        f"{tmp_path / 'crooked.mp4'}: its turn of 80 degrees was taken as 90"
    ]


@pytest.mark.parametrize(("aspect", "width"), [(Fraction(3, 2), 96), (Fraction(3, 4), 48)])
def test_pixels_come_out_square(tmp_path, aspect, width):
    path = make.wide_pixels(tmp_path / "wide.mp4", aspect)
    info = probe(path)
    assert info.image_size_hw == (48, width)
    assert info.sample_aspect_ratio == pytest.approx(float(aspect))
    images = [f.image for f in iter_frames(path)]
    assert {image.shape for image in images} == {(48, width, 3)}
    assert [make.frame_number(image) for image in images] == list(range(6))
    np.testing.assert_allclose(images[0][2, width // 4 - 4].astype(int), make.RED, atol=25)


def test_deep_colour_and_odd_sizes(tmp_path):
    assert numbers(make.deep_colour(tmp_path / "deep.mp4")) == list(range(6))
    odd = make.video(tmp_path / "odd.mp4", 5, (47, 63), pix_fmt="yuv444p")
    assert probe(odd).image_size_hw == (47, 63)
    assert numbers(odd) == list(range(5))


# ---------------------------------------------------------------- bad input


def folder(path):
    path.mkdir()
    return path


def text(path):
    path = path.with_suffix(".txt")
    path.write_text("not a video\n" * 200)
    return path


def written(data):
    def write(path):
        path.write_bytes(data)
        return path

    return write


BAD = {
    "missing": (lambda path: path, VideoNotFoundError, "no such file"),
    "folder": (folder, VideoError, "a folder, expected a video file"),
    "text": (text, VideoError, "not a video, but text"),
    "junk": (written(b"\x01\x02junk" * 500), VideoError, "not a video"),
    "empty": (written(b""), VideoError, "not a video, but empty"),
    "audio only": (make.audio_only, VideoError, r"no video stream; it holds audio \(aac\)"),
    "no frames": (
        lambda path: make.no_frames(path.with_suffix(".mkv")),
        VideoError,
        "its video stream holds no frames",
    ),
    "cut, index lost": (make.cut_without_index, VideoError, "cut short: an mp4 without its index"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_has_one_error_that_names_the_file(tmp_path, case):
    prepare, error, message = BAD[case]
    path = prepare(tmp_path / "bad.mp4")
    for read in (probe, iter_frames, lambda path: iter_frames(str(path), fps=None)):
        with pytest.raises(VideoError, match=message) as caught:
            read(path)
        assert type(caught.value) is error
        assert str(caught.value).startswith(f"{path}: ")


def test_not_found_is_also_pythons_own(tmp_path):
    with pytest.raises(FileNotFoundError):
        iter_frames(tmp_path / "none.mp4")


@pytest.mark.parametrize("num_threads", [1, 2, "auto"])
@pytest.mark.parametrize(
    ("prepare", "place", "why"),
    [
        (make.damaged, 30, "Invalid data"),
        (make.cut_with_index, 20, "cut short|Invalid data"),
    ],
)
def test_damage_in_the_middle(tmp_path, prepare, place, why, num_threads):
    path = prepare(tmp_path / "damaged.mp4")
    came = []
    frames = iter_frames(path, num_threads=num_threads)
    with pytest.raises(VideoError, match=why) as caught:
        came.extend(make.frame_number(frame.image) for frame in frames)
    assert str(caught.value).startswith(f"{path}: damaged at frame ")
    assert place - 6 <= len(came) <= place + 4

    frames = iter_frames(path, num_threads=num_threads, on_error="stop")
    kept = [make.frame_number(frame.image) for frame in frames]
    assert place - 4 <= len(kept) <= place + 4
    assert kept == [i % 30 for i in range(len(kept))]
    assert [w for w in frames.warnings if w.startswith(f"{path}: damaged at frame ")]


def test_an_undamaged_video_gives_no_warning(clip):
    frames = iter_frames(clip, on_error="stop")
    assert len(list(frames)) == 30
    assert frames.warnings == []


def test_file_objects_that_cannot_be_read(clip):
    with clip.open() as file, pytest.raises(VideoError, match=rf"{clip.name}.*'rb'"):
        iter_frames(file)
    with pytest.raises(VideoError, match="int: expected a path"):
        iter_frames(3)
    with pytest.raises(VideoError, match=r"'bytes' or 'path', got keys \['url'\]"):
        iter_frames({"url": "x"})

    class Pipe(io.BytesIO):
        name = "the pipe"

        def seekable(self):
            return False

    with pytest.raises(VideoError, match="the pipe: a file object that cannot seek"):
        iter_frames(Pipe(clip.read_bytes()))


def test_urls_that_cannot_be_fetched(tmp_path):
    with pytest.raises(VideoError, match=r"^gopherz://x/y\.mp4: cannot be fetched"):
        iter_frames("gopherz://x/y.mp4")
    with pytest.raises(VideoNotFoundError, match=r"^file://.*none\.mp4: nothing there"):
        iter_frames((tmp_path / "none.mp4").as_uri())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"fps": 0}, "fps: expected a positive number or None, got 0"),
        ({"fps": float("nan")}, "fps"),
        ({"start_s": float("inf")}, "start_s"),
        ({"start_s": 2.0, "stop_s": 1.0}, r"stop_s: expected more than start_s=2\.0, got 1\.0"),
        ({"num_threads": 0}, "num_threads"),
        ({"on_error": "ignore"}, "on_error"),
    ],
)
def test_arguments_out_of_range(clip, options, message):
    with pytest.raises(ValueError, match=message):
        iter_frames(clip, **options)


def test_an_interval_outside_the_video(clip):
    for options in ({"start_s": 5.0}, {"stop_s": -1.0}, {"start_s": 5.0, "fps": None}):
        with pytest.raises(VideoError, match=rf"{clip.name}: no frame between start_s=") as caught:
            list(iter_frames(clip, **options))
        assert "starts at 0.000 s, is 1.000 s long" in str(caught.value)


def test_memory_does_not_grow_with_length(tmp_path):
    frames = iter_frames(make.video(tmp_path / "long.mp4", 200), num_threads=1)
    alive, most = [], 0
    for frame in frames:
        alive = [ref for ref in alive if ref() is not None] + [weakref.ref(frame.image)]
        most = max(most, len(alive))
    assert frame.index == 199
    assert most <= 3


def test_closing_ends_iteration(clip):
    with iter_frames(clip) as frames:
        next(frames)
    assert list(frames) == []


# ---------------------------------------------------------------- real clips


@pytest.mark.real
@pytest.mark.parametrize(
    ("name", "count", "size_hw"),
    [
        ("hot3d/clip-0.mp4", 450, (512, 512)),
        ("hot3d/clip-1.mp4", 450, (512, 512)),
        ("hot3d/clip-2.mp4", 450, (512, 512)),
        ("hot3d/clip-3.mp4", 450, (512, 512)),
        ("hawor/video_0.mp4", 121, (1080, 1920)),
        ("ego4d/03cc49c3-a7d1-445b-9a2a-545c4fae6843.mp4", 25, (368, 480)),
    ],
)
def test_real_clips(real_dir, name, count, size_hw):
    frames = iter_frames(real_dir / name)
    assert frames.info.image_size_hw == size_hw
    drift = [abs(f.timestamp_s - f.source_timestamp_s) for f in frames]
    assert len(drift) == count
    assert max(drift) < 1e-3
    assert frames.warnings == []
