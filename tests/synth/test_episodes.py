"""Clips: labels that are what was drawn, and shards that go on where they stopped."""

import dataclasses
import io

import numpy as np
import pytest

from mint_hub.cli import main
from mint_hub.geometry.hand_model import HandModel
from mint_hub.loaders.clips import PackedClip
from mint_hub.loaders.integrity import verify
from mint_hub.loaders.packing import pixel_window
from mint_hub.loaders.reader import CorpusReader
from mint_hub.synth import episodes
from mint_hub.synth.corruption import Corruption
from mint_hub.synth.episodes import DEPTH_STEP_M, make_episode, presence_of, synthesise
from mint_hub.synth.presets import is_bench
from mint_hub.synth.render import Renderer
from mint_hub.synth.scene import make_world

FRAMES = 6


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


# --------------------------------------------------------------------------- shards


@pytest.fixture(scope="module")
def corpus(renderer, tmp_path_factory):
    folder = tmp_path_factory.mktemp("synth")
    synthesise(folder, "train", 2, seed=1, num_frames=3)
    return folder


def test_shards_read_like_any_other(corpus):
    assert verify(corpus, "full").ok
    reader = CorpusReader(corpus, "synth-train", "train")
    assert len(reader) == 2
    window = pixel_window(reader, 1)
    assert window.images.shape[0] == window.episode.num_frames == 3
    assert reader[1].presence_score is not None
    assert reader[1].meta["scale_status"] == "exact (synthetic)"


def test_an_interrupted_run_goes_on_and_ends_the_same(corpus, tmp_path, monkeypatch):
    made = episodes.make_clip
    calls: list[int] = []

    def dies(seed, *args, **options):
        calls.append(seed)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return made(seed, *args, **options)

    monkeypatch.setattr(episodes, "make_clip", dies)
    with pytest.raises(KeyboardInterrupt):
        synthesise(tmp_path, "train", 2, seed=1, num_frames=3)
    synthesise(tmp_path, "train", 2, seed=1, num_frames=3)
    one, two = (next((f / "synth-train" / "train").glob("*.tar")) for f in (corpus, tmp_path))
    assert one.read_bytes() == two.read_bytes()


def test_processes_do_not_matter(corpus, tmp_path):
    synthesise(tmp_path, "train", 2, seed=1, num_frames=3, num_procs=2)
    one, two = (next((f / "synth-train" / "train").glob("*.tar")) for f in (corpus, tmp_path))
    assert one.read_bytes() == two.read_bytes()


def test_the_command_line_makes_a_bench_clip(renderer, tmp_path, capsys):
    call = ["synth", "--preset", "bench", "--episodes", "1", "--frames", "2", "--quiet"]
    assert main([*call, "-o", str(tmp_path)]) == 0
    assert (tmp_path / "README.md").is_file()
    (episode,) = CorpusReader(tmp_path, "synth-bench", "validation")
    assert is_bench(episode)
    assert main([*call, "-o", str(tmp_path)]) == 2
    assert "expected no such split yet" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "--episodes: expected how many"),
        (["--episodes", "0"], "episodes: expected at least 1"),
        (["--episodes", "1", "--jobs", "0"], "--jobs: expected at least 1"),
        (["--episodes", "1", "--seed", "-2"], "seed: expected 0 or more, got -2"),
        (["--episodes", "41", "--preset", "bench"], "bench has 40 clips"),
    ],
)
def test_bad_arguments_are_named(arguments, message, tmp_path, capsys):
    assert main(["synth", *arguments, "-o", str(tmp_path), "--quiet"]) == 2
    assert message in capsys.readouterr().err
