"""Clips: labels that are what was drawn, and shards that go on where they stopped."""

import dataclasses
import io
import re
import sys

import cv2
import numpy as np
import pytest

from mint_hub.cli import main
from mint_hub.conventions import KEYPOINT_NAMES
from mint_hub.geometry.camera import fov_vh_to_K, on_screen, project, unproject
from mint_hub.geometry.hand_model import HandModel
from mint_hub.geometry.lenses import Lens
from mint_hub.geometry.rigid import inverse, transform_points
from mint_hub.loaders.clips import PackedClip
from mint_hub.loaders.integrity import verify
from mint_hub.loaders.packing import pixel_window
from mint_hub.loaders.reader import CorpusReader
from mint_hub.loaders.shards import CorpusError
from mint_hub.synth import episodes
from mint_hub.synth.corruption import Corruption
from mint_hub.synth.episodes import DEPTH_STEP_M, Clip, make_episode, presence_of, synthesise
from mint_hub.synth.presets import is_bench, seed_of
from mint_hub.synth.render import Renderer
from mint_hub.synth.scene import make_world
from tests.corpus_faults import tree
from tests.episodes import make_episode as make_labels
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


class Maker:
    """Stands for ``make_clip``: labels alone, one clip a shard; interrupted at seed ``stop``."""

    def __init__(self, stop: int | None = None) -> None:
        self.stop, self.seeds = stop, list[int]()

    def __call__(self, seed: int, preset: str, *_: object, **__: object) -> Clip:
        self.seeds.append(seed)
        if seed == self.stop:
            raise KeyboardInterrupt
        return Clip(make_labels(3, key=f"synth-{preset}-{seed:x}"), {"mp4": b"%d" % seed})


@pytest.fixture
def begun(renderer, tmp_path, monkeypatch):
    """Make runs of four clips, of train and of the bench, that stop at the fourth."""
    monkeypatch.setattr(episodes, "SHARD_BYTES", 1)
    for preset in ("train", "bench"):
        monkeypatch.setattr(episodes, "make_clip", Maker(stop=seed_of(preset, 1, 3)))
        with pytest.raises(KeyboardInterrupt):
            synthesise(tmp_path, preset, 4, seed=1, num_frames=3)
    monkeypatch.setattr(episodes, "make_clip", Maker())
    return tmp_path


@pytest.mark.parametrize(("preset", "seed"), [("train", 1), ("bench", 2)])
def test_an_interrupted_run_goes_on_with_the_clips_that_are_missing(
    begun, tmp_path_factory, preset, seed
):
    """A bench's clips are the same for every seed, and 1 is the scale 1.0."""
    report = synthesise(begun, preset, 4, seed=seed, num_frames=3, scale=1)
    assert (report.kept_shards, report.num_shards) == (2, 4)  # the third was still open
    assert episodes.make_clip.seeds == [seed_of(preset, 1, n) for n in (2, 3)]
    whole = tmp_path_factory.mktemp("whole")
    synthesise(whole, preset, 4, seed=1, num_frames=3)
    split = report.folder.relative_to(begun)
    assert tree(begun / split) == tree(whole / split)


def test_keys_are_those_of_the_clips(corpus):
    reader = CorpusReader(corpus, "synth-train", "train")
    keys = [f"synth-train-{seed_of('train', 1, n):x}" for n in range(2)]
    assert [episode.key for episode in reader] == keys


@pytest.mark.parametrize(
    ("preset", "other", "message"),
    [
        ("train", {"num_frames": 4}, "num_frames 3 as it was begun, got 4"),
        ("train", {"num_frames": None}, "num_frames 3 as it was begun, got None"),
        ("train", {"scale": 0.5}, "scale 1.0 as it was begun, got 0.5"),
        ("train", {"samples": 0}, "samples 4 as it was begun, got 0"),
        ("train", {"lens": 0.5}, "lens 0.0 as it was begun, got 0.5"),
        ("train", {"depth": True}, "depth False as it was begun, got True"),
        ("train", {"segmentation": True}, "segmentation False as it was begun, got True"),
        ("train", {"seed": 2}, "seed 1 as it was begun, got 2"),
        ("bench", {"scale": 0.5}, "scale 1.0 as it was begun, got 0.5"),
    ],
)
def test_other_arguments_do_not_go_on(begun, preset, other, message):
    before = tree(begun)
    with pytest.raises(CorpusError, match=f"{re.escape(message)}: resume with the same arguments"):
        synthesise(begun, preset, 4, **{"seed": 1, "num_frames": 3, **other})
    assert tree(begun) == before


def test_another_generator_does_not_go_on(begun, monkeypatch):
    monkeypatch.setattr(episodes, "REVISION", episodes.REVISION + 1)
    with pytest.raises(CorpusError, match="expected revision"):
        synthesise(begun, "train", 4, seed=1, num_frames=3)


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
        (["--episodes", "-3", "--preset", "bench"], "episodes: expected at least 1"),
        (["--episodes", "1", "--jobs", "0"], "--jobs: expected at least 1"),
        (["--episodes", "1", "--frames", "0"], "num_frames: expected at least 1, got 0"),
        (["--episodes", "1", "--seed", "-2"], "seed: expected 0 or more, got -2"),
        (["--episodes", "1", "--scale", "0"], "scale: expected 0.1 to 4, got 0.0"),
        (["--episodes", "1", "--scale", "nan"], "scale: expected 0.1 to 4, got nan"),
        (["--episodes", "1", "--samples", "3"], "samples: expected 0, 2 or 4 a pixel, got 3"),
        (["--episodes", "1", "--lens", "1.1"], "lens: expected a share of clips from 0 to 1"),
        (["--lens", "0.5", "--preset", "bench"], "lens: expected 0 for bench"),
        (["--episodes", "41", "--preset", "bench"], "bench has 40 clips"),
    ],
)
def test_bad_arguments_are_named(arguments, message, tmp_path, capsys):
    assert main(["synth", *arguments, "-o", str(tmp_path), "--quiet"]) == 2
    said = capsys.readouterr().err.strip()
    assert message in said
    assert "\n" not in said
    assert not list(tmp_path.iterdir())


def test_a_file_where_the_corpus_should_be_is_named(tmp_path, capsys):
    (tmp_path / "taken").write_text("mine")
    call = ["synth", "--episodes", "1", "-o", str(tmp_path / "taken"), "--quiet"]
    assert main(call) == 2
    said = capsys.readouterr().err.strip()
    assert "expected a folder, got a file" in said
    assert "\n" not in said
    assert (tmp_path / "taken").read_text() == "mine"


def test_an_unknown_preset_is_named(tmp_path, capsys):
    with pytest.raises(SystemExit) as left:
        main(["synth", "--preset", "kitchen", "--episodes", "1", "-o", str(tmp_path)])
    assert left.value.code == 2
    assert "invalid choice: 'kitchen'" in capsys.readouterr().err
    with pytest.raises(ValueError, match=r"preset: expected one of .*'train'.*, got 'kitchen'"):
        synthesise(tmp_path, "kitchen", 1)


class WithoutEgl:
    """A moderngl that finds no driver."""

    @staticmethod
    def create_standalone_context(**_):
        raise OSError("libEGL.so: cannot open shared object file")


@pytest.mark.parametrize(
    ("module", "message"),
    [(None, 'pip install "mint-hub[synth]"'), (WithoutEgl, "libegl1 libgl1-mesa-dri")],
)
def test_what_is_missing_is_one_line(module, message, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "moderngl", module)
    call = ["synth", "--episodes", "1", "--frames", "1", "-o", str(tmp_path), "--quiet"]
    assert main(call) == 2
    said = capsys.readouterr().err.strip()
    assert message in said
    assert "\n" not in said
    assert not list(tmp_path.iterdir())


def test_the_command_line_bends_pictures(renderer, tmp_path):
    call = ["synth", "--episodes", "1", "--frames", "1", "--scale", "0.2", "--lens", "1"]
    assert main([*call, "--seed", "4", "-o", str(tmp_path), "--quiet"]) == 0
    (episode,) = CorpusReader(tmp_path, "synth-train", "train")
    lens = Lens.from_dict(episode.meta["synth"]["lens"])
    assert lens.image_size_hw == episode.image_size_hw
    assert any(lens.distortion)
