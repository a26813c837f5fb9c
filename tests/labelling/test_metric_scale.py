"""Whose word makes metres, and what becomes of the path."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mint_hub.labelling.records import Clip, Detections, StageReport
from mint_hub.labelling.stages.metric_scale import MetricScale, MetricScaleSettings, pooled
from mint_hub.labelling.stages.scale_evidence import Estimate
from mint_hub.labelling.stages.sfm_points import MapPoints, points_of
from tests.labelling import sfm_scenes as scenes


def scaled(clip: Clip, *known: str, enlarged: float = 1.0) -> Clip:
    stage = MetricScale(MetricScaleSettings(known))
    return stage.run_video(scenes.video_of(clip, enlarged)).clips[0]


def length_between(frame: int, first: tuple[float, float], second: tuple[float, float]) -> float:
    T = scenes.path(31)[frame]
    points = scenes.on_plane(np.array([first, second]), T)
    return float(np.linalg.norm(points[0] - points[1]))


def test_the_users_factor_is_applied_and_nothing_else_moves(tmp_path: Path) -> None:
    clip = scenes.clip_with_map(tmp_path)
    got = scaled(clip, "2.5")
    assert clip.camera is not None
    assert got.camera is not None
    assert got.scale is not None
    assert (got.scale.source, got.scale.metres_per_unit) == ("given", 2.5)
    assert got.camera.metric
    before, after = clip.camera.T_camera_from_world, got.camera.T_camera_from_world
    np.testing.assert_allclose(after[:, :3, 3], 2.5 * before[:, :3, 3])
    np.testing.assert_array_equal(after[:, :3, :3], before[:, :3, :3])


@pytest.mark.parametrize("unit", [1.0, 0.2])
def test_a_known_length_in_source_pixels(tmp_path: Path, unit: float) -> None:
    """Also where the path was rescaled after the map was kept, as stitching does."""
    clip = scenes.clip_with_map(tmp_path, unit=unit)
    metres = 0.8 * length_between(10, (100, 80), (220, 160))
    got = scaled(clip, f"{metres}m:200,160-440,320@{5 + 10 / 30}", enlarged=2.0)
    assert got.scale is not None
    assert got.scale.source == "length"
    assert got.scale.metres_per_unit == pytest.approx(0.8 / unit, rel=0.02)
    assert got.scale.confidence > 0.5


@pytest.mark.parametrize(
    ("known", "problem"),
    [
        ("1m:900,20-30,40@5.5", "expected a pixel of the source video"),
        ("1m:10,20-30,40@5.5", "no map points there"),
    ],
)
def test_a_length_that_cannot_be_used_is_told(tmp_path: Path, known: str, problem: str) -> None:
    clip = scenes.clip_with_map(tmp_path)
    if "map" in problem:
        (tmp_path / "v-0.points.npz").unlink()
    got = scaled(clip, known)
    assert got.scale is not None
    assert got.scale.source == "none"
    assert problem in got.reports[-1].numbers["problems"][0]


def test_a_length_elsewhere_in_the_video_is_not_for_this_clip(tmp_path: Path) -> None:
    got = scaled(scenes.clip_with_map(tmp_path), "1m:10,20-30,40@50")
    assert got.scale is not None
    assert got.scale.source == "none"
    assert "problems" not in got.reports[-1].numbers


def test_metric_depth_beats_nothing_and_a_length_beats_it(tmp_path: Path) -> None:
    clip = scenes.clip_with_map(tmp_path, unit=3.0)
    T = scenes.path(31)
    v, u = np.mgrid[0:60, 0:80]
    pixels = np.column_stack([u.ravel() * 4 + 2.0, v.ravel() * 4 + 2.0])
    depth_m = []
    for t in (0, 10, 20):
        points = scenes.on_plane(pixels, T[t]) @ T[t, :3, :3].T + T[t, :3, 3]
        depth_m.append(0.5 * points[:, 2].reshape(60, 80))
    np.savez(
        tmp_path / "depth.npz",
        timestamps_s=clip.source_timestamps_s[[0, 10, 20]],
        depth_m=np.array(depth_m, np.float32),
    )
    seen = StageReport("depth", "x", "1", numbers={"depth_maps": str(tmp_path / "depth.npz")})
    clip = replace(clip, reports=(*clip.reports, seen))
    by_depth = scaled(clip).scale
    assert by_depth is not None
    assert by_depth.source == "depth"
    assert by_depth.metres_per_unit == pytest.approx(0.5 / 3, rel=0.02)
    by_length = scaled(clip, f"1m:100,80-220,160@{5 + 10 / 30}").scale
    assert by_length is not None
    assert by_length.source == "length"


def test_hands_are_a_last_and_weak_resort(tmp_path: Path) -> None:
    clip = scenes.clip_with_map(tmp_path)
    rng = np.random.default_rng(0)
    hand = rng.normal(0, 0.04, (21, 3))
    frames = np.arange(0, 31, 5, dtype=np.int32)
    uv = []
    for _ in frames:
        camera = hand + np.array([0.0, 0.0, 0.4])
        uv.append(camera[:, :2] / camera[:, 2:] * scenes.FOCAL + scenes.K[:2, 2])
    n = len(frames)
    clip = replace(
        clip,
        detections=Detections(
            frame=frames,
            box_xyxy=np.zeros((n, 4), np.float32),
            score=np.ones(n, np.float32),
            right_score=np.ones(n, np.float32),
            landmarks_uv=np.array(uv, np.float32),
            landmarks_m=np.tile(hand, (n, 1, 1)).astype(np.float32),
        ),
    )
    got = scaled(clip).scale
    assert got is not None
    assert got.source == "hands"
    assert got.metres_per_unit == pytest.approx(0.4, rel=0.2)  # the plane is about one unit away
    assert got.confidence <= 0.3
    assert got.log_sigma >= 0.3


def test_a_metric_camera_passes_and_a_clip_without_evidence_says_none(tmp_path: Path) -> None:
    clip = scenes.clip_with_map(tmp_path)
    assert clip.camera is not None
    metric = scaled(replace(clip, camera=replace(clip.camera, metric=True)))
    assert metric.scale is not None
    assert metric.camera is not None
    assert (metric.scale.source, metric.scale.metres_per_unit) == ("camera", 1.0)
    nobody = scaled(clip).scale
    assert nobody is not None
    assert (nobody.source, nobody.confidence) == ("none", 0.0)
    assert nobody.log_sigma >= 1


def test_a_scale_that_cannot_be_read_fails_before_any_work() -> None:
    with pytest.raises(ValueError, match="expected a factor"):
        MetricScale(MetricScaleSettings(("twice",)))


def test_precise_estimates_count_more() -> None:
    got = pooled([Estimate(1.0, 0.01), Estimate(2.0, 1.0)])
    assert 1.0 < got.metres_per_unit < 1.01
    assert pooled([Estimate(1.0, 0.1), Estimate(1.0, 0.1)]).log_sigma < 0.1


def test_map_points_survive_cutting_moving_and_rescaling(tmp_path: Path) -> None:
    clip = scenes.clip_with_map(tmp_path, unit=4.0)
    (points,) = points_of(clip)
    part = clip.window(8, 25, "v-0-part")
    assert part.camera is not None
    world = np.eye(4)
    world[:3, 3] = [3.0, -1.0, 2.0]
    moved = replace(part.camera, T_camera_from_world=part.camera.T_camera_from_world @ world)
    assert points.units_of(replace(part, camera=moved)) == pytest.approx(4.0)
    still = replace(part.camera, T_camera_from_world=np.tile(np.eye(4), (17, 1, 1)))
    assert points.units_of(replace(part, camera=still)) is None
    elsewhere = replace(part, source_timestamps_s=part.source_timestamps_s + 100)
    assert points.units_of(elsewhere) is None


def test_a_damaged_file_of_points_is_named(tmp_path: Path) -> None:
    path = tmp_path / "bad.npz"
    path.write_bytes(b"nothing of the kind")
    with pytest.raises(ValueError, match=r"bad\.npz: expected map points"):
        MapPoints.load(path)
    with pytest.raises(FileNotFoundError):
        MapPoints.load(tmp_path / "none.npz")
