"""GeoCalib's focal becomes one pinhole for the video; gravity is kept in the report."""

import sys

import numpy as np
import pytest

from mint_hub.geometry.camera import fov_vh_to_K
from mint_hub.labelling.stage import NotReadyError, StageError
from mint_hub.labelling.stages.geocalib import (
    GeoCalibIntrinsics,
    GeoCalibSettings,
    spread,
    to_intrinsics,
)
from tests import video_files as make
from tests.labelling.research_projects import GEOCALIB, clip_of, video_of, write_files


def test_a_video(tmp_path):
    checkout = write_files(tmp_path / "checkout", {"geocalib/__init__.py": GEOCALIB})
    weights = tmp_path / "geocalib-pinhole.tar"
    weights.write_text("55.0")
    file = make.video(tmp_path / "a.mp4", 30)
    video = video_of(clip_of(file, 10), clip_of(file, 20, first=10))
    settings = GeoCalibSettings(str(checkout), str(weights), 6, "cpu", sys.executable)
    stage = GeoCalibIntrinsics(settings)
    try:
        after = stage.run_video(video)
    finally:
        stage.close()
    first, second = (clip.intrinsics for clip in after.clips)
    assert first is not None
    assert first == second or first is second
    K = fov_vh_to_K(np.array(first.fov_vh_rad), (48, 64))
    np.testing.assert_allclose([K[0, 0], K[1, 1]], 55.0)
    assert first.confidence == pytest.approx(0.5)
    numbers = after.reports[-1].numbers
    np.testing.assert_allclose(numbers["gravity_camera"], np.tile([0, 1, 0], (6, 1)))
    expected = [10 + f / 30 for f in (2, 7)] + [10 + f / 30 for f in (2, 7, 12, 17)]
    np.testing.assert_allclose(numbers["gravity_at_s"], expected)


def test_pictures_are_spread_over_all_clips(tmp_path):
    file = make.video(tmp_path / "a.mp4", 30)
    clips = [clip_of(file, n) for n in (1, 12, 17)]
    for count in (1, 5, 30, 100):
        picked = [(clips.index(clip), f) for clip, frames in spread(clips, count) for f in frames]
        assert len(picked) == min(count, 30)
        assert len(set(picked)) == len(picked)
        assert picked == sorted(picked)
    assert spread(clips, 1)[0][0] is clips[2]


def test_what_is_no_focal():
    for focal in ([np.nan, 50.0], [-1.0, 50.0]):
        with pytest.raises(StageError, match="positive focal"):
            to_intrinsics(np.array([focal]), np.array([1.0]), (48, 64))
    assert to_intrinsics(np.array([[50.0, 50.0]]), np.array([np.nan]), (48, 64)).confidence == 0


def test_says_what_it_lacks(tmp_path, monkeypatch):
    monkeypatch.setenv("MINT_HUB_ENVIRONMENTS", str(tmp_path))
    assert [lack.what.split()[0] for lack in GeoCalibIntrinsics().lacks()] == [
        "an",
        "GeoCalib",
        "GeoCalib's",
    ]
    (tmp_path / "empty").mkdir()
    settings = GeoCalibSettings(checkout=str(tmp_path / "empty"), weights=str(tmp_path / "none"))
    clip = clip_of(make.video(tmp_path / "a.mp4", 3), 3)
    with pytest.raises(NotReadyError, match=r"no geocalib in it.*git clone.*none .*nothing is"):
        GeoCalibIntrinsics(settings).run_video(video_of(clip))
