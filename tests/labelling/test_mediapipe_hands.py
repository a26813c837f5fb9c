"""MediaPipe's hands: what its graph says becomes detections in pixels of the clip."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mint_hub.labelling.records import Clip, Detections, Video
from mint_hub.labelling.stage import NotReadyError, StageError
from mint_hub.labelling.stages.mediapipe_hands import (
    ENVIRONMENT,
    MediaPipeHands,
    MediaPipeSettings,
    joined,
    to_detections,
    without_doubles,
)
from mint_hub.loaders.video import probe
from tests import video_files as make

GRAPH = '''
from types import SimpleNamespace as N

class SolutionBase:
    """Sees one right hand, whose thumb tip tells the frame's grey and how many came before."""

    def __init__(self, binary_graph_path, side_inputs, calculator_params, outputs):
        assert side_inputs["num_hands"] == 4 and side_inputs["use_prev_landmarks"]
        self.seen = 0

    def reset(self):
        self.seen = 0

    def process(self, inputs):
        image = inputs["image"]
        height, width = image.shape[:2]
        grey = float(image[height // 2, width // 2].mean()) / 255
        self.seen += 1
        if self.seen == 3:
            none = N(multi_hand_landmarks=None, multi_hand_world_landmarks=None)
            return N(multi_handedness=None, palm_detections=None, **vars(none))
        hand = [N(x=0.5, y=0.25, z=0.0)] * 20 + [N(x=grey, y=height / 1000, z=0.0)]
        world = [N(x=0.01 * i, y=0.0, z=-0.01) for i in range(20)] + [N(x=0, y=self.seen, z=0)]
        palm = N(xmin=0.4, ymin=0.1, width=0.2, height=0.2)
        return N(
            multi_hand_landmarks=[N(landmark=hand)],
            multi_hand_world_landmarks=[N(landmark=world)],
            multi_handedness=[N(classification=[N(label="Left", score=0.75)])],
            palm_detections=[N(score=[0.9], location_data=N(relative_bounding_box=palm))],
        )
'''


@pytest.fixture(scope="module")
def python(tmp_path_factory) -> str:
    """An interpreter whose mediapipe is the graph above."""
    folder = tmp_path_factory.mktemp("fake")
    package = folder / "mediapipe" / "python"
    package.mkdir(parents=True)
    (package.parent / "__init__.py").write_text("")
    (package / "__init__.py").write_text("")
    (package / "solution_base.py").write_text(GRAPH)
    path = folder / "python"
    path.write_text(f'#!/bin/sh\nPYTHONPATH={folder} exec {sys.executable} "$@"\n')
    path.chmod(0o755)
    return str(path)


def clip_of(file: Path, count: int, first: int = 0) -> Clip:
    size = probe(file).image_size_hw
    return Clip(file.stem, file, first, size, 30.0, np.arange(count) / 30)


def video_of(clip: Clip) -> Video:
    return Video("a", "a", "user", clip.video, clip.num_frames / 30, 30.0, clip.image_size_hw)


def test_a_clip_through_the_worker(python, tmp_path):
    file = make.video(tmp_path / "a.mp4", 80, (96, 64))
    stage = MediaPipeHands(MediaPipeSettings(height=48, python=python))
    clip = clip_of(file, 70, first=5)
    try:
        first, again = (stage.run_clip(clip, video_of(clip)).clips[0] for _ in range(2))
    finally:
        stage.close()
    found = first.detections
    assert found is not None
    assert found.frame.tolist() == [f for f in range(70) if f != 2]
    # in pixels of the clip, not of the shrunk picture; the thumb's y tells how high that was
    np.testing.assert_allclose(found.landmarks_uv[:, 0], np.tile([32, 24], (69, 1)))
    np.testing.assert_allclose(found.landmarks_uv[:, 20, 1], 96 * 48 / 1000, rtol=1e-5)
    greys = [round((x * 255 / 64 - 30) / 7) for x in found.landmarks_uv[:, 20, 0]]
    assert greys == [(5 + f) % 30 for f in found.frame]
    # one graph through all chunks of a clip, emptied for the next clip
    np.testing.assert_allclose(found.landmarks_m[:, 20, 1], found.frame + 1)
    np.testing.assert_allclose(found.right_score, 0.75)  # it says "Left" of a mirror image
    np.testing.assert_allclose(found.score, 0.9)
    for name, value in vars(found).items():
        np.testing.assert_array_equal(getattr(again.detections, name), value)
    report = first.reports[-1]
    assert (report.stage, report.backend, report.settings["height"]) == ("detect", "mediapipe", 48)
    assert report.numbers["frames_with_a_hand"] == pytest.approx(69 / 70)


def worker_arrays(count: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    return {
        "frame": np.arange(count, dtype=np.int32),
        "landmarks": rng.random((count, 21, 3), np.float32),
        "landmarks_m": rng.random((count, 21, 3), np.float32),
        "right_score": rng.random(count, np.float32),
        "palm_frame": np.zeros(0, np.int32),
        "palm_score": np.zeros(0, np.float32),
        "palm_box": np.zeros((0, 4), np.float32),
    }


def test_scores_are_the_palms_over_the_hands():
    arrays = worker_arrays(3)
    arrays["landmarks"][...] = 0.5
    arrays["palm_frame"] = np.array([0, 0, 1, 2], np.int32)
    arrays["palm_score"] = np.array([0.6, 0.8, 0.9, 0.3], np.float32)
    over, beside = [0.4, 0.4, 0.6, 0.6], [0.7, 0.4, 0.9, 0.6]
    arrays["palm_box"] = np.array([over, over, beside, over], np.float32)
    found = to_detections(arrays, (100, 200), 10, tracked_score=0.5)
    np.testing.assert_allclose(found.score, [0.8, 0.5, 0.5])
    assert found.frame.tolist() == [10, 11, 12]
    np.testing.assert_allclose(found.box_xyxy, np.tile([100, 50, 100, 50], (3, 1)))


def test_no_hands_at_all():
    found = to_detections(worker_arrays(0), (100, 200), 0, 0.5)
    assert found.landmarks_uv.shape == (0, 21, 2)
    assert found.frame.dtype == np.int32
    assert len(without_doubles(joined([found, found]), 0.25, 0.75).frame) == 0


def test_boxes_bound_landmarks():
    found = to_detections(worker_arrays(5), (100, 200), 0, 0.5)
    low, high = found.box_xyxy[:, None, :2], found.box_xyxy[:, None, 2:]
    assert ((found.landmarks_uv >= low) & (found.landmarks_uv <= high)).all()
    assert (found.landmarks_uv == low).any(1).all()


def hand_at(x: float, frame: int, score: float) -> Detections:
    """One hand 50 pixels across, its left border at ``x``."""
    rng = np.random.default_rng(3)
    uv = rng.random((1, 21, 2), np.float32)
    low, high = uv.min(1, keepdims=True), uv.max(1, keepdims=True)
    uv = (uv - low) / (high - low) * np.float32([30, 40]) + np.float32([x, 100])
    box = np.concatenate([uv.min(1), uv.max(1)], -1)
    one = np.array([score], np.float32)
    landmarks = np.zeros((1, 21, 3), np.float32)
    return Detections(np.array([frame], np.int32), box, one, one, uv, landmarks)


def test_doubles_go_neighbours_stay():
    found = joined(
        [
            *(hand_at(0, 0, 0.6), hand_at(12, 0, 0.9), hand_at(200, 0, 0.5)),  # 12 of 50 pixels
            *(hand_at(0, 1, 0.6), hand_at(13, 1, 0.9)),
            *(hand_at(0, 2, 0.7), hand_at(0, 2, 0.7)),
            hand_at(0, 3, 0.1),
        ]
    )
    kept = without_doubles(found, 0.25, 0.75)
    assert kept.frame.tolist() == [0, 0, 1, 1, 2, 3]
    np.testing.assert_allclose(kept.score[:2], [0.9, 0.5])
    np.testing.assert_allclose(without_doubles(kept, 0.25, 0.75).score, kept.score)


def test_a_hand_within_another_is_one():
    found = joined([hand_at(0, 0, 0.9), hand_at(7, 0, 0.8), hand_at(0, 1, 0.9), hand_at(9, 1, 0.8)])
    kept = without_doubles(found, 0.0, 0.75)  # 23 and 21 of 30 pixels are shared
    assert kept.frame.tolist() == [0, 1, 1]


def test_a_chain_of_doubles_loses_only_what_touches_a_kept_one():
    found = joined([hand_at(0, 0, 0.9), hand_at(10, 0, 0.8), hand_at(20, 0, 0.7)])
    np.testing.assert_allclose(without_doubles(found, 0.25, 0.75).score, [0.9, 0.7])


def test_says_what_it_lacks(tmp_path, monkeypatch):
    monkeypatch.setenv("MINT_HUB_ENVIRONMENTS", str(tmp_path))
    (lack,) = MediaPipeHands().lacks()
    assert "mediapipe==0.10.21" in lack.what
    settings = MediaPipeSettings(python=str(tmp_path / "python"))
    (lack,) = MediaPipeHands(settings).lacks()
    assert "setting python" in lack.what
    assert MediaPipeHands(replace(settings, python=sys.executable)).lacks() == ()
    file = make.video(tmp_path / "a.mp4", 3)
    clip = clip_of(file, 3)
    with pytest.raises(NotReadyError, match="setting python"):
        MediaPipeHands(settings).run_clip(clip, video_of(clip))
    with pytest.raises(NotReadyError, match="No module named 'mediapipe'"):
        MediaPipeHands(replace(settings, python=sys.executable)).run_clip(clip, video_of(clip))
    with pytest.raises(StageError, match="expected 5 frames"):
        MediaPipeHands().run_clip(clip_of(file, 5), video_of(clip))


@pytest.mark.real
def test_on_a_real_clip(real_dir):
    if missing := ENVIRONMENT.ready():
        pytest.skip(f"needs {missing}")
    file = real_dir / "hot3d" / "clip-2.mp4"
    clip = clip_of(file, 60)
    stage = MediaPipeHands()
    try:
        found = stage.run_clip(clip, video_of(clip)).clips[0].detections
    finally:
        stage.close()
    assert found is not None
    assert len(np.unique(found.frame)) >= 57
    size = np.linalg.norm(found.landmarks_m[:, 0] - found.landmarks_m[:, 9], axis=-1)
    assert 0.06 < np.median(size) < 0.12
    inside = (found.landmarks_uv >= -50) & (found.landmarks_uv <= 562)
    assert inside.mean() > 0.99
    # of two hands the right one is mostly the one on the right
    right = []
    for frame in np.unique(found.frame):
        (here,) = np.nonzero(found.frame == frame)
        if len(here) == 2:
            order = here[np.argsort(found.box_xyxy[here, 0])]
            right += [found.right_score[order[0]] < 0.5, found.right_score[order[1]] > 0.5]
    assert len(right) > 20
    assert np.mean(right) > 0.6
