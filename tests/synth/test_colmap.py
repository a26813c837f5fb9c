"""A program that knows nothing of us agrees: structure from motion on a synthetic clip.

Focal length and camera path come from pycolmap alone, from the pictures; told are the hands' joints
(they move on their own and are masked), as a detector would tell them.
"""

from pathlib import Path

import numpy as np
import pytest

from mint_hub.geometry.camera import project
from mint_hub.geometry.metrics import trajectory_errors
from mint_hub.geometry.rigid import inverse
from mint_hub.labelling.records import Clip, Detections, Video
from mint_hub.labelling.stages.sfm_camera import (
    SfmCamera,
    SfmCameraSettings,
    SfmIntrinsics,
    SfmIntrinsicsSettings,
)
from mint_hub.loaders.schema import Episode
from mint_hub.synth.episodes import make_clip

SEED, FRAMES, IMAGES = 11, 90, 25


@pytest.mark.slow
def test_structure_from_motion_finds_the_true_focal_and_path(tmp_path: Path) -> None:
    """Focal length within 2 %, ATE under Sim(3) below 1 % of the path."""
    if missing := SfmCamera().lacks():
        pytest.skip(f"pycolmap is not there: {missing[0]}")
    try:
        made = make_clip(SEED, "train", FRAMES)
    except (ImportError, RuntimeError) as error:
        pytest.skip(str(error))
    truth = made.episode
    film = tmp_path / "clip.mp4"
    film.write_bytes(made.members["mp4"])
    clip = Clip(
        key="synth",
        video=film,
        first_frame=0,
        image_size_hw=truth.image_size_hw,
        fps=30.0,
        source_timestamps_s=truth.timestamps_s,
        detections=detections_of(truth),
    )
    size, seconds = truth.image_size_hw, FRAMES / 30
    video = Video("synth", "", "user", film, seconds, 30.0, size, clips=(clip,))
    intrinsics = SfmIntrinsics(SfmIntrinsicsSettings(images=IMAGES))
    camera = SfmCamera(SfmCameraSettings(min_images=IMAGES))
    try:
        video = intrinsics.run_video(video)
        outcome = camera.run_clip(video.clips[0], video)
    finally:
        intrinsics.close()
        camera.close()
    (solved,) = outcome.clips
    assert solved.intrinsics is not None
    assert solved.camera is not None
    assert solved.num_frames == FRAMES
    focal = 1 / np.tan(solved.intrinsics.fov_vh_rad[1] / 2)
    assert focal == pytest.approx(1 / np.tan(truth.fov_vh_rad[0, 1] / 2), rel=0.02)
    found = np.asarray(inverse(solved.camera.T_camera_from_world))
    errors = trajectory_errors(found, truth.T_world_from_camera)
    assert errors.true_path_m > 0.2
    assert errors.sim3.ate_percent < 1
    assert errors.rpe_rotation_deg < 0.2


def detections_of(truth: Episode) -> Detections:
    """What a perfect detector sees: the joints of every hand that is present."""
    frame, hand = np.nonzero(truth.presence)
    uv = np.asarray(project(truth.joints_camera()[frame, hand].astype(float), truth.K[frame])[0])
    return Detections(
        frame=frame.astype(np.int32),
        box_xyxy=np.concatenate([uv.min(1), uv.max(1)], -1).astype(np.float32),
        score=np.ones(len(frame), np.float32),
        right_score=hand.astype(np.float32),
        landmarks_uv=uv.astype(np.float32),
        landmarks_m=np.full((len(frame), 21, 3), np.nan, np.float32),
    )
