"""YOLO's boxes become detections with sides and without landmarks."""

import numpy as np
import pytest

from mint_hub.labelling.stage import NotReadyError, StageError
from mint_hub.labelling.stages.yolo_hands import YoloHands, YoloSettings
from tests import video_files as make
from tests.labelling.research_projects import ULTRALYTICS, clip_of, python_with, video_of


def test_a_clip(tmp_path):
    python = python_with(tmp_path / "py", {"ultralytics.py": ULTRALYTICS})
    weights = tmp_path / "hands.pt"
    weights.write_text("yolo weights")
    clip = clip_of(make.video(tmp_path / "a.mp4", 70), 67, first=2)
    settings = YoloSettings(weights=str(weights), python=python)
    stage = YoloHands(settings)
    try:
        found = stage.run_clip(clip, video_of(clip)).clips[0].detections
    finally:
        stage.close()
    assert found is not None
    assert found.frame.tolist() == [f for f in range(67) for _ in range(2)]
    np.testing.assert_allclose(found.box_xyxy[:2], [[1, 2, 30, 40], [50.5, 2, 60, 20]])
    np.testing.assert_allclose(found.score[:2], [0.9, 0.5], rtol=1e-6)
    np.testing.assert_allclose(found.right_score[:2], [0.95, 0.25], rtol=1e-6)
    assert np.isnan(found.landmarks_uv).all()
    assert found.landmarks_m.shape == (134, 21, 3)
    other = YoloHands(YoloSettings(weights=str(weights), python=python, right_class=7))
    with pytest.raises(StageError, match=r"classes 0 .* and 7 .* set left_class, right_class"):
        other.run_clip(clip, video_of(clip))
    other.close()


def test_says_what_it_lacks(tmp_path, monkeypatch):
    monkeypatch.setenv("MINT_HUB_ENVIRONMENTS", str(tmp_path))
    packages, weights = YoloHands().lacks()
    assert "ultralytics" in packages.what
    assert "setting weights" in weights.what
    assert "WiLoR" in weights.where
    clip = clip_of(make.video(tmp_path / "a.mp4", 3), 3)
    with pytest.raises(NotReadyError, match="hand detector"):
        YoloHands().run_clip(clip, video_of(clip))
