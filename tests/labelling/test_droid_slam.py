"""DROID-SLAM's poses become a path in units of its own."""

import sys

import numpy as np
import pytest

from mint_hub.geometry.rigid import inverse
from mint_hub.labelling.stage import NotReadyError, StageError
from mint_hub.labelling.stages.droid_slam import DroidCamera, DroidSettings, to_path
from tests import video_files as make
from tests.labelling.research_projects import DROID, clip_of, video_of, write_files


def test_a_clip(tmp_path):
    checkout = write_files(tmp_path / "checkout", {"droid_slam/droid.py": DROID})
    weights = tmp_path / "droid.pth"
    weights.write_text("droid weights")
    clip = clip_of(make.video(tmp_path / "a.mp4", 12, (96, 128)), 10, first=1, focal=100.0)
    stage = DroidCamera(DroidSettings(str(checkout), str(weights), sys.executable))
    try:
        path = stage.run_clip(clip, video_of(clip)).clips[0].camera
    finally:
        stage.close()
    assert path is not None
    assert not path.metric
    assert path.solved.all()
    assert np.isnan(path.covisible).all()
    T_world_from_camera = inverse(path.T_camera_from_world)
    # 96 x 128 becomes 384 x 512, and the focal length with it
    expected = np.column_stack([np.arange(10), np.full((10, 2), 400.0)])
    np.testing.assert_allclose(T_world_from_camera[:, :3, 3], expected)
    turn = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    np.testing.assert_allclose(T_world_from_camera[4, :3, :3], turn, atol=1e-12)


def test_answers_that_are_no_path(tmp_path):
    clip = clip_of(make.video(tmp_path / "a.mp4", 3), 3)
    good = np.tile([0, 0, 0, 0, 0, 0, 1.0], (3, 1))
    assert to_path(good, clip).T_camera_from_world.shape == (3, 4, 4)
    for bad in (good[:2], good[:, :6], good * [1, 1, 1, 0, 0, 0, 0], good * np.nan):
        with pytest.raises(StageError, match="droid_slam"):
            to_path(bad, clip)


def test_says_what_it_lacks(tmp_path):
    names = [lack.what for lack in DroidCamera().lacks()]
    assert len(names) == 3
    clip = clip_of(make.video(tmp_path / "a.mp4", 3), 3)
    with pytest.raises(StageError, match="expected intrinsics"):
        DroidCamera().run_clip(clip, video_of(clip))
    known = clip_of(clip.video, 3, focal=50.0)
    with pytest.raises(NotReadyError, match=r"droid\.pth"):
        DroidCamera().run_clip(known, video_of(known))
