"""Folders of videos: what counts as an input, what counts as finished, what one failure does."""

import json

import numpy as np
import pytest

from mint_hub.inference.batch import BatchReport, Outputs, find_videos, predict_videos
from mint_hub.inference.runner import MintRunner, RunSettings
from mint_hub.loaders.schema import Episode
from mint_hub.model.processing_mint import MintProcessor
from tests import video_files
from tests.small_model import small_model

LABELS_ONLY = Outputs(overlay=False, plots=False)


@pytest.fixture(scope="module")
def runner():
    model = small_model(window=8)
    return MintRunner(model, MintProcessor.for_config(model.config))


@pytest.fixture
def clip(tmp_path):
    return video_files.video(tmp_path / "a.mp4", 12)


def predict(runner, clip, out, settings=None, outputs=LABELS_ONLY, **options) -> BatchReport:
    settings = settings or RunSettings()
    videos = find_videos([clip])
    return predict_videos(videos, out, runner, settings, outputs=outputs, **options)


def test_other_poses_are_another_result(runner, clip, tmp_path):
    """Also where two paths differ only in the middle of a large array."""
    poses = np.tile(np.eye(4), (12, 1, 1))
    moved = poses.copy()
    moved[5, 0, 3] = 1
    for given, done in ((poses, 1), (poses, 0), (moved, 1)):
        report = predict(runner, clip, tmp_path / "out", camera_poses=given)
        assert len(report.done) == done
    episode = Episode.load(tmp_path / "out/a/episode.npz")
    assert episode.T_camera_from_world[5, 0, 3] == 1
    assert episode.meta["scale_status"] == "camera given, hands predicted"


def test_batch_size_does_not_make_another_result(runner, clip, tmp_path):
    assert predict(runner, clip, tmp_path / "out").done
    assert predict(runner, clip, tmp_path / "out", RunSettings(batch_size=2)).skipped


def test_a_changed_video_is_done_again(runner, clip, tmp_path):
    predict(runner, clip, tmp_path / "out")
    video_files.video(clip, 10)
    assert predict(runner, clip, tmp_path / "out").done
    assert Episode.load(tmp_path / "out/a/episode.npz").num_frames == 10


def test_results_are_not_inputs(runner, clip, tmp_path):
    out = tmp_path / "results"
    predict(runner, clip, out, outputs=Outputs(plots=False))
    assert (out / "a/episode.mp4").is_file()
    (tmp_path / "._a.mp4").write_bytes(b"left by a Mac")
    assert list(find_videos([tmp_path])) == ["a"]


def test_one_place_is_one_video(clip):
    assert len(find_videos([clip, clip.parent / "." / clip.name, clip.parent])) == 1


def test_damage_can_be_forgiven_with_an_overlay(runner, tmp_path):
    damaged = video_files.damaged(tmp_path / "d.mp4")
    outputs = Outputs(plots=True)
    assert predict(runner, damaged, tmp_path / "out", outputs=outputs).failed
    report = predict(runner, damaged, tmp_path / "out", RunSettings(on_error="stop"), outputs)
    assert report.failed == []
    assert Episode.load(tmp_path / "out/d/episode.npz").meta["warnings"]


def test_any_failure_is_one_videos_failure(runner, clip, tmp_path, monkeypatch):
    monkeypatch.setattr(runner, "run", lambda *_, **__: {}["no such key"])
    report = predict(runner, clip, tmp_path / "out")
    assert report.failed == [(str(clip), "KeyError: 'no such key'")]


def test_done_is_written_last(runner, clip, tmp_path):
    predict(runner, clip, tmp_path / "out", outputs=Outputs())
    done = json.loads((tmp_path / "out/a/done.json").read_text())
    assert done["hand_model"] == "mint-hand-template-1"
    times = {p.name: p.stat().st_mtime_ns for p in (tmp_path / "out/a").iterdir()}
    assert max(times, key=times.get) == "done.json"


# --- settings -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("settings", "field"),
    [
        ({"window": 0}, "window"),
        ({"overlap": 0}, "overlap"),
        ({"overlap": 2.5}, "overlap"),
        ({"batch_size": "4"}, "batch_size"),
        ({"fps": 0}, "fps"),
        ({"fps": "30"}, "fps"),
        ({"smooth": "no"}, "smooth"),
        ({"presence_threshold": float("nan")}, "presence_threshold"),
        ({"chain_over": "some"}, "chain_over"),
        ({"fixed_lens": 1}, "fixed_lens"),
        ({"on_error": "ignore"}, "on_error"),
    ],
)
def test_settings_are_checked_by_name(settings, field):
    with pytest.raises(ValueError, match=f"^{field}: expected"):
        RunSettings(**settings)


def test_overlap_follows_short_windows():
    assert RunSettings().resolved(32).overlap == 8
    assert RunSettings().resolved(8).overlap == 2
    assert RunSettings(window=16).resolved(32).overlap == 4
    with pytest.raises(ValueError, match="overlap: expected fewer frames than the window's 16"):
        RunSettings(overlap=16).resolved(16)
