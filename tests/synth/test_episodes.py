"""Clips: labels that are what was drawn, and shards that go on where they stopped."""

import dataclasses
import io
from dataclasses import replace

import cv2
import numpy as np
import pytest

from mint_hub.conventions import KEYPOINT_NAMES
from mint_hub.geometry.camera import fov_vh_to_K, on_screen, project, unproject
from mint_hub.geometry.hand_model import HandModel
from mint_hub.geometry.rigid import inverse, transform_points
from mint_hub.loaders.clips import PackedClip
from mint_hub.synth import episodes
from mint_hub.synth.corruption import Corruption
from mint_hub.synth.episodes import (
    DEPTH_STEP_M,
    labels_of,
    make_episode,
    make_pieces,
    presence_of,
)
from mint_hub.synth.presets import is_bench
from mint_hub.synth.render import Renderer
from mint_hub.synth.scene import make_world
from tests.small_world import SIZE_HW, small_world, two_hands

FRAMES = 6
TIPS = np.array([name.endswith("tip") for name in KEYPOINT_NAMES])


@pytest.fixture(scope="module")
def world():
    return make_world(3, "bench", FRAMES)


@pytest.fixture(scope="module")
def drawn(renderer, world):
    """The world's clip, a perfect camera's, and its frames."""
    with Renderer(world.image_size_hw) as own:
        frames = list(own.frames(world, ("rgb", "depth", "segmentation")))
        visible = np.stack([own.visible_fraction(world, k) for k in range(FRAMES)])
        clip = make_episode(world, own, depth=True, segmentation=True, corruption=Corruption())
        again = make_episode(world, own, depth=True, segmentation=True, corruption=Corruption())
    return clip, frames, visible, again


def test_the_same_world_gives_the_same_bytes(drawn):
    clip, _, _, again = drawn
    assert clip.members == again.members
    assert clip.episode.allclose(again.episode, atol=0)


def test_labels_are_the_worlds(drawn, world):
    episode = drawn[0].episode
    assert np.array_equal(episode.T_camera_from_world, world.T_camera_from_world)
    there = episode.presence
    assert np.array_equal(episode.hand_state[there], world.hands.hand_state[there])
    assert np.allclose(episode.fov_vh_rad, world.fov_vh_rad)
    assert np.array_equal(there, presence_of(world))
    assert episode.text == world.text
    assert episode.meta["synth"]["preset"] == "bench"
    assert is_bench(episode)


def test_presence_score_is_the_visible_share(drawn):
    clip, _, visible, _ = drawn
    assert np.allclose(clip.episode.presence_score, np.clip(visible, 0, 1), atol=1e-6)
    assert not clip.episode.presence_score[~clip.episode.presence].any()


def test_a_hand_whose_skin_alone_is_in_the_picture_has_no_score(renderer):
    """A flat hand moved up until its last joint is a third of a pixel above the picture."""
    world = small_world(1)
    flat = two_hands(world.T_camera_from_world, "flat")
    state = flat.hand_state.copy()
    K = np.asarray(fov_vh_to_K(np.asarray(world.fov_vh_rad), SIZE_HW))
    joints = np.asarray(HandModel.template().keypoints(state.astype(float)))[0, 1]
    state[0, 1, 1] += ((-0.3 - K[1, 2]) / K[1, 1] * joints[:, 2] - joints[:, 1]).min()
    world = dataclasses.replace(world, hands=dataclasses.replace(flat, hand_state=state))
    visible = renderer.visible_fraction(world, 0)
    assert (visible > 0).all()  # the skin of both is in the picture
    episode = make_episode(world, renderer, corruption=Corruption()).episode
    assert episode.presence.tolist() == [[True, False]]
    assert episode.presence_score[0, 1] == 0
    assert episode.presence_score[0, 0] == pytest.approx(visible[0])
    assert episode.presence_score.dtype == np.float32


def test_members_are_the_frames(drawn, world):
    clip, frames, _, _ = drawn
    assert set(clip.members) == {"mp4", "depth.npz", "segmentation.npz"}
    with PackedClip(clip.members["mp4"]) as video:
        images = video.images()
        assert video.fps == 30
    assert images.shape == (FRAMES, *world.image_size_hw, 3)
    error = np.abs(images.astype(int) - np.stack([f.rgb for f in frames]).astype(int))
    assert error.mean() < 4
    depth = np.load(io.BytesIO(clip.members["depth.npz"]))["depth"] * DEPTH_STEP_M
    true = np.stack([f.depth for f in frames])
    near = (true > 0) & (true < 15)
    assert near.mean() > 0.9
    assert np.abs(depth - true)[near].max() <= DEPTH_STEP_M
    segments = np.load(io.BytesIO(clip.members["segmentation.npz"]))["segmentation"]
    assert np.array_equal(segments, np.stack([f.segmentation for f in frames]))


@pytest.fixture(scope="module", params=[("bench", 3), ("bench-ood", 6), ("train", 33)])
def made(request, renderer):
    """A world as it is made, what is drawn of it, and each hand drawn alone."""
    preset, seed = request.param
    world = make_world(seed, preset, 4)
    with Renderer(world.image_size_hw) as own:
        frames = list(own.frames(world, ("depth", "segmentation", "flow")))
        alone = np.stack([own.hand_masks(world, k) for k in range(len(frames))])
    return world, frames, alone


def test_joints_lie_on_the_hand_of_made_worlds(made):
    """The skeleton always; the tips, which are on the surface, within a pixel."""
    world, _, alone = made
    keypoints = HandModel.template().keypoints(world.hands.hand_state.astype(float))
    K = fov_vh_to_K(np.asarray(world.fov_vh_rad), world.image_size_hw)
    exact, near = [], []
    for k, hand in np.argwhere(world.hands.exists):
        uv, z = project(keypoints[k, hand], K)
        uv = uv[on_screen(uv, z, world.image_size_hw)]
        tips = TIPS[on_screen(*project(keypoints[k, hand], K), world.image_size_hw)]
        column, row = np.floor(uv).astype(int).T
        mask = alone[k, hand]
        grown = cv2.dilate(mask.astype(np.uint8), np.ones((3, 3), np.uint8))
        near += list(grown[row, column])
        exact += list(mask[row, column][~tips])
    assert len(exact) > 40
    assert np.mean(exact) == 1.0
    assert np.mean(near) >= 0.99


def test_pose_and_depth_of_made_worlds_agree_from_frame_to_frame(made):
    """What stands still is at the depth, and moves by the flow, that the cameras' motion says."""
    world, frames, _ = made
    T, size = world.T_camera_from_world, world.image_size_hw
    K = fov_vh_to_K(np.asarray(world.fov_vh_rad), size)
    first, last = frames[0], frames[-1]
    row, column = np.nonzero(last.segmentation == 4)
    points = unproject(np.stack([column, row], -1) + 0.5, last.depth[row, column].astype(float), K)
    uv, z = project(transform_points(T[0] @ inverse(T[-1]), points), K)
    seen = on_screen(uv, z, size)
    there = np.floor(uv[seen]).astype(int).T[::-1]
    both = first.segmentation[tuple(there)] == 4
    error = np.abs(first.depth[tuple(there)] - z[seen])[both] / z[seen][both]
    assert both.sum() > 2000
    assert np.median(error) < 0.005
    assert np.mean(error < 0.03) > 0.9
    before, _ = project(transform_points(T[-2] @ inverse(T[-1]), points), K)
    off = np.stack([column, row], -1) + 0.5 - before - last.flow[row, column]
    assert np.median(np.linalg.norm(off, axis=-1)) < 0.01


def test_presence_is_any_joint_in_the_image(world):
    """Counted with a loop over joints, and with hands that are not there."""
    state = world.hands.hand_state.copy()
    state[0, :, 2] = -0.4  # behind the camera
    exists = world.hands.exists.copy()
    exists[1, 0] = False
    changed = dataclasses.replace(world.hands, hand_state=state, exists=exists)
    moved = dataclasses.replace(world, hands=changed)
    joints = HandModel.template().keypoints(state.astype(float))
    height, width = world.image_size_hw
    fx = width / 2 / np.tan(world.fov_vh_rad[1] / 2)
    expected = np.zeros((FRAMES, 2), bool)
    for k in range(FRAMES):
        for hand in range(2):
            for x, y, z in joints[k, hand]:
                u, v = fx * x / z + width / 2, fx * y / z + height / 2
                inside = z > 0.01 and 0 <= u < width and 0 <= v < height
                expected[k, hand] |= inside and exists[k, hand]
    assert np.array_equal(presence_of(moved), expected)
    assert not expected[0].any()


def test_drawn_cameras_differ():
    worlds = [make_world(seed, "train", 1) for seed in range(5)]
    settings = [episodes.draw_corruption(w) for w in worlds]
    assert len(set(settings)) == 5
    assert settings[0] == episodes.draw_corruption(make_world(0, "train", 1))


# --------------------------------------------------------------------------- pieces


def test_a_part_of_a_world_has_the_labels_of_those_frames():
    world = make_world(3, "train", 40)
    whole, part = (labels_of(w, None, Corruption()) for w in (world, world.cut(11, 9)))
    frames = slice(11, 20)
    for name in ("T_camera_from_world", "hand_state", "presence", "fov_vh_rad"):
        np.testing.assert_array_equal(getattr(part, name), getattr(whole, name)[frames], name)
    assert part.meta["synth"]["first_frame"] == 11
    for moving, before in zip(world.cut(11, 9).bodies, world.bodies, strict=True):
        np.testing.assert_array_equal(moving.pose(2), before.pose(13))
    said = {text.id: (text.start + 11, text.end + 11) for text in part.text}
    expected = {t.id: (max(t.start, 11), min(t.end, 20)) for t in whole.text}
    assert said == {key: span for key, span in expected.items() if span[0] < span[1]}
    assert said
    with pytest.raises(ValueError, match="expected frames within 0 to 40, got 35 to 44"):
        world.cut(35, 9)


def test_pieces_are_drawn_as_the_whole_clip_is(renderer):
    """Each in its own part of the clip, and the picture of its first frame is the clip's there."""
    calm = Corruption()
    first, second = make_pieces(5, "train", 2, 2, scale=0.25, samples=0)
    whole = make_world(5, "train")
    at = [clip.episode.meta["synth"]["first_frame"] for clip in (first, second)]
    middle = whole.num_frames / 2
    assert at[0] + 2 <= middle <= at[1] <= whole.num_frames - 2
    assert [c.episode.key for c in (first, second)] == [f"{whole.key}-0", f"{whole.key}-1"]
    np.testing.assert_array_equal(
        second.episode.T_camera_from_world, whole.T_camera_from_world[at[1] : at[1] + 2]
    )
    size = replace(whole.cut(at[1], 2), image_size_hw=second.episode.image_size_hw)
    with Renderer(size.image_size_hw, samples=0) as own:
        again = make_episode(size, own, corruption=None)
        assert make_episode(size, own, corruption=calm).members != again.members
    assert again.members == second.members
