"""The sample clip is what README says it is, and its truth lies on its picture."""

from pathlib import Path

import numpy as np
import pytest

import mint_hub.assets
from mint_hub.conventions import SIDES
from mint_hub.geometry.camera import project
from mint_hub.geometry.hand_model import HandModel
from mint_hub.geometry.rigid import inverse
from mint_hub.geometry.rotations import geodesic_angle
from mint_hub.loaders.schema import Episode
from mint_hub.loaders.video import iter_frames, probe
from mint_hub.synth import make_sample, sample_render, sample_scene

ASSETS = Path(mint_hub.assets.__file__).parent
VIDEO, TRUTH = ASSETS / "sample.mp4", ASSETS / "sample.npz"
CHECKED = (4, 33, 58, 87)


@pytest.fixture(scope="module")
def episode() -> Episode:
    return Episode.load(TRUTH)


@pytest.fixture(scope="module")
def images() -> list[np.ndarray]:
    return [frame.image for frame in iter_frames(VIDEO, fps=None)]


@pytest.fixture(scope="module")
def drawn(episode) -> dict[int, tuple[np.ndarray, np.ndarray]]:
    """Image and labels of a few frames, drawn from the truth that is stored."""
    model, textures = HandModel.template(), sample_scene.textures(make_sample.SEED)
    return {k: make_sample.draw_frame(episode, k, model, textures) for k in CHECKED}


def test_video_is_three_seconds_of_h264_and_small(images):
    info = probe(VIDEO)
    assert (info.codec, info.fps, info.image_size_hw) == ("h264", 30.0, (288, 384))
    assert len(images) == 90
    assert 100_000 < VIDEO.stat().st_size <= 300_000
    assert TRUTH.stat().st_size <= 150_000


def test_truth_is_an_episode_of_the_video(episode, images):
    assert episode.key == "sample"
    assert episode.num_frames == len(images)
    assert episode.image_size_hw == images[0].shape[:2]
    assert episode.meta["shape_space"] == "mint"
    assert episode.meta["source"] == "mint-hub sample"
    assert episode.meta["scale_status"] == "exact (synthetic)"
    assert episode.presence.all()


def test_script_still_makes_this_truth(episode):
    assert make_sample.truth(HandModel.template()).allclose(episode, atol=1e-5)


def test_head_moves_a_little(episode):
    pose = episode.T_world_from_camera
    np.testing.assert_allclose(pose[0], np.eye(4), atol=1e-12)
    reach = np.linalg.norm(pose[:, :3, 3], axis=-1).max()
    assert 0.02 < reach < 0.2
    steps = np.linalg.norm(np.diff(pose[:, :3, 3], axis=0), axis=-1)
    turns = np.asarray(geodesic_angle(pose[:-1, :3, :3], pose[1:, :3, :3]))
    assert 0 < steps.min() <= steps.max() < 0.01
    assert np.rad2deg(turns).max() < 1.5


def test_video_shows_what_the_script_draws(images, drawn):
    for k, (image, _) in drawn.items():
        error = np.abs(images[k].astype(float) - image).mean()
        other = np.abs(images[k - 3].astype(float) - image).mean()
        assert error < 5, f"frame {k} differs from its drawing by {error:.1f} of 255"
        assert error < 0.6 * other, f"frame {k} looks as much like frame {k - 3}"


def test_visible_joints_lie_on_skin(episode, images, drawn):
    """A joint in the image is under skin, or under something else that stands before it."""
    things = {sample_scene.MUG, sample_scene.SLEEVE}
    on_skin, skin_colored = [], []
    for k, (_, labels) in drawn.items():
        uv, _ = project(episode.joints_camera()[k], episode.K[k].astype(np.float32))
        inside = (uv >= 0).all(-1) & (uv < np.array(episode.image_size_hw[::-1])).all(-1)
        for u, v in uv[inside]:
            scale = sample_render.OVERSAMPLING
            label = labels[int(v * scale), int(u * scale)]
            if label in things:
                continue
            on_skin.append(label == sample_scene.SKIN)
            row, column = max(int(v) - 1, 0), max(int(u) - 1, 0)  # colour is stored at half size
            around = images[k][row : row + 3, column : column + 3].astype(float)
            red, green, blue = np.moveaxis(around, -1, 0)
            skin_colored.append(((red > 1.12 * green) & (green > 1.03 * blue)).any())
    assert len(on_skin) > 0.75 * len(CHECKED) * len(SIDES) * 21
    assert np.mean(on_skin) >= 0.95
    assert np.mean(skin_colored) >= 0.95


def test_held_mug_moves_with_the_hand(episode):
    model, wrists = HandModel.template(), episode.wrist_world()[:, 1]
    first_camera = make_sample.camera_from_room(0.0)
    seen = {}
    for k in (40, 89):
        mug = next(m for m in make_sample.meshes(episode, k, model) if m.label == sample_scene.MUG)
        world = mug.vertices @ first_camera[:3, :3].T + first_camera[:3, 3]
        to_wrist = inverse(wrists[k])
        seen[k] = world @ to_wrist[:3, :3].T + to_wrist[:3, 3]
    np.testing.assert_allclose(seen[40], seen[89], atol=1e-5)
