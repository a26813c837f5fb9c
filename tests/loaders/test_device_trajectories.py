"""Device trajectories: files read with their lines, cameras taken to a video's times."""

import json
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from mint_hub.geometry import rigid
from mint_hub.geometry.rotations import geodesic_angle
from mint_hub.loaders import device_trajectories as device
from mint_hub.loaders.device_trajectories import DeviceTrajectory, camera_at
from tests.episodes import make_episode


def path_of(rng: np.random.Generator, count: int = 40, rate: float = 50.0) -> DeviceTrajectory:
    """A smooth path from random motions, world-to-camera."""
    times = 100 + np.arange(count) / rate
    twist = np.cumsum(rng.normal(0, 0.02, (count, 6)), axis=0)
    return DeviceTrajectory(times, rigid.inverse(rigid.se3_exp(twist)))


def assert_same_poses(a: np.ndarray, b: np.ndarray, atol: float = 1e-9) -> None:
    assert geodesic_angle(a[..., :3, :3], b[..., :3, :3]).max() < max(atol, 1e-7)
    assert_allclose(a[..., :3, 3], b[..., :3, 3], atol=atol)


def tum_text(trajectory: DeviceTrajectory) -> str:
    T = rigid.inverse(trajectory.T_camera_from_world)
    rows = np.concatenate(
        [
            trajectory.timestamps_s[:, None],
            T[:, :3, 3],
            Rotation.from_matrix(T[:, :3, :3]).as_quat(),
        ],
        axis=1,
    )
    return "# time tx ty tz qx qy qz qw\n\n" + "\n".join(
        " ".join(map(repr, r.tolist())) for r in rows
    )


@settings(deadline=None, max_examples=20)
@given(st.integers(0, 2**32 - 1))
def test_a_trajectory_at_its_own_times_is_itself(seed):
    trajectory = path_of(np.random.default_rng(seed))
    assert_same_poses(camera_at(trajectory, trajectory.timestamps_s), trajectory[1])
    moved = camera_at(trajectory, trajectory.timestamps_s - 97.5, time_offset_s=97.5)
    assert_same_poses(moved, trajectory[1], atol=1e-6)


def test_between_poses_the_camera_moves_straight_and_turns_evenly():
    turn = Rotation.from_rotvec(np.linspace(0, 1.0, 11)[:, None] * [0.0, 0.6, 0.8]).as_matrix()
    place = np.linspace(0, 1, 11)[:, None] * [1.0, -2.0, 3.0]
    T_world_from_camera = rigid.rigid(turn, place)
    trajectory = DeviceTrajectory(np.linspace(5, 6, 11), rigid.inverse(T_world_from_camera))
    at = np.linspace(0, 1, 31)
    poses = rigid.inverse(camera_at(trajectory, at, time_offset_s=5))
    assert_allclose(poses[:, :3, 3], at[:, None] * [1.0, -2.0, 3.0], atol=1e-12)
    expected = Rotation.from_rotvec(at[:, None] * [0.0, 0.6, 0.8]).as_matrix()
    assert_allclose(poses[:, :3, :3], expected, atol=1e-9)


def test_times_outside_and_gaps_raise_with_the_times():
    trajectory = path_of(np.random.default_rng(0))
    with pytest.raises(ValueError, match=r"cover the video, 99\.0.*got 100\.000 to 100\.780 s"):
        camera_at(trajectory, [0.0, 0.5], time_offset_s=99)
    assert_same_poses(camera_at(trajectory, [99.985]), trajectory[1][:1])  # within one step
    holed = DeviceTrajectory(*(np.delete(a, slice(5, 35), axis=0) for a in trajectory))
    with pytest.raises(ValueError, match=r"0\.5 s apart, got none between 100\.080 and 100\.700 s"):
        camera_at(holed, [100.05, 100.4])
    camera_at(holed, [100.08, 100.7])  # the ends of the gap are known
    camera_at(holed, [100.05, 100.4], max_gap_s=0.7)
    single = DeviceTrajectory(*(a[:1] for a in trajectory))
    assert_same_poses(camera_at(single, [100.0]), trajectory[1][:1])
    with pytest.raises(ValueError, match="video_times_s: expected finite"):
        camera_at(trajectory, [float("nan")])


def test_interpolate_path_is_the_same_in_torch_and_holds_its_ends():
    times, poses = path_of(np.random.default_rng(1))
    at = np.array([0.0, 100.0, 100.013, 100.5, 999.0])
    ours = rigid.interpolate_path(times, poses, at)
    theirs = rigid.interpolate_path(*(torch.from_numpy(x) for x in (times, poses, at)))
    assert_allclose(ours, theirs.numpy(), atol=1e-12)
    assert_same_poses(ours[[0, 1, -1]], poses[[0, 0, -1]])
    with pytest.raises(ValueError, match="times_s: expected increasing"):
        rigid.interpolate_path(times[::-1].copy(), poses, at)
    with pytest.raises(ValueError, match=r"expected \(M,\), \(M, 4, 4\), \(N,\)"):
        rigid.interpolate_path(times[1:], poses, at)


def test_tum_comes_back_and_the_mount_is_applied(tmp_path):
    trajectory = path_of(np.random.default_rng(2))
    path = tmp_path / "a.txt"
    path.write_text(tum_text(trajectory))
    back = device.read_tum(path)
    assert_array_equal(back.timestamps_s, trajectory.timestamps_s)
    assert_same_poses(back.T_camera_from_world, trajectory.T_camera_from_world)
    mount = rigid.se3_exp(np.array([0.1, 0.2, -0.3, 0.5, -0.2, 1.0]))
    turned = device.read_tum(path, T_device_from_camera=mount)
    assert_same_poses(turned[1], rigid.inverse(mount) @ trajectory[1])


def test_real_tum_files_are_read(real_dir: Path):
    for name in ("fr2_desk_ORB.txt", "fr2_desk_groundtruth.txt"):
        path = real_dir / "tum" / name
        raw = np.loadtxt(path)
        raw = raw[np.concatenate([[True], np.diff(raw[:, 0]) > 0])]
        trajectory = device.read_tum(path)
        assert_array_equal(trajectory.timestamps_s, raw[:, 0])
        T_world_from_camera = rigid.inverse(trajectory.T_camera_from_world)
        assert_allclose(T_world_from_camera[:, :3, 3], raw[:, 1:4], atol=1e-9)
        expected = Rotation.from_quat(raw[:, 4:]).as_matrix()
        assert_allclose(T_world_from_camera[:, :3, :3], expected, atol=1e-9)
    # The real ground truth stops for 12 s: that is said, not bridged.
    video = np.arange(trajectory.timestamps_s[0], trajectory.timestamps_s[-1], 1 / 30)
    with pytest.raises(ValueError, match=r"poses at most 0\.5 s apart"):
        camera_at(trajectory, video)


BAD_TUM = {
    "line 3: expected 8 numbers": "# c\n0 0 0 0 0 0 0 1\n1 0 0 0 0 0 1\n",
    "line 2: expected 8 numbers.*got '1 0 0 zero": "0 0 0 0 0 0 0 1\n1 0 0 zero 0 0 0 1\n",
    r"line 2: expected a time after 5\.000000, got 4": "5 0 0 0 0 0 0 1\n4 0 0 0 0 0 0 1\n",
    "line 2: expected finite numbers and a unit quaternion": "1 0 0 0 0 0 0 1\n2 0 0 0 0 0 0 0\n",
    "line 1: expected finite numbers": "1 nan 0 0 0 0 0 1\n",
    "line 1: expected a time after|line 2: expected a time": "1 0 0 0 0 0 0 1\nnan 0 0 0 0 0 0 1\n",
    "expected at least one pose, got none": "# nothing\n",
}


@pytest.mark.parametrize("message", BAD_TUM)
def test_bad_tum_lines_are_named(tmp_path, message):
    path = tmp_path / "bad.txt"
    path.write_text(BAD_TUM[message])
    with pytest.raises(ValueError, match=rf"bad\.txt.*({message})"):
        device.read_tum(path)


def test_of_equal_times_the_first_is_kept(tmp_path):
    path = tmp_path / "twice.txt"
    path.write_text("1 7 0 0 0 0 0 1\n1 8 0 0 0 0 0 1\n2 9 0 0 0 0 0 1\n")
    trajectory = device.read_tum(path)
    assert_allclose(rigid.inverse(trajectory.T_camera_from_world)[:, 0, 3], [7, 9])


def mps_csv(path: Path, trajectory: DeviceTrajectory, frame: str, uids: list[str]) -> Path:
    uid, suffix = ("graph_uid", "world") if frame == "world" else ("session_uid", "odometry")
    names = ",".join(f"{q}_{suffix}_device" for q in ("tx", "ty", "tz", "qx", "qy", "qz", "qw"))
    T = rigid.inverse(trajectory.T_camera_from_world)
    quats = Rotation.from_matrix(T[:, :3, :3]).as_quat()
    lines = [f"{uid},tracking_timestamp_us,utc_timestamp_ns,{names},quality_score"]
    for k, (t, pose, quat) in enumerate(zip(trajectory[0], T, quats, strict=True)):
        numbers = ",".join(map(repr, [*pose[:3, 3].tolist(), *quat.tolist()]))
        lines.append(f"{uids[k % len(uids)]},{round(t * 1e6)},-1,{numbers},1.0")
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.parametrize("frame", ["world", "odometry"])
def test_aria_mps_trajectories_come_back(tmp_path, frame):
    trajectory = path_of(np.random.default_rng(3))
    path = mps_csv(tmp_path / "loop.csv", trajectory, frame, ["one"])
    back = device.read_aria_mps_csv(path)
    assert_allclose(back.timestamps_s, trajectory.timestamps_s, atol=1e-9)
    assert_same_poses(back.T_camera_from_world, trajectory.T_camera_from_world)


def test_bad_mps_files_are_named(tmp_path):
    trajectory = path_of(np.random.default_rng(3))
    path = mps_csv(tmp_path / "loop.csv", trajectory, "world", ["one", "two"])
    with pytest.raises(ValueError, match=r"loop\.csv, line 3: expected poses in one world \(one\)"):
        device.read_aria_mps_csv(path)
    path.write_text("a,b\n1,2\n")
    with pytest.raises(ValueError, match="line 1: expected the column tracking_timestamp_us"):
        device.read_aria_mps_csv(path)
    path = mps_csv(path, trajectory, "world", ["one"])
    cut = path.read_text()
    path.write_text(cut[: cut.rindex(",0")])
    with pytest.raises(ValueError, match=r"line 41: expected"):
        device.read_aria_mps_csv(path)
    path.write_text("")
    with pytest.raises(ValueError, match="line 1: expected the column"):
        device.read_aria_mps_csv(path)


def test_real_aria_calibration(real_dir: Path):
    (path,) = (real_dir / "hot3d_gt").glob("*/online_calibration.jsonl")
    calibration = device.read_aria_calibration(path)
    first = json.loads(path.read_text().splitlines()[0])["CameraCalibrations"][2]
    w, xyz = first["T_Device_Camera"]["UnitQuaternion"]
    T = calibration.T_device_from_camera
    assert_allclose(T[:3, 3], first["T_Device_Camera"]["Translation"], atol=2e-5)
    assert_allclose(T[:3, :3], Rotation.from_quat([*xyz, w]).as_matrix(), atol=2e-4)
    assert_allclose(calibration.params, first["Projection"]["Params"])
    assert calibration.largest_change[1] < 1e-4
    with pytest.raises(ValueError, match="line 1: expected one calibration of 'camera-x'"):
        device.read_aria_calibration(path, "camera-x")


class FakeFile(dict):
    """As much of ``h5py.File`` as is used."""

    contents: dict[str, np.ndarray]

    def __init__(self, path, mode):
        assert mode == "r"
        if path.read_bytes() != b"hdf5":
            raise OSError("file signature not found")
        super().__init__({k: {(): v} for k, v in self.contents.items()})

    def __enter__(self):
        return self

    def __exit__(self, *_):
        return None


def test_egodex_through_a_stand_in_for_h5py(tmp_path, monkeypatch):
    trajectory = path_of(np.random.default_rng(4))
    FakeFile.contents = {
        "transforms/camera": rigid.inverse(trajectory.T_camera_from_world),
        "camera/intrinsic": np.array([[736.6, 0, 960], [0, 736.6, 540], [0, 0, 1]]),
    }
    monkeypatch.setitem(sys.modules, "h5py", SimpleNamespace(File=FakeFile))
    path = tmp_path / "0.hdf5"
    path.write_bytes(b"hdf5")
    back = device.read_egodex_hdf5(path)
    assert_allclose(back.timestamps_s, np.arange(40) / 30)
    assert_same_poses(back.T_camera_from_world, trajectory.T_camera_from_world)
    assert device.read_egodex_intrinsics(path)[0, 2] == 960
    FakeFile.contents["transforms/camera"] = np.ones((3, 4, 4))
    with pytest.raises(ValueError, match=r"0\.hdf5: transforms/camera: expected rigid.*frame 0"):
        device.read_egodex_hdf5(path)
    FakeFile.contents["transforms/camera"] = np.ones((3, 4))
    with pytest.raises(ValueError, match=r"transforms/camera: expected \(T, 4, 4\), got \(3, 4\)"):
        device.read_egodex_hdf5(path)
    del FakeFile.contents["transforms/camera"]
    with pytest.raises(ValueError, match="transforms/camera: expected this data set, got"):
        device.read_egodex_hdf5(path)
    path.write_bytes(b"text")
    with pytest.raises(ValueError, match=r"0\.hdf5: expected an HDF5 file"):
        device.read_egodex_hdf5(path)
    with pytest.raises(FileNotFoundError):
        device.read_egodex_hdf5(tmp_path / "1.hdf5")
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(ImportError, match="pip install h5py"):
        device.read_egodex_hdf5(path)


def test_egodex_with_h5py_itself(tmp_path):
    h5py = pytest.importorskip(
        "h5py", reason="h5py comes with the extra test: only EgoDex files need it"
    )
    trajectory = path_of(np.random.default_rng(4))
    path = tmp_path / "0.hdf5"
    with h5py.File(path, "w") as file:
        poses = rigid.inverse(trajectory.T_camera_from_world).astype("f4")
        file.create_dataset("transforms/camera", data=poses, chunks=(8, 4, 4), compression="gzip")
        file["transforms/leftHand"] = np.tile(np.eye(4, dtype="f4"), (40, 1, 1))
        file["camera/intrinsic"] = np.eye(3, dtype="f4")
        file.attrs["llm_description"] = "fold a towel"
    whole = path.read_bytes()
    back = device.read_egodex_hdf5(path, fps=60)
    assert_allclose(back.timestamps_s, np.arange(40) / 60)
    assert_same_poses(back.T_camera_from_world, trajectory.T_camera_from_world, atol=1e-5)
    assert_array_equal(device.read_egodex_intrinsics(path), np.eye(3))
    for part in (b"no HDF5 at all", whole[: len(whole) // 2], b""):
        path.write_bytes(part)
        with pytest.raises(ValueError, match=r"0\.hdf5: expected an HDF5 file"):
            device.read_egodex_hdf5(path)


def test_an_episode_of_a_device_camera_has_no_hands():
    trajectory = path_of(np.random.default_rng(5))
    K = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
    episode = device.episode_from_trajectory(
        "walk", trajectory, np.arange(20) / 30, K, (480, 640), time_offset_s=100.05
    )
    assert not episode.presence.any()
    assert_allclose(episode.K, np.tile(K, (20, 1, 1)), atol=1e-3)
    assert episode.meta["provenance"]["camera"]["time_offset_s"] == 100.05
    assert "metric" in episode.meta["scale_status"]
    expected = camera_at(trajectory, np.arange(20) / 30 + 100.05)
    assert_allclose(episode.T_camera_from_world, expected)


def test_a_device_camera_carries_the_hands_into_its_world():
    predicted = make_episode(60, seed=6)
    trajectory = path_of(np.random.default_rng(6), 120)
    episode = device.with_device_camera(predicted, trajectory, time_offset_s=100.1)
    assert_array_equal(episode.hand_state, predicted.hand_state)
    expected = camera_at(trajectory, predicted.timestamps_s, time_offset_s=100.1)
    assert_allclose(episode.T_camera_from_world, expected)
    wrists = rigid.inverse(expected)[:, None] @ predicted.wrist_camera()
    assert_allclose(episode.wrist_world(), wrists, atol=1e-9)
    assert episode.meta["provenance"]["generator"] == "tests.episodes"
    assert episode.meta["scale_status"].endswith("hands: synthetic, metric")
    assert "camera" not in predicted.meta["provenance"]
