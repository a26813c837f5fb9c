"""ARCTIC from files made to its published layout: mean pose, left hand, lens, offsets."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from mint_hub.conventions import SIDES
from mint_hub.evaluation.benchmarks import open_benchmark
from mint_hub.evaluation.clips import BenchmarkError, MissingFilesError, Source
from mint_hub.evaluation.evaluate import evaluate
from mint_hub.evaluation.predictor import Predictor
from mint_hub.evaluation.scoring import ClipScorer
from mint_hub.geometry.camera import project
from mint_hub.geometry.hand_model import HandModel
from mint_hub.geometry.lenses import OpenCVLens
from tests.evaluation_data import save_all
from tests.geometry.test_mano_files import mano_fields, smplx_hand, write_mano

T = 12
OFFSET = 3
K = np.array([[1500.0, 0, 1390], [0, 1510, 1010], [0, 0, 1]])
DIST = np.array([0.1, -0.05, 0.001, -0.002, 0.01, 0.02, 0.0, 0.0])


@pytest.fixture(scope="module")
def mano_dir(tmp_path_factory) -> Path:
    """MANO-format files whose left shape directions are the right hand's, as published."""
    right, left = mano_fields(0), mano_fields(1)
    left["shapedirs"] = left["shapedirs"].copy()
    left["shapedirs"][:, 0] = right["shapedirs"][:, 0]
    return write_mano(tmp_path_factory.mktemp("m") / "mano", right, left)


def arctic(root: Path, images: bool = True) -> dict[str, dict[str, np.ndarray]]:
    rng = np.random.default_rng(0)
    data = root / "arctic_data" / "data"
    (data / "raw_seqs" / "s05").mkdir(parents=True)
    (data / "splits_json").mkdir()
    (data / "meta").mkdir()
    lists = {"train": [], "val": ["s05/box_use_01"], "test": []}
    for name in ("p1", "p2"):
        (data / "splits_json" / f"protocol_{name}.json").write_text(json.dumps(lists))
    (data / "meta" / "misc.json").write_text(json.dumps({"s05": {"ioi_offset": OFFSET}}))
    hands = {
        side: {
            "rot": rng.normal(0, 0.3, (T, 3)),
            "pose": rng.normal(0, 0.2, (T, 45)),
            "trans": rng.normal(0, 0.05, (T, 3)) + np.array([0, 0, 0.6]),
            "shape": rng.normal(0, 1, 10),
            "fitting_err": np.zeros(T),
        }
        for side in SIDES
    }
    turn = Rotation.from_rotvec(np.outer(np.arange(T), [0.0, 0.01, 0.0])).as_matrix()
    camera = {
        "R_k_cam_np": turn,
        "T_k_cam_np": np.arange(T)[:, None, None] * np.array([[0.01], [0], [0]]),
        "intrinsics": K,
        "dist8": DIST,
        "ego_markers.label": ["a", "b"],
    }
    base = data / "raw_seqs" / "s05" / "box_use_01"
    np.save(f"{base}.mano.npy", hands, allow_pickle=True)  # type: ignore[arg-type]
    np.save(f"{base}.egocam.dist.npy", camera, allow_pickle=True)  # type: ignore[arg-type]
    if images:
        folder = data / "cropped_images" / "s05" / "box_use_01" / "0"
        folder.mkdir(parents=True)
        for k in range(T):
            picture = np.full((600, 840, 3), 10 * k, np.uint8)
            cv2.imwrite(str(folder / f"{k + OFFSET:05d}.jpg"), picture)
    return hands


def test_joints_are_where_manos_own_code_puts_them(tmp_path, mano_dir):
    """The mean pose added, the left file as published."""
    hands = arctic(tmp_path)
    clip = open_benchmark(Source("arctic", str(tmp_path), mano_dir=str(mano_dir))).clip(0)
    assert clip.key == "arctic-s05-box_use_01"
    joints = np.asarray(clip.hand_model.keypoints(clip.truth.hand_state.astype(float)))
    world = (clip.truth.T_world_from_camera[:, None, None, :3, :3] @ joints[..., None])[
        ..., 0
    ] + clip.truth.T_world_from_camera[:, None, None, :3, 3]
    fields = {"right": mano_fields(0), "left": mano_fields(1)}
    for hand, side in enumerate(SIDES):
        own = hands[side]
        _, expected, _ = smplx_hand(
            mano_dir,
            side,
            betas=np.tile(own["shape"], (T, 1)),
            global_orient=own["rot"],
            hand_pose=own["pose"] + fields[side]["hands_mean"],
            transl=own["trans"],
        )
        assert_allclose(world[:, hand, 0], expected[:, 0], atol=1e-6)
        assert_allclose(world[:, hand, 5:8], expected[:, 1:4], atol=1e-5)
    assert ClipScorer(clip).score(clip.truth).hands["published"].metrics()["FAcc"] == 1


def test_truth_is_ideal_and_rows_are_the_same_beside_any_prediction(tmp_path, mano_dir):
    """The truth's hand is ARCTIC's, whatever hand --mano would give a prediction."""
    arctic(tmp_path / "download")
    source = Source("arctic", str(tmp_path / "download"), mano_dir=str(mano_dir))
    truth = open_benchmark(source).clip(0).truth
    labels = save_all([truth], tmp_path / "labels")
    beside = evaluate(source, Predictor.of(str(labels), mano_dir=str(mano_dir)))
    own = beside.summary["prediction"]["hands"]["published"]
    for name in ("MPJPE-p", "PA-MPJPE-p", "EPE-p", "GO-p", "CT-p"):
        assert own[name][0] == pytest.approx(0, abs=1e-9)
    alone = evaluate(source)
    for row in alone.rows:
        ours, theirs = (r.summary[row]["hands"].get("published", {}) for r in (alone, beside))
        np.testing.assert_equal(theirs, ours)
    other = replace(truth, meta={**truth.meta, "hand_model": "mano"})  # repaired, as a network's
    labels = save_all([other], tmp_path / "other")
    found = evaluate(source, Predictor.of(str(labels), mano_dir=str(mano_dir)))
    assert found.summary["prediction"]["hands"]["published"]["MPJPE-p"][0] > 0.1


def test_the_truth_is_the_same_without_its_pictures_and_in_a_copy(tmp_path, mano_dir):
    arctic(tmp_path / "a")
    sources = [Source("arctic", str(tmp_path / n), mano_dir=str(mano_dir)) for n in ("a", "b")]
    one = open_benchmark(sources[0]).clip(0)
    shutil.copytree(tmp_path / "a", tmp_path / "b", copy_function=shutil.copyfile)
    two = open_benchmark(sources[1]).clip(0)
    assert two.truth_stamp() == one.truth_stamp()
    assert two.stamp() != one.stamp()
    shutil.rmtree(tmp_path / "b/arctic_data/data/cropped_images")
    assert open_benchmark(sources[1]).clip(0).truth_stamp() == one.truth_stamp()
    repaired = replace(one, hand_model=HandModel.from_mano(mano_dir))
    assert repaired.truth_stamp() != one.truth_stamp()


def test_lengths_are_known_without_the_hands(tmp_path, mano_dir, monkeypatch):
    arctic(tmp_path)
    folder = tmp_path / "arctic_data/data/cropped_images/s05/box_use_01/0"
    (folder / f"{OFFSET:05d}.jpg").unlink()
    source = Source("arctic", str(tmp_path), mano_dir=str(mano_dir), clip_frames=5)
    assert open_benchmark(source).clip(2).truth.num_frames == 1
    monkeypatch.setattr("mint_hub.evaluation.bench_arctic.hand_states", None)
    benchmark = open_benchmark(source)
    assert [benchmark.num_frames(i) for i in range(len(benchmark))] == [5, 5, 1]
    monkeypatch.undo()
    greys = [int(image[240, 336, 0]) for image in benchmark.clip(1).frames.images(2)]
    assert_allclose(greys, 10 * np.arange(8, 11), atol=2)


def test_a_subject_without_an_offset_is_told_where_it_stands(tmp_path):
    arctic(tmp_path)
    (tmp_path / "arctic_data/data/meta/misc.json").write_text("{}")
    clip = open_benchmark(Source("arctic", str(tmp_path))).clip(0)
    assert clip.frames is None
    assert "misc.json: expected ioi_offset of s05" in clip.without_frames


def test_pictures_are_undistorted_to_the_sequences_scaled_camera(tmp_path):
    arctic(tmp_path)
    source = Source("arctic", str(tmp_path))
    clip = open_benchmark(source).clip(0)
    assert clip.image_size_hw == (480, 672)
    assert_allclose(clip.K, np.diag([0.24, 0.24, 1]) @ K)
    assert not clip.hands
    assert clip.frames is not None
    greys = [int(image[240, 336, 0]) for image in clip.frames.images()]
    assert_allclose(greys, 10 * np.arange(T), atol=2)
    folder = tmp_path / "arctic_data/data/cropped_images/s05/box_use_01/0"
    point = np.array([0.15, -0.1, 0.5])
    lens = OpenCVLens((2000, 2800), 1500, 1510, 1390, 1010, tuple(DIST)).resized((600, 840))
    dot = np.zeros((600, 840, 3), np.uint8)
    u, v = lens.project(point)
    cv2.circle(dot, (round(float(u)), round(float(v))), 7, (255, 255, 255), -1)
    cv2.imwrite(str(folder / f"{OFFSET:05d}.jpg"), dot)
    image = next(open_benchmark(source).clip(0).frames.images())
    ys, xs = np.nonzero(image[..., 0] > 128)
    assert_allclose([xs.mean(), ys.mean()], project(point, clip.K)[0], atol=1.0)


def test_missing_files_say_where_to_get_them(tmp_path, mano_dir):
    with pytest.raises(MissingFilesError, match=r"expected raw_seqs/.*arctic\.is\.tue\.mpg\.de"):
        open_benchmark(Source("arctic", str(tmp_path)))
    arctic(tmp_path)
    data = tmp_path / "arctic_data" / "data"
    with pytest.raises(BenchmarkError, match=r"expected one of .*'val'.*got 'minival'"):
        open_benchmark(Source("arctic", str(tmp_path), split="minival"))
    picture = data / "cropped_images/s05/box_use_01/0/00008.jpg"
    picture.unlink()
    with pytest.raises(MissingFilesError, match=r"00008\.jpg: no such picture"):
        open_benchmark(Source("arctic", str(tmp_path))).clip(0)
    camera = data / "raw_seqs/s05/box_use_01.egocam.dist.npy"
    fields = np.load(camera, allow_pickle=True).item()
    np.save(camera, {**fields, "dist8": np.zeros(5)}, allow_pickle=True)
    with pytest.raises(BenchmarkError, match=r"dist8: expected shape \(8,\), got \(5,\)"):
        open_benchmark(Source("arctic", str(tmp_path))).clip(0)
    camera.write_bytes(camera.read_bytes()[:200])
    with pytest.raises(BenchmarkError, match=r"egocam\.dist\.npy"):
        open_benchmark(Source("arctic", str(tmp_path))).clip(0)
    camera.unlink()
    with pytest.raises(MissingFilesError, match="found none of 1 of them"):
        open_benchmark(Source("arctic", str(tmp_path)))


def test_left_hands_need_the_left_file(tmp_path, mano_dir):
    arctic(tmp_path, images=False)
    only_right = tmp_path / "mano"
    only_right.mkdir()
    (only_right / "MANO_RIGHT.pkl").write_bytes((mano_dir / "MANO_RIGHT.pkl").read_bytes())
    with (
        pytest.warns(UserWarning, match="mirror"),
        pytest.raises(MissingFilesError, match="expected MANO_LEFT"),
    ):
        open_benchmark(Source("arctic", str(tmp_path), mano_dir=str(only_right))).clip(0)
