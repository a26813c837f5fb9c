"""MegaSaM's path comes out in metres: the factor it divided depth by is handed back."""

import sys
from pathlib import Path

import numpy as np
import pytest

from mint_hub.geometry.rigid import inverse
from mint_hub.labelling.stage import NotReadyError, StageError
from mint_hub.labelling.stages.megasam import (
    MegaSamCamera,
    MegaSamSettings,
    metres_per_unit,
    read_output,
)
from tests import video_files as make
from tests.labelling.research_projects import (
    MEGASAM_METRIC,
    MEGASAM_MONO,
    MEGASAM_TRACK,
    clip_of,
    video_of,
    write_files,
)


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    return write_files(
        tmp_path / "mega-sam",
        {
            "Depth-Anything/run_videos.py": MEGASAM_MONO,
            "Depth-Anything/checkpoints/depth_anything_vitl14.pth": "mono weights",
            "UniDepth/scripts/demo_mega-sam.py": MEGASAM_METRIC,
            "camera_tracking_scripts/test_demo.py": MEGASAM_TRACK,
            "checkpoints/megasam_final.pth": "megasam weights",
        },
    )


def test_a_clip_in_metres(checkout, tmp_path):
    clip = clip_of(make.video(tmp_path / "a.mp4", 12), 8, first=2, focal=40.0)
    before = sorted(checkout.rglob("*"))
    settings = MegaSamSettings(checkout=str(checkout), python=sys.executable)
    after = MegaSamCamera(settings).run_clip(clip, video_of(clip)).clips[0]
    assert after.camera is not None
    assert after.camera.metric
    positions = inverse(after.camera.T_camera_from_world)[:, :3, 3]
    expected = np.outer(0.01 * np.arange(8), [1, 0, 0])
    np.testing.assert_allclose(positions, expected, rtol=1e-5, atol=1e-9)
    numbers = after.reports[-1].numbers
    assert numbers["metres_per_unit"] == pytest.approx(1 / 1.8, rel=1e-5)
    assert numbers["focal_px"][0] == pytest.approx(40.0)  # it was given the clip's field of view
    assert sorted(checkout.rglob("*")) == before  # nothing is left in the user's checkout


def test_holes_do_not_tell_the_scale():
    rng = np.random.default_rng(0)
    metric = rng.uniform(0.3, 4.0, (5, 24, 32))
    own = metric / 0.7 * np.exp(rng.normal(0, 0.02, metric.shape))
    own[:, :, ::2] = 1e-6  # more than a third of all values
    metric[:, :4] = np.nan
    metric[:, 4:6] = 0
    metres, spread, pixels = metres_per_unit(own, metric)
    assert metres == pytest.approx(0.7, rel=5e-3)
    assert spread == pytest.approx(0.02, rel=0.2)
    assert pixels == 5 * 18 * 16
    # sizes need not agree: the path's depth is smaller
    smaller, _, _ = metres_per_unit(own[:, 1::2, 1::2], metric)
    assert smaller == pytest.approx(0.7, rel=0.05)
    with pytest.raises(StageError, match="holes only"):
        metres_per_unit(np.zeros((1, 2, 2)), metric)


def test_a_step_that_fails_says_so(checkout, tmp_path):
    (checkout / "UniDepth/scripts/demo_mega-sam.py").write_text("raise MemoryError('of the GPU')")
    clip = clip_of(make.video(tmp_path / "a.mp4", 3), 3, focal=40.0)
    settings = MegaSamSettings(checkout=str(checkout), python=sys.executable)
    with pytest.raises(StageError, match=r"megasam, UniDepth: ended with status 1: .*of the GPU"):
        MegaSamCamera(settings).run_clip(clip, video_of(clip))


def test_files_that_are_not_as_expected(tmp_path):
    clip = clip_of(make.video(tmp_path / "a.mp4", 3), 3)
    file, metric = tmp_path / "a_droid.npz", np.ones((3, 4, 5), np.float32)
    with pytest.raises(StageError, match=r"a_droid\.npz"):
        read_output(file, metric, clip)
    np.savez(file, depths=np.ones((3, 4, 5)), intrinsic=np.eye(3))
    with pytest.raises(StageError, match="cam_c2w"):
        read_output(file, metric, clip)
    broken = np.tile(np.eye(4), (3, 1, 1))
    broken[1] *= 3
    for poses, words in ((broken, "none at frame 1"), (broken[:2], "each of 3 frames")):
        np.savez(file, depths=np.ones((3, 4, 5)), intrinsic=np.eye(3), cam_c2w=poses)
        with pytest.raises(StageError, match=words):
            read_output(file, metric, clip)


def test_says_what_it_lacks(tmp_path):
    assert len(MegaSamCamera().lacks()) == 4
    clip = clip_of(make.video(tmp_path / "a.mp4", 3), 3, focal=40.0)
    with pytest.raises(NotReadyError, match="setting checkout"):
        MegaSamCamera().run_clip(clip, video_of(clip))
