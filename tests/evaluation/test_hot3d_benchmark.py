"""HOT3D in the protocol's camera: real ground truth, and clips made to the published layout."""

import csv
import io
import json
import shutil
import tarfile
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from mint_hub.evaluation.bench_hot3d import PROTOCOL_K, SIZE_HW, Upright
from mint_hub.evaluation.benchmarks import open_benchmark
from mint_hub.evaluation.clips import BenchmarkError, MissingFilesError, Source
from mint_hub.evaluation.evaluate import evaluate
from mint_hub.evaluation.predictor import Predictor
from mint_hub.evaluation.scoring import ClipScorer
from mint_hub.geometry import rigid
from mint_hub.geometry.camera import project
from mint_hub.geometry.lenses import Fisheye624Lens, Lens
from mint_hub.loaders.hot3d import from_hot3d
from tests.evaluation_data import moved, save_all
from tests.geometry.test_mano_files import mano_fields, write_mano

LENS = Fisheye624Lens((352, 352), 150.0, 150.0, 174.0, 177.0, (0.1, -0.05, 0.01, *[0.0] * 9))
UPRIGHT = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]])


@pytest.fixture(scope="module")
def mano_dir(tmp_path_factory) -> str:
    folder = tmp_path_factory.mktemp("m") / "mano"
    return str(write_mano(folder, mano_fields(0), mano_fields(1)))


@pytest.fixture(scope="module")
def real(real_dir: Path) -> Path:
    return real_dir / "hot3d_gt"


# ----------------------------------------------------------------------- real ground truth


@pytest.fixture
def copied(real, tmp_path):
    """A sequence whose files may be spoilt."""
    folder = tmp_path / "P"
    for path in real.rglob("*"):
        if path.is_file():
            there = folder / path.relative_to(next(real.iterdir()))
            there.parent.mkdir(parents=True, exist_ok=True)
            there.write_bytes(path.read_bytes())
    return folder


@pytest.mark.parametrize(
    ("name", "message"),
    [
        (
            "mano_hand_pose_trajectory.jsonl",
            r"trajectory\.jsonl: expected this file, found none; is",
        ),
        ("online_calibration.jsonl", r"expected online_calibration\.jsonl .*found neither; is"),
        ("masks/mask_headset_pose_available.csv", r"available\.csv: no such file; .*; is"),
    ],
)
def test_a_sequence_without_a_file_says_which_and_where_to_get_it(copied, name, message):
    (copied / name).unlink()
    with pytest.raises(MissingFilesError, match=f"{message} the download whole.*https://"):
        open_benchmark(Source("hot3d", str(copied))).clip(0)


def test_a_file_cut_short_is_named(copied):
    path = copied / "headset_trajectory.csv"
    path.write_bytes(path.read_bytes()[:3000])
    with pytest.raises(BenchmarkError, match=r"headset_trajectory\.csv: .* is the download whole"):
        open_benchmark(Source("hot3d", str(copied))).clip(0)


def test_hands_off_screen_are_no_false_alarm_of_the_last_frame(real, mano_dir):
    """Motion capture knows hands off screen; who says they are there is wrong by Presence-BA."""
    source = Source("hot3d", str(real), mano_dir=mano_dir)
    clip = open_benchmark(source).clip(0)
    seen = ClipScorer(clip).seen()
    assert clip.truth.presence.all()
    assert seen.any()
    assert not seen.all()
    told = replace(clip.truth, presence=seen)
    copied = ClipScorer(clip).score(clip.truth).hands["published"].metrics()
    assert ClipScorer(clip).score(told).hands["published"].metrics()["Presence-BA"] == 1
    assert copied["Presence-BA"] < 1
    row = evaluate(source).summary["last frame copied"]["hands"]["published"]
    assert row["Presence-BA"][0] > 0.9


def test_real_cameras_are_ideal_against_themselves_and_off_by_the_shift(real, tmp_path):
    source = Source("hot3d", str(real))
    clip = open_benchmark(source).clip(0)
    assert clip.truth.num_frames == 34 == open_benchmark(source).num_frames(0)
    assert clip.truth.image_size_hw == SIZE_HW == clip.image_size_hw
    assert_allclose(clip.K, [[207.8, 0, 239.8], [0, 207.8, 239.8], [0, 0, 1]])
    assert not clip.hands
    assert "recording.vrs" in clip.without_frames
    T = np.array(clip.truth.T_world_from_camera)
    assert_allclose(T, from_hot3d(next(real.iterdir())).T_world_from_camera)
    T[17:, 0, 3] += 0.05
    shifted = replace(clip.truth, T_camera_from_world=np.asarray(rigid.inverse(T)))
    own = ClipScorer(clip).score(clip.truth)
    assert own.hands == {} == own.world
    assert own.camera is not None
    assert own.camera.se3.ate_mm == pytest.approx(0, abs=1e-6)
    other = ClipScorer(clip).score(shifted).camera
    assert other is not None
    assert other.se3.rpe_translation_mm == pytest.approx(50 / np.sqrt(33), rel=1e-3)
    labels = save_all([clip.truth], tmp_path / "labels")
    found = evaluate(source, Predictor.of(str(labels)))
    assert any("no hands that can be read" in w for w in found.warnings)
    assert found.benchmark["published"] == "hot3d"


def test_real_hands_score_with_files_in_manos_format(real, mano_dir):
    clip = open_benchmark(Source("hot3d", str(real), mano_dir=mano_dir)).clip(0)
    assert clip.hands
    assert clip.hand_model.shape_space == "mano"
    assert clip.truth.meta["hand_model"] == clip.hand_model.name
    assert open_benchmark(Source("hot3d", str(real), mano_dir=mano_dir)).num_frames(0) == 34
    own, far = (
        ClipScorer(clip).score(e).hands["published"].metrics()
        for e in (clip.truth, moved(clip.truth, 0.1))
    )
    assert clip.truth.presence.all()
    assert own["CT-p"] == pytest.approx(0, abs=1e-9)
    assert own["MPJPE-p"] == pytest.approx(0, abs=1e-9)
    assert far["CT-p"] == pytest.approx(0.1, abs=1e-6)
    assert far["MPJPE-p"] == pytest.approx(0, abs=1e-9)
    assert ClipScorer(clip).score(clip.truth).world["SE(3)"].metrics()["W-MPJPE"] < 1e-6


def test_pictures_named_by_time_become_upright(real, tmp_path):
    folder = shutil.copytree(next(real.iterdir()), tmp_path / "P", copy_function=shutil.copyfile)
    folder.chmod(0o755)
    with (folder / "masks/mask_headset_pose_available.csv").open() as file:
        stamps = [
            row["timestamp[ns]"] for row in csv.DictReader(file) if row["stream_id"] == "214-1"
        ]
    images = folder / "images" / "214-1"
    images.mkdir(parents=True)
    raw = np.zeros((1408, 1408, 3), np.uint8)
    for stamp in stamps:
        cv2.imwrite(str(images / f"{stamp}.png"), raw)
    clip = open_benchmark(Source("hot3d", str(tmp_path))).clip(0)
    assert clip.frames is not None
    assert sum(image.shape == (480, 480, 3) for image in clip.frames.images()) == 34
    (images / f"{stamps[5]}.png").unlink()
    with pytest.raises(MissingFilesError, match="is the download whole"):
        open_benchmark(Source("hot3d", str(tmp_path))).clip(0)


def test_rectified_pixels_are_where_the_protocol_projects(real):
    """A bright dot in the raw picture lands where the protocol's K says, turned or not."""
    lens = Lens.from_dict(from_hot3d(next(real.iterdir())).meta["lens"])
    point_upright = np.array([0.2, -0.12, 0.6])
    for turned in (True, False):
        ray = UPRIGHT.T @ point_upright if turned else point_upright
        u, v = lens.project(ray)
        raw = np.zeros((*lens.image_size_hw, 3), np.uint8)
        cv2.circle(raw, (round(float(u)), round(float(v))), 9, (255, 255, 255), -1)
        upright = Upright.of(lens, turned).apply(raw)[..., 0].astype(float)
        ys, xs = np.nonzero(upright > 100)
        expected, _ = project(point_upright, PROTOCOL_K)
        assert_allclose([xs.mean(), ys.mean()], expected, atol=1.0)


# ----------------------------------------------------------------------------- clips


def clip_tar(path: Path, frames: int = 150, hands: bool = True, images: bool = True) -> Path:
    """A clip in the published layout, random but consistent: pose of frame k is known."""
    path.parent.mkdir(parents=True, exist_ok=True)
    rng = np.random.default_rng(0)
    picture = cv2.imencode(".jpg", np.full((*LENS.image_size_hw, 3), 90, np.uint8))[1].tobytes()
    with tarfile.open(path, "w") as tar:

        def add(name: str, data: bytes) -> None:
            info = tarfile.TarInfo(name)
            info.size = len(data)
            tar.addfile(info, io.BytesIO(data))

        for k in range(frames):
            x, y, z, w = Rotation.from_rotvec([0, 0.01 * k, 0]).as_quat()
            pose = {"translation_xyz": [0.01 * k, 0, 0], "quaternion_wxyz": [w, x, y, z]}
            params = [LENS.fx, LENS.cx, LENS.cy, *LENS.distortion]
            calibration = {
                "label": "camera-rgb",
                "image_width": 352,
                "image_height": 352,
                "projection_model_type": "CameraModelType.FISHEYE624",
                "projection_params": params,
            }
            camera = {"calibration": calibration, "T_world_from_camera": pose}
            add(f"{k:06d}.cameras.json", json.dumps({"214-1": camera}).encode())
            stamp = {"ref_timestamp_ns": 1_000_000_000 + k * 33_333_333}
            add(f"{k:06d}.info.json", json.dumps(stamp).encode())
            if images:
                add(f"{k:06d}.image_214-1.jpg", picture)
            if hands:
                mano = {
                    "thetas": rng.normal(0, 0.1, 15).tolist(),
                    "wrist_xform": [0.1, 0.2, 0.3, 0.01 * k, 0.0, 0.5],
                }
                record = {"right": {"mano_pose": mano}}
                if k != 3:
                    record["left"] = {"mano_pose": mano}
                add(f"{k:06d}.hands.json", json.dumps(record).encode())
        if hands:
            add("__hand_shapes.json__", json.dumps({"mano": [0.1] * 10}).encode())
    return path


def test_clips_are_read_with_cameras_hands_and_upright_pictures(tmp_path, mano_dir):
    clip_tar(tmp_path / "train_aria" / "clip-000007.tar")
    benchmark = open_benchmark(Source("hot3d", str(tmp_path), mano_dir=mano_dir))
    clip = benchmark.clip(0)
    assert clip.key == "hot3d-clip-000007-214-1"
    assert clip.truth.num_frames == 150
    assert clip.truth.fps == pytest.approx(30)
    T = clip.truth.T_world_from_camera
    assert_allclose(T[:, 0, 3], 0.01 * np.arange(150), atol=1e-9)
    raw = Rotation.from_rotvec([0, 0.5, 0]).as_matrix()
    assert_allclose(T[50, :3, :3], raw @ UPRIGHT.T, atol=1e-9)
    assert_array_equal(clip.truth.presence[2:5], [[True, True], [False, True], [True, True]])
    world = clip.truth.wrist_world()
    expected = Rotation.from_rotvec([0.1, 0.2, 0.3]).as_matrix()
    assert_allclose(world[10, 1, :3, :3], expected, atol=1e-6)
    assert_allclose(np.diff(world[:, 1, 0, 3]), 0.01, atol=1e-5)
    assert clip.frames is not None
    image = next(clip.frames.images())
    assert image.shape == (480, 480, 3)
    assert image[240, 240].tolist() == [90, 90, 90]


def test_clips_without_mano_or_annotation_have_cameras(tmp_path):
    clip_tar(tmp_path / "test_aria" / "clip-000001.tar", hands=False, images=False)
    clip_tar(tmp_path / "train_aria" / "clip-000002.tar")
    benchmark = open_benchmark(Source("hot3d", str(tmp_path)))
    assert any("--mano" in note for note in benchmark.notes)
    bare, known = benchmark
    assert not bare.hands
    assert not known.hands
    assert "image_214-1.jpg, found none" in bare.without_frames
    only = open_benchmark(Source("hot3d", str(tmp_path), split="train_aria"))
    assert [c.key for c in only] == ["hot3d-clip-000002-214-1"]


def test_partial_and_wrong_downloads_say_where_to_get_it(tmp_path):
    with pytest.raises(MissingFilesError, match="found no folder; get sequences from https://"):
        open_benchmark(Source("hot3d", str(tmp_path / "none")))
    with pytest.raises(MissingFilesError, match=r"found neither; get .*huggingface\.co"):
        open_benchmark(Source("hot3d", str(tmp_path)))
    path = clip_tar(tmp_path / "train_aria" / "clip-000001.tar", frames=149)
    benchmark = open_benchmark(Source("hot3d", str(tmp_path)))
    with pytest.raises(BenchmarkError, match="expected 150 frames, got 149; download it again"):
        benchmark.clip(0)
    clip_tar(path)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(BenchmarkError, match=r"clip-000001\.tar: .*download it again"):
        benchmark.clip(0)
    path.write_bytes(b"no tar")
    with pytest.raises(BenchmarkError, match="expected a whole tar"):
        benchmark.clip(0)
