"""MINT as a backend: its predictions in the records of the cascade."""

import numpy as np
import pytest

from mint_hub.geometry.camera import fov_vh_to_K
from mint_hub.inference.runner import MintRunner, RunSettings
from mint_hub.labelling.stage import NotReadyError
from mint_hub.labelling.stages.mint import (
    MintCamera,
    MintHands,
    MintIntrinsics,
    MintSettings,
    to_intrinsics,
    windows_of,
)
from mint_hub.loaders.video import iter_frames
from mint_hub.model.processing_mint import MintProcessor
from tests import video_files as make
from tests.labelling.research_projects import clip_of, video_of
from tests.small_model import small_model


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    folder = tmp_path_factory.mktemp("mint")
    small_model(window=8).save_pretrained(folder)
    return str(folder)


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    return make.video(tmp_path_factory.mktemp("video") / "a.mp4", 30)


def test_camera_and_hands_are_the_runners(checkpoint, file):
    clip = clip_of(file, 20, first=4, focal=50.0)
    stage = MintCamera(MintSettings(checkpoint))
    after = stage.run_clip(clip, video_of(clip)).clips[0]
    stage.close()
    model = small_model(window=8)
    images = np.stack([frame.image for frame in iter_frames(file)])[4:24]
    K = fov_vh_to_K(np.array(clip.intrinsics.fov_vh_rad), clip.image_size_hw)
    runner = MintRunner(model, MintProcessor.for_config(model.config))
    episode = runner.run(images, RunSettings(), camera=K)
    camera, hands = after.camera, after.hands
    assert camera is not None
    assert hands is not None
    assert camera.metric
    np.testing.assert_allclose(camera.T_camera_from_world, episode.T_camera_from_world, atol=1e-5)
    np.testing.assert_array_equal(hands.presence, episode.presence)
    np.testing.assert_allclose(hands.hand_state, episode.hand_state, atol=1e-4)
    assert 0 < hands.presence.mean() < 1
    np.testing.assert_array_equal(hands.score > 0, hands.presence)
    assert (hands.source, hands.shape_space) == ("mint", model.config.shape_space)
    # the hands stage keeps those, and makes the same without them
    for before in (after, clip):
        again = MintHands(MintSettings(checkpoint)).run_clip(before, video_of(clip)).clips[0]
        np.testing.assert_allclose(again.hands.hand_state, hands.hand_state, atol=1e-5)
        assert again.reports[-1].stage == "hands"


def test_one_field_of_view_for_the_video(checkpoint, file):
    video = video_of(clip_of(file, 8), clip_of(file, 20, first=8))
    stage = MintIntrinsics(MintSettings(checkpoint, windows=3))
    after = stage.run_video(video)
    first, second = (clip.intrinsics for clip in after.clips)
    assert first == second or first is second
    assert first.source == "mint"
    seen = np.array(after.reports[-1].numbers["fov_vh_deg"])
    assert seen.shape == (3, 2)
    np.testing.assert_allclose(np.degrees(first.fov_vh_rad), np.median(seen, axis=0))
    assert (
        stage.run_video(video_of(*after.clips)).clips[0].intrinsics.fov_vh_rad == first.fov_vh_rad
    )


def test_confidence_falls_with_disagreement():
    same = to_intrinsics(np.tile([0.8, 1.0], (4, 1)))
    assert same.confidence == pytest.approx(1.0)
    apart = to_intrinsics(np.array([[0.8, 1.0], [0.9, 1.1], [0.7, 0.9]]))
    assert 0 < apart.confidence < 0.3


def test_windows_are_spread(file):
    clips = (clip_of(file, 5), clip_of(file, 30))
    found = [(clips.index(c), a, b) for c, a, b in windows_of(clips, 8, 10)]
    assert found == [(0, 0, 5), (1, 0, 8), (1, 8, 16), (1, 16, 24)]
    assert len(windows_of(clips, 8, 2)) == 2


def test_says_what_it_lacks(file):
    clip = clip_of(file, 5, focal=50.0)
    assert MintHands(MintSettings("somewhere")).lacks() == ()
    for stage in (MintCamera(), MintHands()):
        with pytest.raises(NotReadyError, match="setting model"):
            stage.run_clip(clip, video_of(clip))
    with pytest.raises(NotReadyError, match="convert-checkpoint"):
        MintIntrinsics().run_video(video_of(clip))
