"""A lens bends the picture, and what is said of the clip stays true of it."""

import dataclasses
import io

import cv2
import numpy as np
import pytest

from mint_hub.conventions import KEYPOINT_NAMES
from mint_hub.geometry.camera import fov_vh_to_K
from mint_hub.geometry.hand_model import HandModel
from mint_hub.geometry.lenses import KannalaBrandtLens, Lens, OpenCVLens, rectification
from mint_hub.loaders.clips import decode_window
from mint_hub.synth.corpus import synthesise
from mint_hub.synth.corruption import Corruption, corrupt, covering_fov
from mint_hub.synth.episodes import DEPTH_STEP_M, make_clip, make_episode, presence_of
from mint_hub.synth.lensing import TALLEST_RAD, Bend, draw_lens, pinhole_of, seen_through
from mint_hub.synth.presets import fingerprint, is_bench
from mint_hub.synth.render import Renderer
from tests.small_world import FOV_VH_RAD, SIZE_HW, moving_camera, small_world, two_hands

FRAMES = 3
TIPS = np.array([name.endswith("tip") for name in KEYPOINT_NAMES])
FOCAL = (SIZE_HW[1] / 2 / np.tan(FOV_VH_RAD[1] / 2),) * 2
MIDDLE = ((SIZE_HW[1] - 1) / 2, (SIZE_HW[0] - 1) / 2)
LENSES = (
    OpenCVLens(SIZE_HW, *FOCAL, *MIDDLE, (-0.17, 0.03, 0.008, -0.006)),
    KannalaBrandtLens(SIZE_HW, *FOCAL, *MIDDLE, (0.2, 0.08, 0.03, 0.01)),
)


@pytest.fixture(scope="module", params=LENSES, ids=lambda lens: lens.model)
def lens(request, renderer) -> Lens:
    return request.param


def pixels(lens: Lens, points: np.ndarray) -> np.ndarray:
    """OpenCV's own projection, integers at pixels' middles."""
    flat = points.reshape(-1, 1, 3).astype(np.float64)
    zero = np.zeros(3)
    numbers = np.array(lens.distortion)
    if isinstance(lens, KannalaBrandtLens):
        uv = cv2.fisheye.projectPoints(flat, zero, zero, lens.K, numbers)[0]
    else:
        uv = cv2.projectPoints(flat, zero, zero, lens.K, numbers)[0]
    return uv.reshape(*points.shape[:-1], 2)


@pytest.fixture(scope="module")
def bent(lens):
    """A small world through a lens: the world, its drawn frames and what the lens makes of them."""
    world = seen_through(small_world(FRAMES, fov_vh_rad=FOV_VH_RAD), lens)
    with Renderer(world.image_size_hw) as own:
        drawn = list(own.frames(world, ("rgb", "depth", "segmentation")))
        masks = [Bend(world).masks(own.hand_masks(world, k)) for k in range(FRAMES)]
        visible = [Bend(world).masks(own.hand_masks(world, k, dressed=True)) for k in range(FRAMES)]
        clip = make_episode(
            world, own, depth=True, segmentation=True, corruption=Corruption(shutter=0.1, crf=8)
        )
    filmed = list(corrupt(drawn, Corruption(), 0, lens, world.fov_vh_rad))
    return world, filmed, np.stack(masks), np.stack(visible), clip


def test_what_is_drawn_covers_the_lens_and_is_no_coarser(bent, lens):
    world, filmed, *_ = bent
    assert all((frame.segmentation > 0).all() for frame in filmed)
    assert filmed[0].rgb.shape == (*SIZE_HW, 3)
    K = fov_vh_to_K(np.array(world.fov_vh_rad), world.image_size_hw)
    assert K[0, 0] >= 0.999 * lens.fx
    assert K[1, 1] >= 0.999 * lens.fy
    assert np.prod(world.image_size_hw) < 3 * np.prod(SIZE_HW)


def test_joints_through_the_lens_lie_on_the_bent_hand(lens):
    """In many poses of the wrist, some at the picture's corners, where lenses bend most."""
    count = 12
    turns = np.random.default_rng(2).uniform(-0.6, 0.6, (count, 2, 3))
    hands = two_hands(moving_camera(count), turns=turns)
    model = HandModel.template()
    state = hands.hand_state.copy()
    shift = np.linspace(-0.25, 0.25, count)
    state[..., 0] += shift[:, None]
    state[..., 1] += shift[::-1, None] * 0.7
    hands = dataclasses.replace(hands, hand_state=state)
    world = seen_through(small_world(count, hands=hands), lens)
    uv = pixels(lens, np.asarray(model.keypoints(state)))
    plain = HandModel.template().keypoints(state.astype(float))
    K = fov_vh_to_K(np.array(FOV_VH_RAD), SIZE_HW)
    straight = plain[..., :2] / plain[..., 2:] * FOCAL + K[:2, 2] - 0.5
    exact, near, moved = [], [], []
    with Renderer(world.image_size_hw) as own:
        for k in range(count):
            masks = Bend(world).masks(own.hand_masks(world, k))
            for hand, mask in enumerate(masks):
                column, row = np.round(uv[k, hand]).astype(int).T
                inside = (column >= 0) & (row >= 0)
                inside &= (column < SIZE_HW[1]) & (row < SIZE_HW[0])
                grown = cv2.dilate(mask.astype(np.uint8), np.ones((3, 3), np.uint8))
                near += list(grown[row[inside], column[inside]])
                skeleton = inside & ~TIPS
                exact += list(mask[row[skeleton], column[skeleton]])
                moved += list(np.linalg.norm(uv - straight, axis=-1)[k, hand, inside])
    assert len(exact) > 200
    assert np.mean(exact) >= 0.995
    assert np.mean(near) >= 0.995
    assert np.max(moved) > 3  # a pinhole's pixels would be wrong


def test_depth_and_segments_are_of_the_ray_of_each_pixel(bent, lens):
    """Points from bent depth, in the frame a pinhole draws, are where its depth is."""
    world, filmed, *_, clip = bent
    depth = np.load(io.BytesIO(clip.members["depth.npz"]))["depth"] * DEPTH_STEP_M
    segments = np.load(io.BytesIO(clip.members["segmentation.npz"]))["segmentation"]
    np.testing.assert_array_equal(segments, np.stack([f.segmentation for f in filmed]))
    assert depth.shape == segments.shape == (FRAMES, *SIZE_HW)
    floor = np.asarray(world.T_camera_from_world[0])
    grid = np.stack(np.meshgrid(np.arange(SIZE_HW[1]), np.arange(SIZE_HW[0])), -1).astype(float)
    rays = lens.unproject(grid)
    points = rays / rays[..., 2:] * depth[0][..., None]
    up = (points - floor[:3, 3]) @ floor[:3, :3]
    heights = up[segments[0] == 4][:, 2]
    known = np.abs(heights[:, None] - [0.0, 0.75]).min(1)  # of the floor and the table
    wall = np.abs(up[segments[0] == 4][:, 1] - 1.6)
    assert np.mean(np.minimum(known, wall) < 0.01) > 0.85


def test_rectifying_gives_the_pinholes_picture_back(bent, lens):
    filmed = bent[1]
    fix = rectification(lens)
    with Renderer(SIZE_HW) as plain:
        (first, *_) = plain.frames(small_world(FRAMES))
    inner = cv2.erode(fix.valid.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    assert inner.mean() > 0.6
    undone, whole = (fix.apply(filmed[0].rgb)[inner], first.rgb[inner])
    left = np.abs(undone.astype(int) - whole).mean()
    without = np.abs(filmed[0].rgb[inner].astype(int) - whole).mean()
    assert left < 3.5
    assert left < 0.4 * without


def test_labels_are_those_of_the_pinhole_of_rectifying(bent, lens):
    episode = bent[-1].episode
    assert Lens.from_dict(episode.meta["synth"]["lens"]) == lens
    assert episode.image_size_hw == SIZE_HW
    np.testing.assert_allclose(episode.fov_vh_rad[0], FOV_VH_RAD, rtol=1e-6)
    K = rectification(lens).K
    np.testing.assert_allclose(episode.K[0][[0, 1], [0, 1]], K[[0, 1], [0, 1]], rtol=1e-5)
    np.testing.assert_allclose(episode.K[0][:2, 2], K[:2, 2] + 0.5)
    images = decode_window(bent[-1].members["mp4"], 0, FRAMES)
    assert images.shape == (FRAMES, *SIZE_HW, 3)


def test_presence_and_visible_share_are_those_of_the_picture(bent, lens):
    world, filmed, _, alone, clip = bent
    uv = pixels(lens, np.asarray(HandModel.template().keypoints(world.hands.hand_state)))
    inside = ((uv >= -0.5) & (uv < np.array(SIZE_HW[::-1]) - 0.5)).all(-1)
    np.testing.assert_array_equal(clip.episode.presence, inside.any(-1))
    seen = [[(f.segmentation == label).sum() for label in (1, 2)] for f in filmed]
    np.testing.assert_allclose(clip.episode.presence_score, seen / alone.sum((2, 3)), rtol=1e-6)


def test_a_hand_that_only_the_lens_sees_is_present(lens):
    """A barrel shows more than its rectified picture: beyond its edge hands are still seen."""
    world = small_world(1)
    state = world.hands.hand_state.copy()
    joints = np.asarray(HandModel.template().keypoints(state.astype(float)))[0, 1]
    edge = np.tan(FOV_VH_RAD[1] / 2)
    state[0, 1, 0] += (1.02 * edge * joints[:, 2] - joints[:, 0]).max()  # all are past the edge
    moved = dataclasses.replace(world.hands, hand_state=state)
    world = dataclasses.replace(world, hands=moved)
    assert not presence_of(world)[0, 1]
    assert presence_of(seen_through(world, lens))[0, 1]


# ------------------------------------------------------------------------------- drawing


def test_a_share_of_clips_gets_a_lens_and_the_rest_of_the_clip_does_not_care():
    world = small_world(1)
    worlds = [dataclasses.replace(world, seed=seed) for seed in range(400)]
    half, most = ([draw_lens(w, share) for w in worlds] for share in (0.5, 0.9))
    assert 0.42 < np.mean([lens is not None for lens in half]) < 0.58
    assert all(few is None or few == many for few, many in zip(half, most, strict=True))
    assert all(draw_lens(w, 0.0) is None for w in worlds)
    kinds = [type(lens) for lens in half if lens is not None]
    assert 0.15 < np.mean([kind is KannalaBrandtLens for kind in kinds]) < 0.35
    assert len(set(half) - {None}) > 150
    np.testing.assert_allclose(pinhole_of(worlds[0])[0], worlds[0].fov_vh_rad)


@pytest.mark.parametrize(
    ("size", "fov_h"),
    [((48, 64), 0.9), ((48, 64), 1.7), ((36, 64), 1.9), ((54, 54), 0.9), ((54, 54), 1.45)],
)
def test_drawn_lenses_are_mild_and_see_no_more_than_may_be_seen(size, fov_h):
    fov = (2 * float(np.arctan(np.tan(fov_h / 2) * size[0] / size[1])), fov_h)
    world = small_world(1, image_size_hw=size, fov_vh_rad=fov)
    for seed in range(40):
        at = dataclasses.replace(world, seed=seed)
        lens = draw_lens(at, 1.0)
        assert lens is not None
        assert covering_fov(lens)[0] <= TALLEST_RAD
        wider = seen_through(at, lens)
        assert np.prod(wider.image_size_hw) < 3.5 * np.prod(size)
        np.testing.assert_allclose(pinhole_of(wider)[0], fov, rtol=1e-12)


def test_a_clip_is_the_same_world_with_and_without(renderer):
    options = {"num_frames": 1, "scale": 0.25}
    plain, bent = (make_clip(2, lens=share, **options).episode for share in (0.0, 1.0))
    assert "lens" not in plain.meta["synth"]
    assert Lens.from_dict(bent.meta["synth"]["lens"]).image_size_hw == plain.image_size_hw
    np.testing.assert_array_equal(plain.T_camera_from_world, bent.T_camera_from_world)
    np.testing.assert_allclose(plain.fov_vh_rad, bent.fov_vh_rad, rtol=1e-6)
    both = plain.presence & bent.presence
    np.testing.assert_array_equal(plain.hand_state[both], bent.hand_state[both])
    assert plain.text == bent.text
    assert plain.meta["synth"]["camera"] == bent.meta["synth"]["camera"]
    assert fingerprint(plain) == fingerprint(bent)
    assert not is_bench(bent)


@pytest.mark.parametrize(
    ("preset", "share", "message"),
    [
        ("train", 1.5, "lens: expected a share of clips from 0 to 1, got 1.5"),
        ("train", float("nan"), "lens: expected a share of clips from 0 to 1, got nan"),
        ("bench", 0.5, "lens: expected 0 for bench"),
        ("bench-ood", 1.0, "lens: expected 0 for bench-ood"),
    ],
)
def test_a_share_that_cannot_be_is_named(preset, share, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        make_clip(0, preset, 1, lens=share)
    with pytest.raises(ValueError, match=message):
        synthesise(tmp_path, preset, 1, lens=share)
    assert not list(tmp_path.iterdir())


def test_lenses_and_worlds_must_fit():
    world = small_world(1)
    with pytest.raises(ValueError, match="lens, image_size_hw: expected the world's"):
        seen_through(world, LENSES[0].resized((60, 80)))
    with pytest.raises(ValueError, match="world, lens: expected none yet"):
        draw_lens(seen_through(world, LENSES[0]), 1.0)
