"""HOT3D's raw ground truth: cameras and hands where the published boxes say."""

import csv
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from mint_hub.cli import main
from mint_hub.conventions import LEFT, RIGHT, SIDES
from mint_hub.geometry import hand_state as hands
from mint_hub.geometry import rigid
from mint_hub.geometry.hand_model import HandModel
from mint_hub.geometry.lenses import Lens
from mint_hub.geometry.mano_files import MANO_FILE_NAMES
from mint_hub.loaders.hot3d import (
    ARIA_STREAMS,
    HANDS_UNAVAILABLE,
    from_hot3d,
    hot3d_hands,
    hot3d_key,
)
from mint_hub.loaders.hot3d_hands import Hot3DHands
from mint_hub.loaders.index import read_episodes
from mint_hub.loaders.location import corpus_files
from mint_hub.loaders.members import META, decode, encode
from mint_hub.loaders.reader import CorpusReader
from mint_hub.loaders.schema import Episode
from tests.geometry.test_mano_files import mano_fields, write_mano

ABOUT_J0_M = np.array([0.1, 0.007, 0.007])
"""Rest wrist of a right MANO hand, to a centimetre: the annotated boxes are larger than that."""


@pytest.fixture(scope="module")
def folder(real_dir: Path) -> Path:
    return real_dir / "hot3d_gt" / "Aria_P0003_c701bd11"


@pytest.fixture(scope="module")
def episode(folder: Path) -> Episode:
    return from_hot3d(folder)


@pytest.fixture(scope="module")
def mano_dir(tmp_path_factory) -> Path:
    return write_mano(tmp_path_factory.mktemp("m") / "mano", mano_fields(0), mano_fields(1))


def test_the_sequence_is_read_whole(episode, folder):
    assert episode.key == "hot3d-aria-p0003_c701bd11-214-1" == hot3d_key(folder)
    assert episode.num_frames == 34
    assert_allclose(np.diff(episode.timestamps_s), 1 / 30, atol=1e-4)
    assert episode.fps == pytest.approx(30, abs=0.05)
    assert episode.image_size_hw == (1408, 1408)
    assert episode.meta["participant"] == "P0003"
    assert "metric" in episode.meta["scale_status"]
    assert hot3d_hands(folder).masks["mask_hand_visible"].tolist() == [True] * 34
    assert episode.meta["native_fps"] == episode.fps
    assert episode.meta["video_start_sec"] == 0
    assert episode.meta["undistorted"] is True
    assert episode.path_length_m < 0.05


@pytest.mark.filterwarnings("ignore:shape numbers")
def test_without_mano_joints_are_unavailable_and_the_raw_annotation_is_kept(episode, folder):
    assert episode.meta["quality"] == {"hands": HANDS_UNAVAILABLE}
    assert any("joints unavailable" in w and "mano_dir" in w for w in episode.meta["warnings"])
    assert not episode.presence.any()
    assert np.isnan(episode.joints_camera()).all()
    assert np.isnan(episode.wrist_world()).all()
    assert_array_equal(episode.hand_state, hands.absent((34, 2)))
    with (folder / "mano_hand_pose_trajectory.jsonl").open() as file:
        first = json.loads(next(file))["hand_poses"]
    kept = hot3d_hands(folder)
    assert kept.there.all()
    assert_allclose((kept.timestamps_ns - kept.timestamps_ns[0]) / 1e9, episode.timestamps_s)
    for hand in (LEFT, RIGHT):
        raw = first[str(hand)]
        assert kept.pca[0, hand].tolist() == raw["pose"]
        assert kept.transl[0, hand].tolist() == raw["wrist_xform"]["t_xyz"]
        w, *xyz = raw["wrist_xform"]["q_wxyz"]
        assert kept.quat_xyzw[0, hand].tolist() == [*xyz, w]
        assert kept.betas[0, hand].tolist() == raw["betas"]


def test_the_record_says_so_in_few_bytes_also_when_cut(episode, folder):
    members = encode(episode, extra=True)
    assert len(members[META]) < 2600
    back = decode(members).window(5, 9)
    assert back.meta["quality"] == {"hands": HANDS_UNAVAILABLE}
    cut = hot3d_hands(folder).window(back.meta["window_start"], back.num_frames)
    assert_allclose(cut.timestamps_ns / 1e9, back.meta["source_timestamps_s"], rtol=0, atol=1e-9)


def test_the_annotation_is_kept_in_a_file_of_its_own(folder, tmp_path):
    made = hot3d_hands(folder).window(3, 7)
    path = made.save(tmp_path / "a.npz")
    back = Hot3DHands.load(path)
    for name in ("timestamps_ns", "there", "pca", "transl", "quat_xyzw", "betas"):
        assert_array_equal(getattr(back, name), getattr(made, name))
        assert getattr(back, name).dtype == getattr(made, name).dtype
    assert back.masks.keys() == made.masks.keys() == {"mask_hand_visible", "mask_good_exposure"}
    assert back.save(tmp_path / "b.npz").read_bytes() == path.read_bytes()
    with pytest.raises(ValueError, match="0 <= start <= 7 - length"):
        made.window(3, 7)
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(ValueError, match=r"a\.npz: expected a whole npz file"):
        Hot3DHands.load(path)
    np.savez(tmp_path / "c.npz", there=made.there)
    with pytest.raises(ValueError, match=r"c\.npz: expected timestamps_ns.*got \['there'\]"):
        Hot3DHands.load(tmp_path / "c.npz")


@pytest.mark.filterwarnings("ignore:shape numbers")
def test_converted_to_shards_with_and_without_mano(episode, folder, mano_dir, tmp_path, capsys):
    def convert(config, *more):
        call = ["convert", "hot3d", str(folder), "-o", str(tmp_path), "--config", config]
        assert main([*call, "--split", "train", "--extra", "--quiet", *more]) == 0
        return CorpusReader(tmp_path, config)

    (back,) = convert("bare")
    assert back.meta == episode.meta
    assert not back.presence.any()
    table = read_episodes(tmp_path / "bare/train", ["quality"])
    assert json.loads(table["quality"][0].as_py()) == {"hands": HANDS_UNAVAILABLE}
    kept = Hot3DHands.load(tmp_path / f"hand_annotations/{episode.key}.npz")
    assert_array_equal(kept.pca, hot3d_hands(folder).pca)
    assert_array_equal(kept.transl, hot3d_hands(folder).transl)
    assert kept.uid == episode.meta["uid"] == "P0003_c701bd11"
    (whole,) = convert("whole", "--mano", str(mano_dir), "--lossless")
    assert whole.presence.all()
    expected = from_hot3d(folder, mano_dir=mano_dir)
    assert_array_equal(whole.hand_state, expected.hand_state)
    assert main(["verify", str(tmp_path), "--full"]) == 0
    assert set(corpus_files("bare", tmp_path).splits) == {"train"}
    capsys.readouterr()


def test_a_withdrawn_recording_leaves_nothing_and_is_not_kept_again(folder, tmp_path, capsys):
    other = shutil.copytree(folder, tmp_path / "P0009_00000000")
    about = json.loads((other / "metadata.json").read_text())
    named = {"recording_name": other.name, "participant_id": "P0009"}
    (other / "metadata.json").write_text(json.dumps(about | named))
    corpus = tmp_path / "corpus"
    call = ["convert", "hot3d", str(folder), str(other), "-o", str(corpus), "--split", "train"]
    call += ["--extra", "--quiet", "--config"]
    assert main([*call, "one"]) == 0
    assert main(["withdraw", str(corpus), "P0003_c701bd11", "--reason", "asked for"]) == 0
    assert "removed hand_annotations/hot3d-aria-p0003_c701bd11-214-1.npz" in capsys.readouterr().out
    assert main([*call, "two"]) == 0
    kept = sorted(path.name for path in (corpus / "hand_annotations").iterdir())
    assert kept == [f"{hot3d_key(other)}.npz"]
    assert [e.meta["participant"] for e in CorpusReader(corpus, "two")] == ["P0009"]
    assert main(["verify", str(corpus), "--full"]) == 0


def test_without_metadata_the_folder_tells_the_participant_or_nobody_does(folder, tmp_path):
    for name, person in (("P0003_c701bd11", "P0003"), ("walk", None)):
        copy = shutil.copytree(folder, tmp_path / name)
        (copy / "metadata.json").unlink()
        assert from_hot3d(copy).meta.get("participant") == person


def boxes(folder: Path, stream: str) -> list[tuple[int, int, np.ndarray]]:
    """(frame, hand, box (x0, x1, y0, y1)) of the hands that are mostly in the raw picture."""
    found = []
    with (folder / "box2d_hands.csv").open() as file:
        rows = [r for r in csv.DictReader(file) if r["stream_id"] == stream]
    frame_of = {stamp: k for k, stamp in enumerate(dict.fromkeys(r["timestamp[ns]"] for r in rows))}
    names = ("x_min[pixel]", "x_max[pixel]", "y_min[pixel]", "y_max[pixel]")
    for row in rows:
        if row["x_min[pixel]"] and float(row["visibility_ratio[%]"]) > 0.5:
            box = np.array([float(row[n]) for n in names])
            found.append((frame_of[row["timestamp[ns]"]], int(row["hand_index"]), box))
    return found


@pytest.mark.parametrize(("stream", "at_least"), [("214-1", 60), ("1201-1", 30)])
def test_hands_project_into_their_published_boxes(folder, stream, at_least):
    """Headset pose, extrinsics, lens and hand poses together, against independent numbers."""
    episode = from_hot3d(folder, stream, upright=False)
    lens = Lens.from_dict(episode.meta["lens"])
    kept = hot3d_hands(folder, stream)
    found = boxes(folder, stream)
    assert len(found) >= at_least
    for frame, hand, (x0, x1, y0, y1) in found:
        j0 = ABOUT_J0_M * ([-1, 1, 1] if hand == LEFT else 1)
        wrist = kept.transl[frame, hand] + j0
        (u, v) = lens.project(rigid.transform_points(episode.T_camera_from_world[frame], wrist))
        assert x0 - 15 < u < x1 + 15
        assert y0 - 15 < v < y1 + 15


def test_upright_is_the_same_camera_turned(folder, episode):
    raw = from_hot3d(folder, upright=False)
    assert (raw.meta["image_turn_clockwise_deg"], episode.meta["image_turn_clockwise_deg"]) == (
        0,
        90,
    )
    point = np.array([0.1, -0.2, 0.3])
    x, y, z = rigid.transform_points(raw.T_camera_from_world[5], point)
    assert_allclose(rigid.transform_points(episode.T_camera_from_world[5], point), [-y, x, z])
    # Upright, the left hand is on the left, and both hands are below the middle.
    transl = hot3d_hands(folder).transl
    camera = rigid.transform_points(episode.T_camera_from_world, transl)
    assert (camera[:, LEFT, 0] < camera[:, RIGHT, 0]).all()
    assert (camera[..., 1] > 0).all()
    slam = from_hot3d(folder, "1201-1")
    assert slam.image_size_hw == (640, 480)
    assert slam.K[0, 0, 0] == pytest.approx(241.5, abs=0.1)


@pytest.mark.parametrize("side", SIDES)
def test_with_mano_files_the_hands_equal_smplx_on_the_published_numbers(folder, mano_dir, side):
    """MANO-format files with random contents, posed by smplx itself from the 15 coefficients."""
    import smplx

    episode = from_hot3d(folder, mano_dir=mano_dir)
    assert "quality" not in episode.meta
    assert not episode.meta["warnings"]
    assert episode.presence.all()
    kept, hand = hot3d_hands(folder), SIDES.index(side)
    transl = kept.transl[:, hand]
    orient = Rotation.from_quat(kept.quat_xyzw[:, hand])
    model = smplx.MANO(
        str(mano_dir / MANO_FILE_NAMES[side]),
        is_rhand=side == "right",
        use_pca=True,
        num_pca_comps=15,
        flat_hand_mean=False,
        dtype=torch.float64,
        batch_size=34,
    )
    out = model(
        betas=torch.from_numpy(kept.betas[:, hand]),
        global_orient=torch.from_numpy(orient.as_rotvec()),
        hand_pose=torch.from_numpy(kept.pca[:, hand]),
        transl=torch.from_numpy(transl),
    )
    world = out.joints.detach().numpy()[:, :16]
    expected = rigid.transform_points(episode.T_camera_from_world, world)
    joints = HandModel.from_mano(mano_dir).joints(episode.hand_state[:, hand], side)
    assert_allclose(joints, expected, atol=1e-4)
    assert_allclose(episode.hand_state[:, hand, hands.TRANSLATION], expected[:, 0], atol=1e-6)


def test_the_right_file_alone_mirrors_the_left_basis(folder, tmp_path):
    alone = write_mano(tmp_path / "mano", mano_fields(0), None)
    with pytest.warns(UserWarning, match="MANO_LEFT"):
        episode = from_hot3d(folder, mano_dir=alone)
    pca = hot3d_hands(folder).pca
    fields = mano_fields(0)
    rotvec = fields["hands_mean"] + pca[0, LEFT] @ fields["hands_components"][:15]
    stored = hands.unpack(episode.hand_state[0, LEFT]).joint_rotations()
    expected = Rotation.from_rotvec(rotvec.reshape(15, 3)).as_matrix()
    assert_allclose(stored, expected, atol=1e-5)


def test_save_and_load_gives_the_record_back(episode, tmp_path):
    assert Episode.load(episode.save(tmp_path / "e.npz")).allclose(episode, atol=0)


@pytest.fixture
def copy(folder, tmp_path) -> Path:
    target = tmp_path / "P0003_c701bd11"
    shutil.copytree(folder, target, copy_function=shutil.copyfile)
    for path in (target, target / "masks"):
        path.chmod(0o755)
    return target


def edit(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


def test_masks_decide_on_frames_and_hands(copy, mano_dir):
    stamp = "56752141546132"
    masks = copy / "masks"
    edit(masks / "mask_headset_pose_available.csv", f"{stamp},214-1,True", f"{stamp},214-1,False")
    assert from_hot3d(copy).num_frames == 33
    stamp = "56752108188860"
    edit(masks / "mask_hand_pose_available.csv", f"{stamp},214-1,True", f"{stamp},214-1,False")
    episode = from_hot3d(copy, mano_dir=mano_dir)
    assert_array_equal(episode.presence[:3], [[False, False], [True, True], [True, True]])
    assert_array_equal(episode.hand_state[0], hands.absent((2,)))
    assert not hot3d_hands(copy).there[0].any()


def test_a_hand_that_is_not_annotated_is_absent(copy, mano_dir):
    edit(copy / "mano_hand_pose_trajectory.jsonl", '"0": {"pose"', '"9": {"pose"')
    with pytest.raises(ValueError, match=r"trajectory\.jsonl, line 1: .*hand '9'"):
        from_hot3d(copy)
    lines = (copy / "mano_hand_pose_trajectory.jsonl").read_text().splitlines()
    record = json.loads(lines[0])
    del record["hand_poses"]["9"]
    (copy / "mano_hand_pose_trajectory.jsonl").write_text(
        "\n".join([json.dumps(record), *lines[1:]])
    )
    episode = from_hot3d(copy, mano_dir=mano_dir)
    assert_array_equal(episode.presence[:2], [[False, True], [True, True]])


def test_quest_camera_models_are_read(copy):
    (copy / "online_calibration.jsonl").unlink()
    with pytest.raises(FileNotFoundError, match=r"camera_models\.json \(Quest 3\)"):
        from_hot3d(copy)
    model = {
        "T_Device_Camera": {"quaternion_wxyz": [1, 0, 0, 0], "translation_xyz": [0, 0, 0]},
        "imageHeight": 1024,
        "imageWidth": 1280,
        "stream_id": "1201-1",
        "projectionParams": [504, 504, 638, 509, *[0.0] * 12],
    }
    (copy / "camera_models.json").write_text(json.dumps([model]))
    episode = from_hot3d(copy, "1201-1")
    assert episode.image_size_hw == (1024, 1280)
    assert episode.meta["image_turn_clockwise_deg"] == 0
    assert episode.K[0, 0, 0] == pytest.approx(504, abs=1e-3)
    with pytest.raises(ValueError, match=r"camera_models\.json: expected.*'214-1'"):
        from_hot3d(copy)


BAD = {
    r"headset_trajectory\.csv, line 2: .*unit quaternion": (
        "headset_trajectory.csv",
        "0.411852458099982",
        "4.1",
    ),
    r"headset_trajectory\.csv, line 2: expected numbers": (
        "headset_trajectory.csv",
        "0.0648581547977763",
        "x",
    ),
    r"headset_trajectory\.csv, line 1: expected the column t_wo_x\[m\]": (
        "headset_trajectory.csv",
        "t_wo_x[m]",
        "x",
    ),
    r"headset_trajectory\.csv: expected a pose at 56752108188860 ns": (
        "headset_trajectory.csv",
        "56752108188860",
        "56752108188861",
    ),
    r"trajectory\.jsonl, line 1: expected JSON": (
        "mano_hand_pose_trajectory.jsonl",
        '{"timestamp_ns"',
        '{"timestamp_ns',
    ),
    r"trajectory\.jsonl, line 1: .*pose of hand 0": (
        "mano_hand_pose_trajectory.jsonl",
        "[0.06740620569773456",
        "[NaN",
    ),
    r"available\.csv, line 2: expected nanoseconds and True or False, got": (
        "masks/mask_headset_pose_available.csv",
        "True",
        "yes",
    ),
    r"online_calibration\.jsonl, line 1: expected one calibration of 'camera-rgb'": (
        "online_calibration.jsonl",
        '"Label": "camera-rgb"',
        '"Label": "camera"',
    ),
}


@pytest.mark.parametrize("message", BAD)
def test_bad_files_are_named_with_their_line(copy, message):
    name, old, new = BAD[message]
    edit(copy / name, old, new)
    with pytest.raises(ValueError, match=message):
        from_hot3d(copy)


def test_missing_files_and_unknown_streams_are_named(copy, tmp_path):
    with pytest.raises(FileNotFoundError, match=r"HOT3D sequence with headset_trajectory\.csv"):
        from_hot3d(tmp_path)
    with pytest.raises(ValueError, match="expected one of 1201-1, 1201-2, 214-1, got '214-2'"):
        from_hot3d(copy, "214-2")
    with pytest.raises(FileNotFoundError, match=r"MANO_RIGHT\.pkl"):
        from_hot3d(copy, mano_dir=tmp_path)
    assert set(ARIA_STREAMS) == {"214-1", "1201-1", "1201-2"}
    shutil.rmtree(copy / "masks")
    with pytest.raises(FileNotFoundError, match=r"mask_headset_pose_available\.csv"):
        from_hot3d(copy)
