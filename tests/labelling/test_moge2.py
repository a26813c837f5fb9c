"""MoGe-2's depth is kept where it is valid, and is NaN everywhere else."""

import numpy as np
import pytest

from mint_hub.labelling.stage import NotReadyError, StageError
from mint_hub.labelling.stages import research_worker
from mint_hub.labelling.stages.moge2 import MogeDepth, MogeSettings, masked
from tests import video_files as make
from tests.labelling.research_projects import MOGE, clip_of, python_with, video_of


def test_a_clip(tmp_path):
    python = python_with(
        tmp_path / "py",
        {"moge/__init__.py": "", "moge/model/__init__.py": "", "moge/model/v2.py": MOGE},
    )
    weights = tmp_path / "model.pt"
    weights.write_text("moge weights")
    clip = clip_of(make.video(tmp_path / "a.mp4", 30), 20, first=5, focal=32.0)
    stage = MogeDepth(MogeSettings(str(weights), frames=4, height=24, device="cpu", python=python))
    try:
        after = stage.run_clip(clip, video_of(clip)).clips[0]
    finally:
        stage.close()
    numbers = after.reports[-1].numbers
    with np.load(numbers["depth_maps"], allow_pickle=False) as stored:
        times, depth = stored["timestamps_s"], stored["depth_m"]
    np.testing.assert_allclose(times, 10 + np.array([2, 7, 12, 17]) / 30)
    assert depth.shape == (4, 24, 32)
    assert np.isnan(depth[:, :12]).all()
    # the value of a cell is that of the pixel in its middle
    columns = np.arange(32) * 2 + 1
    np.testing.assert_allclose(depth[:, 12:23], np.broadcast_to(1 + columns / 100, (4, 11, 32)))
    assert numbers["valid"] == pytest.approx(0.5)


def test_the_known_field_of_view_is_used(tmp_path):
    python = python_with(
        tmp_path / "py",
        {"moge/__init__.py": "", "moge/model/__init__.py": "", "moge/model/v2.py": MOGE},
    )
    weights = tmp_path / "model.pt"
    weights.write_text("moge weights")
    clip = clip_of(make.video(tmp_path / "a.mp4", 3), 3, focal=32.0)  # 64 wide: 90 degrees
    stage = MogeDepth(MogeSettings(str(weights), frames=1, height=48, device="cpu", python=python))
    try:
        after = stage.run_clip(clip, video_of(clip)).clips[0]
    finally:
        stage.close()
    with np.load(after.reports[-1].numbers["depth_maps"]) as stored:
        assert stored["depth_m"][0, -1, 0] == pytest.approx(90.0)


def test_what_is_no_depth_is_never_zero():
    given = np.array([[[1.0, 0.0, -2.0, np.inf, np.nan]]])
    np.testing.assert_array_equal(masked(given), [[[1.0] + [np.nan] * 4]])


def test_thinning_keeps_values_and_small_maps():
    depth = np.arange(12.0).reshape(3, 4)
    np.testing.assert_array_equal(research_worker.thinned(depth, 10), depth)
    np.testing.assert_array_equal(research_worker.thinned(depth, 1), [[6.0]])


def test_depth_that_is_invalid_everywhere(tmp_path, monkeypatch):
    clip = clip_of(make.video(tmp_path / "a.mp4", 3), 3)
    stage = MogeDepth()
    nothing = {"depth_m": np.full((3, 4, 5), np.inf)}
    monkeypatch.setattr(stage, "call", lambda *_, **__: (nothing, {}))
    with pytest.raises(StageError, match="invalid everywhere"):
        stage.run_clip(clip, video_of(clip))


def test_says_what_it_lacks(tmp_path):
    python, weights = MogeDepth().lacks()
    assert "setting python" in python.what
    assert "moge-2" in weights.where
    clip = clip_of(make.video(tmp_path / "a.mp4", 3), 3)
    with pytest.raises(NotReadyError, match=r"MoGe-2's weights"):
        MogeDepth().run_clip(clip, video_of(clip))
