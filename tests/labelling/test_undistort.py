"""Undistorting: straight things are straight again, and detections stay on what they saw."""

from pathlib import Path

import numpy as np
import pytest

from mint_hub.geometry.camera import fov_vh_to_K, project
from mint_hub.geometry.lenses import Lens, lens_from, rectification
from mint_hub.labelling.frames import clip_frames
from mint_hub.labelling.records import Clip, Detections, Intrinsics, Video
from mint_hub.labelling.stages.undistort import Undistort, displacement_px, straightened
from mint_hub.loaders.clips import encode_clip

SIZE = (96, 128)
BARREL = {"model": "opencv", "f": 90.0, "distortion": [-0.25, 0.05, 0.0, 0.0]}
FISHEYE = {"model": "kannala_brandt", "f": 60.0, "distortion": [0.05, -0.01, 0.0, 0.0]}
BOTH = pytest.mark.parametrize("spec", [BARREL, FISHEYE], ids=["opencv", "kannala_brandt"])


def seen_through(lens, points):
    """Pixels of points, counted from the picture's corner."""
    return np.asarray(lens.project(points)) + 0.5


def scene(rng, hands=6):
    """Landmarks (N, 21, 3) metres of hands in front of the camera."""
    middle = rng.uniform([-0.25, -0.18, 0.5], [0.25, 0.18, 0.8], (hands, 1, 3))
    return middle + rng.uniform(-0.06, 0.06, (hands, 21, 3))


def found(uv, box=None):
    n = len(uv)
    box = np.concatenate([uv.min(1), uv.max(1)], 1) if box is None else box
    return Detections(
        frame=np.arange(n, dtype=np.int32) % 3,
        box_xyxy=box.astype(np.float32),
        score=np.linspace(0.5, 1, n, dtype=np.float32),
        right_score=np.zeros(n, np.float32),
        landmarks_uv=uv.astype(np.float32),
        landmarks_m=np.ones((n, 21, 3), np.float32),
    )


def stripes(lens, frames=3):
    """Pictures of a wall of vertical stripes, as the lens takes them."""
    rows, columns = np.mgrid[: SIZE[0], : SIZE[1]]
    rays = np.asarray(lens.unproject(np.stack([columns, rows], -1).astype(float)))
    x = rays[..., 0] / rays[..., 2]
    grey = (127 + 100 * np.sin(20 * x)).astype(np.uint8)
    return np.repeat(np.repeat(grey[None, :, :, None], 3, 3), frames, 0)


def clip_of(folder: Path, images, **fields) -> tuple[Clip, Video]:
    path = folder / "v" / "v-0000.mp4"
    path.parent.mkdir()
    path.write_bytes(encode_clip(images, crf=5))
    clip = Clip("v-0000", path, 0, SIZE, 30.0, np.arange(len(images)) / 30, **fields)
    video = Video("v", "uid", "user", folder / "v.mp4", 0.1, 30.0, (2 * SIZE[0], 2 * SIZE[1]))
    return clip, video


def twice(spec):
    """Return the lens at the size of the source video, which is twice the clip's."""
    return {**spec, "f": 2 * spec["f"]}


@BOTH
def test_a_clip_looks_as_a_pinhole_would_have_taken_it(tmp_path, spec):
    lens = lens_from(spec, SIZE)
    points = scene(np.random.default_rng(0))
    detections = found(seen_through(lens, points))
    clip, video = clip_of(tmp_path, stripes(lens), detections=detections)
    stage = Undistort(Undistort.Settings(lens=twice(spec)))
    (done,) = stage.run_clip(clip, video).clips

    fov = np.array(done.intrinsics.fov_vh_rad)
    K = fov_vh_to_K(fov, SIZE)
    assert K[0, 0] == pytest.approx(spec["f"])
    assert Lens.from_dict(done.intrinsics.lens) == lens_from(twice(spec), video.image_size_hw)
    uv, _ = project(points, K)
    np.testing.assert_allclose(done.detections.landmarks_uv, uv, atol=2e-3)
    np.testing.assert_array_equal(done.detections.landmarks_m, detections.landmarks_m)

    assert done.video != clip.video
    assert done.first_frame == 0
    x = (np.arange(SIZE[1]) + 0.5 - K[0, 2]) / K[0, 0]
    wall = 127 + 100 * np.sin(20 * x)
    inside = rectification(lens).valid
    bent = next(clip_frames(clip)).astype(float).mean(-1)
    straight = list(clip_frames(done))
    assert len(straight) == clip.num_frames
    error = np.abs(straight[0].astype(float).mean(-1) - wall)[inside].mean()
    assert error < 0.25 * np.abs(bent - wall)[inside].mean()
    assert done.reports[-1].numbers["changed"] is True


def test_the_lens_of_the_intrinsics_is_taken_when_none_is_set(tmp_path):
    lens = lens_from(twice(BARREL), (2 * SIZE[0], 2 * SIZE[1]))
    given = Intrinsics((1.0, 1.2), "given", 1.0, lens.to_dict())
    clip, video = clip_of(tmp_path, stripes(lens_from(BARREL, SIZE)), intrinsics=given)
    (done,) = Undistort().run_clip(clip, video).clips
    assert done.video != clip.video
    assert done.intrinsics.lens == lens.to_dict()
    assert done.intrinsics.fov_vh_rad[1] == pytest.approx(2 * np.arctan(128 / 2 / 90))


def test_part_of_a_file(tmp_path):
    images = stripes(lens_from(BARREL, SIZE), 4)
    images[3] //= 2
    clip, video = clip_of(tmp_path, images)
    stage = Undistort(Undistort.Settings(lens=twice(BARREL)))
    (done,) = stage.run_clip(clip.window(2, 4, "v-0000-h002"), video).clips
    first, last = clip_frames(done)
    assert first.mean() == pytest.approx(2 * last.mean(), rel=0.1)


def test_without_a_lens_nothing_changes(tmp_path):
    clip, video = clip_of(tmp_path, stripes(lens_from(BARREL, SIZE)))
    (done,) = Undistort().run_clip(clip, video).clips
    assert {**vars(done), "reports": ()} == vars(clip)


def test_a_lens_that_moves_nothing_only_tells_the_focal_length(tmp_path):
    slight = {**BARREL, "distortion": [-0.005, 0, 0, 0]}
    assert 0.1 < displacement_px(rectification(lens_from(slight, SIZE))) < 1
    detections = found(np.full((2, 21, 2), 30.0))
    guess = Intrinsics((1.0, 1.2), "sfm", 0.5)
    clip, video = clip_of(
        tmp_path, stripes(lens_from(BARREL, SIZE)), detections=detections, intrinsics=guess
    )
    (done,) = Undistort(Undistort.Settings(lens=twice(slight))).run_clip(clip, video).clips
    assert done.video == clip.video
    assert done.detections is detections
    assert done.intrinsics.lens is None
    assert done.intrinsics.fov_vh_rad[1] == pytest.approx(2 * np.arctan(128 / 2 / 90))
    assert done.reports[-1].numbers["changed"] is False


def test_a_principal_point_beside_the_middle_is_material():
    shifted = {"f": 90.0, "cx": 66.0, "cy": 47.5}
    assert displacement_px(rectification(lens_from(shifted, SIZE))) == pytest.approx(2.5)


@BOTH
def test_boxes_bound_what_they_bounded(spec):
    lens = lens_from(spec, SIZE)
    uv = seen_through(lens, scene(np.random.default_rng(1), 30))
    done = straightened(found(uv), lens)
    assert len(done.frame) == 30
    low, high = done.landmarks_uv.min(1), done.landmarks_uv.max(1)
    assert (done.box_xyxy[:, :2] <= low + 0.1).all()
    assert (done.box_xyxy[:, 2:] >= high - 0.1).all()
    assert (done.box_xyxy[:, 2:] - done.box_xyxy[:, :2] < 2.5 * (high - low) + 1).all()


def test_what_leaves_the_picture_is_dropped_and_what_nobody_sees_is_nan():
    lens = lens_from({"model": "kannala_brandt", "f": 40.0, "distortion": [0, 0, 0, 0]}, SIZE)
    corner = np.full((1, 21, 2), 1.0)  # 75 degrees from the axis
    middle = np.full((1, 21, 2), 64.0) + np.arange(21)[None, :, None] * 0.1
    middle[0, 0] = np.nan
    done = straightened(
        found(np.concatenate([corner, middle]), np.array([[0, 0, 3, 3], [60, 50, 70, 60]])), lens
    )
    assert done.score.tolist() == [1.0]
    assert np.isnan(done.landmarks_uv[0, 0]).all()
    assert np.isfinite(done.landmarks_uv[0, 1:]).all()
    nothing = straightened(found(np.zeros((0, 21, 2)), np.zeros((0, 4))), lens)
    assert nothing.landmarks_uv.shape == (0, 21, 2)
    assert nothing.box_xyxy.shape == (0, 4)


def test_a_lens_of_another_shape(tmp_path):
    clip, video = clip_of(tmp_path, stripes(lens_from(BARREL, SIZE)))
    wrong = {**BARREL, "image_size_hw": [100, 100]}
    with pytest.raises(ValueError, match="aspect ratio"):
        Undistort(Undistort.Settings(lens=wrong)).run_clip(clip, video)
