"""The SfM stages: what they make of a mapper's answer, and the mapper itself on a real clip."""

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from mint_hub.geometry import rigid
from mint_hub.geometry.rotations import geodesic_angle, mean_rotation
from mint_hub.labelling.records import Clip, Intrinsics, Video
from mint_hub.labelling.stage import StageError
from mint_hub.labelling.stages import sfm_camera, sfm_gate
from mint_hub.labelling.stages.sfm_camera import (
    SfmCamera,
    SfmCameraSettings,
    SfmIntrinsics,
    SfmIntrinsicsSettings,
)
from mint_hub.labelling.stages.sfm_points import points_of
from mint_hub.loaders.video import probe
from mint_hub.loaders.vitra import from_vitra
from tests.labelling import sfm_scenes as scenes

EVIDENCE = {"features": 900.0, "matches": 400.0, "flow_px": 9.0, "turning": 0.1}


class Answers:
    """Stands in for the worker: answers in turn, and keeps what was asked."""

    def __init__(self, *answers: Any) -> None:
        self.answers, self.asked = list(answers), []

    def call(self, method: str, arrays: Any, **values: Any) -> Any:
        self.asked.append((method, arrays, values))
        return self.answers.pop(0) if len(self.answers) > 1 else self.answers[0]

    def close(self) -> None:
        self.asked.append(("close", {}, {}))


@pytest.fixture
def film(tmp_path: Path) -> Clip:
    """Forty frames of the plane, with a field of view."""
    T = scenes.path(40)
    file = tmp_path / "v.mp4"
    writer = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*"mp4v"), 30.0, scenes.SIZE_HW[::-1])
    for image in scenes.render(T):
        writer.write(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
    writer.release()
    fov = (2 * np.arctan(120 / scenes.FOCAL), 2 * np.arctan(160 / scenes.FOCAL))
    return Clip(
        key="v-3",
        video=file,
        first_frame=0,
        image_size_hw=scenes.SIZE_HW,
        fps=30.0,
        source_timestamps_s=7.0 + np.arange(40) / 30.0,
        intrinsics=Intrinsics(fov, "given", 1.0),
    )


def mapped(first: int, last: int, shared: list[int]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Arrays and summary of a model whose keyframes are spread evenly over first .. last."""
    T = scenes.path(40)
    numbers = np.linspace(first, last, len(shared) + 1).round().astype(int)
    found, points = scenes.keyframes(T, numbers.tolist())
    count = last + 1 - first
    arrays = {
        "keyframe": numbers,
        "shared": np.array(shared),
        "T": T[first : last + 1],
        "solved": np.ones(count, bool),
        "residual": np.full(count, 0.5),
        "points": points,
        "obs_frame": np.repeat(numbers, [len(k.point) for k in found]),
        "obs_point": np.concatenate([k.point for k in found]),
        "obs_uv": np.concatenate([k.uv for k in found]),
    }
    summary = {
        "images": len(numbers),
        "points": 400,
        "focal_px": [260.0, 260.0],
        "residual_px": 0.5,
        "angle_deg": 4.0,
        "extent": 0.4,
        "shared": shared,
    }
    return arrays, summary


def answer(*models: tuple[dict[str, Any], dict[str, Any]], **evidence: float) -> Any:
    arrays = {f"{i}/{k}": v for i, (named, _) in enumerate(models) for k, v in named.items()}
    return arrays, {"models": [s for _, s in models], "evidence": {**EVIDENCE, **evidence}}


def solve(film: Clip, *answers: Any) -> tuple[Any, Answers]:
    stage = SfmCamera(SfmCameraSettings(min_clip_s=0.3, min_images=8))
    stage._worker = worker = Answers(*answers)  # type: ignore[assignment]
    return stage.run_clip(film, scenes.video_of(film)), worker


def test_a_clip_that_holds_together_comes_back_whole(film: Clip) -> None:
    outcome, worker = solve(film, answer(mapped(0, 39, [200] * 8)))
    (clip,) = outcome.clips
    assert outcome.lost == ()
    assert clip.key == film.key
    path = clip.camera
    np.testing.assert_allclose(path.T_camera_from_world, scenes.path(40), atol=1e-12)
    assert path.covisible.tolist() == [200] * 40
    assert (path.source, path.metric) == ("sfm", False)
    method, arrays, values = worker.asked[0]
    assert method == "camera"
    assert values["focal_px"] == pytest.approx([260, 260])
    assert arrays["images"].shape == (40, *scenes.SIZE_HW)
    assert {0, 39} <= set(arrays["frames"].tolist())
    (points,) = points_of(clip)
    uv, depth = points.seen_near(20, 30, scenes.K)
    at = scenes.on_plane(uv, scenes.path(40)[20]) @ scenes.path(40)[20, :3, :3].T
    np.testing.assert_allclose(depth, (at + scenes.path(40)[20, :3, 3])[:, 2])


def test_a_clip_is_split_at_a_wrong_link_and_every_second_is_accounted_for(film: Clip) -> None:
    outcome, worker = solve(film, answer(mapped(0, 39, [200, 150, 0, 180, 170, 160])))
    assert len(worker.asked) > 1  # more keyframes were tried before
    first, second = outcome.clips
    assert (first.key, second.key) == ("v-3-c0", "v-3-c1")
    (lost,) = outcome.lost
    assert lost.reason == sfm_gate.UNLINKED
    seconds = sum(c.stop_s - c.start_s for c in outcome.clips) + lost.seconds
    assert seconds == pytest.approx(film.stop_s - film.start_s)
    for clip in outcome.clips:
        np.testing.assert_allclose(clip.camera.T_camera_from_world[0], np.eye(4), atol=1e-12)
        points = points_of(clip)[0]
        assert points.units_of(clip) == pytest.approx(1.0)
        assert len(points.timestamps_s) == clip.num_frames


def test_two_maps_give_two_clips(film: Clip) -> None:
    outcome, _ = solve(film, answer(mapped(20, 39, [150] * 4), mapped(0, 17, [150] * 3)))
    assert [(c.first_frame, c.num_frames) for c in outcome.clips] == [(0, 18), (20, 20)]


@pytest.mark.parametrize(
    ("given", "why"),
    [
        (answer(flow_px=0.1), sfm_gate.STILL),
        (answer(turning=1.0), sfm_gate.STILL),
        (answer(features=10), sfm_gate.FLAT),
        (answer(matches=3), sfm_gate.UNMATCHED),
        (answer(), sfm_gate.UNSOLVED),
        (answer(mapped(0, 39, [0] * 8)), sfm_gate.UNLINKED),
    ],
)
def test_a_clip_without_a_path_is_lost_for_its_reason(film: Clip, given: Any, why: str) -> None:
    outcome, _ = solve(film, given)
    assert outcome.clips == ()
    (lost,) = outcome.lost
    assert (lost.reason, lost.failed) == (why, False)
    assert lost.seconds == pytest.approx(40 / 30)


def test_a_map_whose_rays_do_not_cross_is_no_path(film: Clip) -> None:
    arrays, summary = mapped(0, 39, [200] * 8)
    outcome, _ = solve(film, answer((arrays, {**summary, "angle_deg": 0.2})))
    assert outcome.clips == ()
    assert outcome.lost[0].reason == sfm_gate.STILL


def test_the_better_of_two_tries_is_kept(film: Clip) -> None:
    part, whole = answer(mapped(0, 17, [150] * 3)), answer(mapped(0, 39, [90] * 20))
    long = replace(film)
    stage = SfmCamera(SfmCameraSettings(min_images=8, keyframe_every=5))
    stage._worker = worker = Answers(part, whole)  # type: ignore[assignment]
    outcome = stage.run_clip(long, scenes.video_of(long))
    assert [c.num_frames for c in outcome.clips] == [40]
    assert len(worker.asked) == 2
    assert len(worker.asked[1][1]["frames"]) > 1.5 * len(worker.asked[0][1]["frames"])


def test_intrinsics_are_needed(film: Clip) -> None:
    with pytest.raises(StageError, match="expected intrinsics of clip v-3"):
        SfmCamera().run_clip(replace(film, intrinsics=None), scenes.video_of(film))


def test_one_focal_for_all_clips_from_windows_that_agree(film: Clip) -> None:
    arrays, summary = mapped(0, 39, [200] * 8)
    summary["images"] = 40
    good = answer((arrays, summary))
    wrong = answer((arrays, {**summary, "focal_px": [520.0, 520.0], "points": 50}))
    clips = tuple(replace(film, key=f"v-{i}", intrinsics=None) for i in range(5))
    stage = SfmIntrinsics(SfmIntrinsicsSettings(start_fov_deg=(80.0,)))
    stage._worker = worker = Answers(good, wrong, good)  # type: ignore[assignment]
    video = stage.run_video(replace(scenes.video_of(film), clips=clips))
    assert len(worker.asked) == 3
    assert {c.intrinsics for c in video.clips} == {video.clips[0].intrinsics}
    found = video.clips[0].intrinsics
    assert found is not None
    want = (2 * np.arctan(120 / 260), 2 * np.arctan(160 / 260))
    assert found.fov_vh_rad == pytest.approx(want)
    assert 0.3 < found.confidence < 0.9
    assert video.reports[-1].numbers["agreeing"] == 2


def test_a_video_without_a_focal_loses_its_clips_for_the_reason(film: Clip) -> None:
    stage = SfmIntrinsics()
    stage._worker = worker = Answers(answer(flow_px=0.0))  # type: ignore[assignment]
    video = stage.run_video(scenes.video_of(film))
    assert video.clips == ()
    assert [lost.reason for lost in video.lost] == [sfm_gate.STILL]
    assert len(worker.asked) == 1  # no other start would help
    assert stage.run_video(replace(video, lost=())).lost == ()


def test_windows_are_spread(film: Clip) -> None:
    long = replace(film, source_timestamps_s=np.arange(900) / 30.0)
    assert sfm_camera.spread([long], 3, 10.0) == [
        (long, 0, 300),
        (long, 300, 600),
        (long, 600, 900),
    ]
    clips = [replace(film, key=f"v-{i}") for i in range(9)]
    assert [c.key for c, _, _ in sfm_camera.spread(clips, 3, 10.0)] == ["v-0", "v-4", "v-8"]
    assert sfm_camera.spread([film], 3, 10.0) == [(film, 0, 40)]


def test_only_maps_that_hold_together_speak_for_a_focal() -> None:
    summary = mapped(0, 39, [200] * 8)[1]
    assert sfm_camera.trusted(summary, 10)
    assert not sfm_camera.trusted(summary, 15)  # of too few images
    assert not sfm_camera.trusted({**summary, "shared": [200] * 5 + [0] * 3}, 10)
    assert sfm_camera.trusted({**summary, "images": 30}, 75)


@pytest.mark.real
@pytest.mark.slow
def test_against_the_annotation_of_a_real_clip(real_dir: Path, tmp_path: Path) -> None:
    """25 frames: ATE under Sim(3) below 0.2 cm, rotation below 0.5 degrees, free focal near."""
    if missing := SfmCamera().lacks():
        pytest.skip(f"pycolmap is not there: {missing[0]}")
    film = tmp_path / "clip.mp4"
    shutil.copy(next((real_dir / "ego4d").glob("*.mp4")), film)
    truth = from_vitra(next((real_dir / "ego4d").glob("*.npy")))
    info = probe(film)
    clip = Clip("ego4d", film, 0, info.image_size_hw, 30.0, np.arange(25) / 30.0)
    video = Video("ego4d", "", "ego4d", film, 25 / 30, 30.0, info.image_size_hw, clips=(clip,))
    intrinsics, camera = SfmIntrinsics(), SfmCamera()
    try:
        video = intrinsics.run_video(video)
        outcome = camera.run_clip(video.clips[0], video)
    finally:
        intrinsics.close()
        camera.close()
    (solved,) = outcome.clips
    assert solved.intrinsics is not None
    assert solved.camera is not None
    assert solved.intrinsics.fov_vh_rad[1] == pytest.approx(truth.fov_vh_rad[0, 1], rel=0.03)
    assert solved.camera.solved.all()
    T_world_from_camera = rigid.inverse(solved.camera.T_camera_from_world)
    want = truth.T_world_from_camera
    fit = rigid.umeyama(T_world_from_camera[:, :3, 3], want[:, :3, 3])
    error = np.linalg.norm(fit.apply(T_world_from_camera[:, :3, 3]) - want[:, :3, 3], axis=1)
    assert np.sqrt((error**2).mean()) < 0.002
    turn = want[:, :3, :3] @ np.swapaxes(T_world_from_camera[:, :3, :3], -1, -2)
    off = geodesic_angle(want[:, :3, :3], mean_rotation(turn) @ T_world_from_camera[:, :3, :3])
    assert np.degrees(off).max() < 0.5
