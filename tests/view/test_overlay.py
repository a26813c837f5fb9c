from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import pytest

from mint_hub.conventions import KEYPOINT_NAMES
from mint_hub.geometry import hand_state
from mint_hub.geometry.camera import project
from mint_hub.loaders.video import iter_frames, probe
from mint_hub.view import overlay
from mint_hub.view.overlay import draw_overlay, frame_intrinsics, overlay_frames, to_pixels
from tests.episodes import make_episode

GREY = np.full((240, 320, 3), 96, np.uint8)
BETWEEN_CHIPS = slice(32, 208)


def _moved(episode, offset):
    """The episode with its hands moved in the camera frame."""
    state = hand_state.unpack(np.array(episode.hand_state))
    shifted = replace(state, translation=state.translation + np.float32(offset)).pack()
    return replace(episode, hand_state=shifted)


@pytest.fixture(scope="module")
def episode():
    """Hands in the middle of the picture, away from the chips."""
    return _moved(make_episode(16, seed=5), (0, -0.12, 0.05))


@pytest.fixture(scope="module")
def video(tmp_path_factory) -> Path:
    """Sixteen flat frames whose brightness tells their number."""
    path = tmp_path_factory.mktemp("video") / "source.mp4"
    with av.open(path, "w") as container:
        stream = container.add_stream("libx264", rate=30, options={"crf": "1"})
        stream.width, stream.height, stream.pix_fmt = 320, 240, "yuv420p"
        for k in range(16):
            image = np.full((240, 320, 3), 40 + 8 * k, np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, "rgb24")))
        container.mux(stream.encode(None))
    return path


def _changed(a, b):
    return (a != b).any(axis=-1)


def test_pixels_are_those_of_the_cameras_projection(episode):
    joints = episode.joints_camera()
    for k in (0, 9):
        ours = to_pixels(joints[k], episode.K[k])
        theirs, depth = project(joints[k].astype(float), episode.K[k])
        there = episode.presence[k]
        assert (depth[there] > 0).all()
        np.testing.assert_allclose(ours[there], theirs[there], atol=1e-3)
        assert np.isnan(ours[~there]).all()


def test_intrinsics_follow_the_size_of_the_image(episode):
    joints = episode.joints_camera()[0]
    half = to_pixels(joints, frame_intrinsics(episode, GREY, 0))
    np.testing.assert_allclose(2 * half, to_pixels(joints, episode.K[0]), rtol=1e-9)


def test_a_keypoint_is_drawn_where_it_projects(episode):
    drawn = draw_overlay(GREY, episode, 2)
    uv = to_pixels(episode.joints_camera()[2], frame_intrinsics(episode, GREY, 2))
    changed = _changed(drawn, GREY)
    for hand in range(2):
        for name, (u, v) in zip(KEYPOINT_NAMES, uv[hand], strict=True):
            if 0 <= u < 320 and 0 <= v < 240:
                assert changed[int(v), int(u)], (hand, name)


def test_the_hands_are_told_apart_by_colour(episode):
    alone = [
        draw_overlay(GREY, replace(episode, presence=np.eye(2, dtype=bool)[[hand] * 16]), 2)
        for hand in range(2)
    ]
    for hand, (strong, weak) in enumerate(((2, 0), (0, 2))):
        touched = alone[hand][BETWEEN_CHIPS][_changed(alone[hand], GREY)[BETWEEN_CHIPS]]
        assert touched[:, strong].mean() > touched[:, weak].mean() + 25


@pytest.mark.parametrize("mesh", [False, True])
def test_absent_hands_change_no_pixel_but_the_chips(episode, mesh):
    nobody = replace(episode, presence=np.zeros((16, 2), bool))
    drawn = draw_overlay(GREY, nobody, 2, mesh=mesh)
    changed = _changed(drawn, GREY)
    assert changed.any()
    assert not changed[BETWEEN_CHIPS].any()
    elsewhere = _moved(nobody, (0.1, -0.1, 0.2))
    np.testing.assert_array_equal(draw_overlay(GREY, elsewhere, 2, mesh=mesh), drawn)


def test_a_bridged_hand_says_so_in_its_chip(episode):
    filled = np.zeros((16, 2), bool)
    filled[2, 0] = True
    changed = _changed(
        draw_overlay(GREY, replace(episode, filled=filled), 2), draw_overlay(GREY, episode, 2)
    )
    assert changed[:, :160].any()
    assert not changed[:, 160:].any()
    assert not changed[BETWEEN_CHIPS].any()


def test_the_image_given_is_not_drawn_on(episode):
    image = GREY.copy()
    draw_overlay(image, episode, 0, mesh=True)
    np.testing.assert_array_equal(image, GREY)


def test_the_mesh_covers_more_than_the_skeleton(episode):
    thin = _changed(draw_overlay(GREY, episode, 2), GREY)
    thick = _changed(draw_overlay(GREY, episode, 2, mesh=True), GREY)
    assert (thick & ~thin).sum() > 400
    assert (thick | ~thin).all()


@pytest.mark.parametrize("mesh", [False, True])
def test_hands_behind_the_camera_are_not_drawn(episode, mesh):
    behind = _moved(episode, (0, 0, -5))
    changed = _changed(draw_overlay(GREY, behind, 2, mesh=mesh), GREY)
    assert not changed[BETWEEN_CHIPS].any()


@pytest.mark.parametrize("mesh", [False, True])
def test_hands_that_straddle_the_camera_plane_are_cut_there(episode, mesh):
    depth = episode.joints_camera()[2, 1, :, 2]
    straddling = _moved(episode, (0, 0, -float(np.median(depth))))
    drawn = draw_overlay(GREY, straddling, 2, mesh=mesh)
    assert _changed(drawn, GREY).any()


def test_bones_are_cut_at_the_near_plane():
    cut = overlay._cut_behind(np.array([[0.0, 0, 1], [1, 2, -1]]))
    assert cut is not None
    np.testing.assert_allclose(cut, [[0, 0, 1], [0.49, 0.98, overlay.NEAR_M]])
    assert overlay._cut_behind(np.array([[0.0, 0, -1], [1, 2, -1]])) is None


def test_nearer_hands_cover_farther_ones(episode):
    state = hand_state.unpack(np.array(episode.hand_state[2]))
    K = frame_intrinsics(episode, GREY, 2)
    for near in range(2):
        places = np.zeros((2, 3), np.float32)
        places[:, 2] = 0.6
        places[near, 2] = 0.4
        both = replace(state, translation=places).pack()[None]
        frame = replace(episode.window(2, 1), hand_state=both, presence=np.ones((1, 2), bool))
        drawn = draw_overlay(GREY, frame, 0)
        u, v = to_pixels(frame.joints_camera()[0, near, 0], K)
        red, _, blue = drawn[int(v), int(u)].astype(int)
        assert (blue > red) == (near == 0)


@pytest.mark.parametrize(
    ("image", "k", "message"),
    [
        (GREY, 16, r"frame_index: expected 0 \.\. 15, got 16"),
        (GREY, -1, "frame_index"),
        (GREY[:, :200], 0, r"aspect ratio of \(height, width\) \(480, 640\), got \(240, 200\)"),
        (GREY[..., 0], 0, r"expected \(H, W, 3\) uint8, got \(240, 320\)"),
        (GREY.astype(float), 0, "uint8, got .* float64"),
    ],
)
def test_wrong_frames_are_refused(episode, image, k, message):
    with pytest.raises(ValueError, match=message):
        draw_overlay(image, episode, k)


# ------------------------------------------------------------------- video


def _brightness(image):
    return round((float(image[110:130, :20].mean()) - 40) / 8)


def test_frames_are_matched_by_time(episode, video):
    assert [k for k, _ in overlay_frames(episode, video)] == list(range(16))
    assert [_brightness(image) for _, image in overlay_frames(episode, video)] == list(range(16))
    part = list(overlay_frames(episode.window(5, 6), video))
    assert [(k, _brightness(image)) for k, image in part] == [(k, 5 + k) for k in range(6)]
    some = list(overlay_frames(episode, video, only={3, 11}))
    assert [(k, _brightness(image)) for k, image in some] == [(3, 3), (11, 11)]


def test_uneven_timestamps_find_their_frames(episode, video):
    kept = [0, 1, 2, 6, 7, 12]
    uneven = replace(
        episode.window(0, 6), timestamps_s=episode.timestamps_s[kept], meta={"fps": 30.0}
    )
    assert [_brightness(image) for _, image in overlay_frames(uneven, video)] == kept


def test_a_lens_is_undone_first(episode, video):
    lens = {"model": "opencv", "f": 200.0, "distortion": [-0.3, 0.0, 0.0, 0.0]}
    seen = replace(episode, meta={**episode.meta, "lens": lens}, presence=np.zeros((16, 2), bool))
    (_, image) = next(iter(overlay_frames(seen, video, only={8})))
    plain = draw_overlay(np.full((240, 320, 3), 104, np.uint8), seen, 8)
    assert _changed(image, plain).any()
    assert abs(image[100:140, 140:180].astype(int).mean() - 104) < 3


def test_the_overlay_video_has_the_episodes_frames_and_times(episode, video, tmp_path):
    calls = []
    path = overlay.write_overlay(
        episode, video, tmp_path / "out" / "o.mp4", progress=lambda *done: calls.append(done)
    )
    assert calls == [(k + 1, 16) for k in range(16)]
    info = probe(path)
    assert info.image_size_hw == (240, 320)
    assert info.codec in ("h264", "mpeg4")
    times = [frame.timestamp_s for frame in iter_frames(path, fps=None)]
    np.testing.assert_allclose(times, episode.timestamps_s, atol=1e-3)
    back = [frame.image for frame in iter_frames(path, fps=None)]
    for (_, drawn), seen in zip(overlay_frames(episode, video), back, strict=True):
        assert np.abs(drawn.astype(int) - seen).mean() < 4


def test_odd_sizes_lose_a_row_and_a_column(episode, video, tmp_path, monkeypatch):
    odd = [(k, image[:239, :319]) for k, image in overlay_frames(episode, video)]
    monkeypatch.setattr(overlay, "overlay_frames", lambda *_, **__: iter(odd))
    path = overlay.write_overlay(episode, video, tmp_path / "o.mp4")
    assert probe(path).image_size_hw == (238, 318)


def test_a_failing_overlay_leaves_what_was_there(episode, video, tmp_path):
    path = tmp_path / "o.mp4"
    path.write_bytes(b"before")

    def stop(done, _):
        if done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        overlay.write_overlay(episode, video, path, progress=stop)
    assert path.read_bytes() == b"before"
    assert [p.name for p in tmp_path.iterdir()] == ["o.mp4"]


def test_a_video_that_lacks_frames_is_told(episode, video, tmp_path):
    late = replace(episode, timestamps_s=episode.timestamps_s + 10 / 30)
    with pytest.warns(UserWarning, match="10 of 16 frames are not in the video"):
        overlay.write_overlay(late, video, tmp_path / "o.mp4")


def test_only_mp4_is_written(episode, video, tmp_path):
    with pytest.raises(ValueError, match=r"o\.avi: expected a name that ends in \.mp4"):
        overlay.write_overlay(episode, video, tmp_path / "o.avi")


@pytest.mark.real
def test_a_real_clip_is_drawn_over(real_dir, tmp_path):
    clip = real_dir / "hot3d" / "clip-0.mp4"
    episode = make_episode(12, image_size_hw=probe(clip).image_size_hw)
    path = overlay.write_overlay(episode, clip, tmp_path / "o.mp4", mesh=True)
    assert len(list(iter_frames(path, fps=None))) == 12
