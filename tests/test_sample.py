"""The embedded clips are what their README says, and their truth lies on their pictures."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

import mint_hub.assets
from mint_hub.conventions import KEYPOINT_NAMES
from mint_hub.geometry.camera import project
from mint_hub.geometry.rigid import transform_points
from mint_hub.geometry.rotations import geodesic_angle
from mint_hub.loaders.integrity import verify
from mint_hub.loaders.reader import CorpusReader
from mint_hub.loaders.schema import Episode
from mint_hub.loaders.stats import read_action_stats
from mint_hub.loaders.video import iter_frames, probe
from mint_hub.synth import make_sample
from mint_hub.synth.corruption import corrupt
from mint_hub.synth.episodes import presence_of
from mint_hub.synth.presets import RESERVED_SEEDS, is_bench, seed_of
from mint_hub.synth.render import Renderer
from mint_hub.synth.scene import make_world
from mint_hub.synth.world import World
from tests.small_world import renderer_or_skip

ASSETS = Path(mint_hub.assets.__file__).parent
VIDEO, TRUTH, CORPUS = ASSETS / "sample.mp4", ASSETS / "sample.npz", ASSETS / "sample_corpus"
SIZE_HW = (288, 384)
CHECKED = (4, 33, 58, 87, 112)
TIPS = np.array([name.endswith("tip") for name in KEYPOINT_NAMES])


@pytest.fixture(scope="module")
def episode() -> Episode:
    return Episode.load(TRUTH)


@pytest.fixture(scope="module")
def images() -> list[np.ndarray]:
    return [frame.image for frame in iter_frames(VIDEO, fps=None)]


@pytest.fixture(scope="module")
def reader() -> CorpusReader:
    return CorpusReader(CORPUS, "sample", "train", verify="full")


@pytest.fixture(scope="module")
def world() -> World:
    seed = RESERVED_SEEDS + make_sample.CHOSEN[0].number
    made = make_world(seed, "train", make_sample.NUM_FRAMES)
    return replace(made, image_size_hw=SIZE_HW)


@pytest.fixture(scope="module")
def renderer() -> Iterator[Renderer]:
    with renderer_or_skip(SIZE_HW) as made:
        yield made


def test_video_is_four_seconds_of_h264(images):
    info = probe(VIDEO)
    assert (info.codec, info.fps, info.image_size_hw) == ("h264", 30.0, SIZE_HW)
    assert len(images) == 120


def test_everything_embedded_is_small():
    files = [VIDEO, TRUTH, *(path for path in CORPUS.rglob("*") if path.is_file())]
    assert sum(path.stat().st_size for path in files) < 3_000_000


def test_truth_is_an_episode_of_the_video(episode, images):
    assert episode.key == episode.meta["uid"] == "sample"
    assert episode.num_frames == len(images)
    assert episode.image_size_hw == images[0].shape[:2]
    assert episode.meta["shape_space"] == "mint"
    assert episode.meta["source"] == "mint-hub sample"
    assert episode.meta["scale_status"] == "exact (synthetic)"
    assert episode.presence.all()
    assert (episode.presence_score.mean(0) > 0.85).all()
    assert {segment.side for segment in episode.text} == {"left", "right"}


def test_the_corpus_holds_the_clip_and_two_more_with_pictures(reader, episode):
    assert verify(CORPUS, "full").ok
    assert [e.key for e in reader] == [chosen.key for chosen in make_sample.CHOSEN]
    assert reader[0].allclose(episode, atol=1e-7)  # shards keep poses in float32
    assert bytes(reader.member(0, "mp4")) == VIDEO.read_bytes()
    for i, made in enumerate(reader):
        info = probe(bytes(reader.member(i, "mp4")))
        assert (info.fps, info.image_size_hw) == (30.0, made.image_size_hw)
        assert made.presence_score is not None
        assert made.text
    assert {segment.side for made in reader for segment in made.text} == {"left", "right", "both"}
    stats = read_action_stats(CORPUS / "sample", "train", reader.manifest.content)
    assert stats


def test_no_run_draws_the_seeds_of_the_sample(reader):
    for chosen, made in zip(make_sample.CHOSEN, reader, strict=True):
        assert made.meta["synth"]["preset"] == "train"
        assert made.meta["synth"]["seed"] == RESERVED_SEEDS + chosen.number
        assert not is_bench(made)
    drawn = [seed_of("train", seed, number) for seed in (0, 1, 2**70) for number in range(300)]
    assert max(drawn) < RESERVED_SEEDS
    assert max(drawn) > RESERVED_SEEDS // 2  # the bound is that of what is drawn


def test_script_still_makes_this_truth(episode, world):
    np.testing.assert_allclose(episode.T_camera_from_world, world.T_camera_from_world, atol=1e-6)
    np.testing.assert_allclose(episode.hand_state, world.hands.hand_state, atol=1e-5)
    np.testing.assert_allclose(episode.fov_vh_rad[7], world.fov_vh_rad, rtol=1e-6)
    np.testing.assert_array_equal(episode.presence, presence_of(world))
    assert episode.text == world.text


def test_head_moves_and_does_not_race(episode):
    pose = episode.T_world_from_camera
    steps = np.linalg.norm(np.diff(pose[:, :3, 3], axis=0), axis=-1)
    turns = np.rad2deg(np.asarray(geodesic_angle(pose[:-1, :3, :3], pose[1:, :3, :3])))
    assert 0.001 < np.median(steps) < 0.006
    assert np.linalg.norm(pose[:, :3, 3] - pose[0, :3, 3], axis=-1).max() > 0.02
    assert 0.2 < np.median(turns) < 1.0
    assert steps.max() < 0.03
    assert turns.max() < 4


def test_both_hands_carry_something(world, episode):
    """A thing that moves through the world is still in the frame of a wrist while it does."""
    wrists = episode.wrist_world()
    carried = {0: 0, 1: 0}
    for body in world.bodies:
        T = body.T_world_from_body
        if T.ndim != 3:
            continue
        moves = np.linalg.norm(T[8:, :3, 3] - T[:-8, :3, 3], axis=-1) > 0.02
        for hand in carried:
            seen = np.linalg.inv(wrists[:, hand]) @ T
            still = np.linalg.norm(seen[8:, :3, 3] - seen[:-8, :3, 3], axis=-1) < 0.004
            carried[hand] += int((moves & still).sum())
    assert min(carried.values()) >= 8


def test_video_shows_what_the_script_draws(images, renderer, world):
    settings = replace(make_sample.CAMERA, shot_noise=0.0, read_noise=0.0)
    settings = replace(settings, exposure_drift=0.0, white_drift=0.0)
    for k in CHECKED:
        (image,) = corrupt(renderer.frames(world, ("flow",), k, k + 1), settings, 0)
        error = np.abs(images[k].astype(float) - image.rgb).mean()
        other = np.abs(images[k - 3].astype(float) - image.rgb).mean()
        assert error < 6, f"frame {k} differs from its drawing by {error:.1f} of 255"
        assert error < 0.6 * other, f"frame {k} looks as much like frame {k - 3}"


def test_joints_lie_on_the_hands_that_are_drawn(episode, renderer, world):
    """All of the skeleton, however much stands before it; tips, on the surface, within a pixel."""
    joints, wrists = episode.joints_camera(), episode.wrist_world()
    np.testing.assert_allclose(
        transform_points(episode.T_world_from_camera, joints[:, 0, 0].astype(float)[:, None])[:, 0],
        wrists[:, 0, :3, 3],
        atol=1e-5,
    )
    exact, near = [], []
    for k in CHECKED:
        uv, z = project(joints[k].astype(np.float64), episode.K[k])
        for hand, mask in enumerate(renderer.hand_masks(world, k)):
            inside = (uv[hand] >= 0).all(-1) & (uv[hand] < SIZE_HW[::-1]).all(-1)
            inside &= z[hand] > 0.01
            column, row = np.floor(np.where(inside[:, None], uv[hand], 0)).astype(int).T
            exact += list(mask[row, column][inside & ~TIPS])
            grown = cv2.dilate(mask.astype(np.uint8), np.ones((3, 3), np.uint8))
            near += list(grown[row, column][inside])
    assert len(near) > 0.9 * len(CHECKED) * 2 * 21
    assert np.mean(exact) == 1.0
    assert np.mean(near) >= 0.99
