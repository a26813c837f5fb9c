"""VITRA's annotations: the real one becomes a record that explains its own 21 joints."""

import os
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from mint_hub.conventions import JOINT_PARENTS, KEYPOINT_FROM_JOINT, RIGHT
from mint_hub.geometry import hand_state as hands
from mint_hub.geometry.hand_model import chain
from mint_hub.geometry.plain_pickle import load_plain_npy
from mint_hub.loaders.schema import Episode
from mint_hub.loaders.vitra import from_vitra

LIMIT_M = 0.002
TIP_PARENTS = (15, 3, 6, 12, 9)


@pytest.fixture(scope="module")
def path(real_dir: Path) -> Path:
    (path,) = (real_dir / "ego4d").glob("*.npy")
    return path


@pytest.fixture(scope="module")
def episode(path: Path) -> Episode:
    return from_vitra(path)


def wrist_and_rotations(state_109: np.ndarray):
    """Wrists (T, 3) and chained rotations (T, 16, 3, 3) of a right hand's states (T, 109)."""
    state = hands.unpack(state_109.astype(np.float64))
    rest = np.zeros((len(state_109), 16, 3))
    rotations, _ = chain(state.orientation(), state.joint_rotations("right"), rest)
    return state.translation, rotations


def with_bones(wrist: np.ndarray, rotations: np.ndarray, bones: np.ndarray) -> np.ndarray:
    """21 keypoints (T, 21, 3) of constant bones (21, 3) in the parents' frames."""
    joints = np.zeros((len(wrist), 21, 3))
    joints[:, 0] = wrist
    for j, parent in enumerate((*JOINT_PARENTS, *TIP_PARENTS)):
        if parent >= 0:
            joints[:, j] = joints[:, parent] + rotations[:, parent] @ bones[j]
    return joints[:, list(KEYPOINT_FROM_JOINT)]


def fitted_bones(rotations: np.ndarray, keypoints: np.ndarray) -> np.ndarray:
    """Constant bones (21, 3) that explain the annotated keypoints best."""
    joints = np.empty_like(keypoints)
    joints[:, list(KEYPOINT_FROM_JOINT)] = keypoints
    bones = np.zeros((21, 3))
    for j, parent in enumerate((*JOINT_PARENTS, *TIP_PARENTS)):
        if parent >= 0:
            local = (
                rotations[:, parent].swapaxes(-1, -2)
                @ (joints[:, j] - joints[:, parent])[..., None]
            )
            bones[j] = local[..., 0].mean(0)
    return bones


def test_21_joints_of_the_record_match_the_annotation_to_2_mm(path, episode):
    truth = load_plain_npy(path)["right"]
    wrist, rotations = wrist_and_rotations(episode.hand_state[:, RIGHT])
    bones = fitted_bones(rotations, truth["joints_camspace"].astype(np.float64))
    camera = with_bones(wrist, rotations, bones)
    world = with_bones(*wrist_and_rotations(episode.hand_state_world()[:, RIGHT]), bones)
    for ours, theirs in (
        (camera, truth["joints_camspace"]),
        (world, truth["joints_worldspace"]),
    ):
        miss = np.linalg.norm(ours - theirs, axis=-1)
        assert miss.max() < LIMIT_M  # every joint of every frame
    wrist_world = episode.wrist_world()[:, RIGHT, :3, 3]
    assert_allclose(wrist_world, truth["joints_worldspace"][:, 0], atol=1e-6)
    # MANO's transl instead of the wrist would miss by 0.1 m.
    apart = np.linalg.norm(wrist - truth["transl_camspace"], axis=-1)
    assert apart.min() > 0.09


def test_the_real_annotation_is_read_whole(path, episode):
    raw = load_plain_npy(path)
    assert episode.num_frames == 25
    assert_array_equal(episode.presence, np.tile([False, True], (25, 1)))
    assert_allclose(episode.hand_state[:, 0], hands.absent((25,)))
    assert_allclose(episode.T_camera_from_world, raw["extrinsics"], atol=1e-6)
    assert episode.image_size_hw == (1080, 1440)
    assert_allclose(episode.K, np.tile(raw["intrinsics"], (25, 1, 1)), atol=1e-3)
    assert_allclose(np.diff(episode.timestamps_s), 1 / 30)
    (segment,) = episode.text
    assert (segment.text, segment.side, segment.start, segment.end) == (
        "Pick up the spray bottle.",
        "right",
        0,
        25,
    )
    assert len(episode.meta["text_rephrase"]["right"][0][0]) == 5
    assert any("Pick up a brush" in w for w in episode.meta["warnings"])
    assert episode.meta["source"] == "ego4d"
    assert episode.meta["uid"] == raw["video_name"]
    assert episode.meta["shape_space"] == "mano"
    assert "not metric" in episode.meta["scale_status"]


def test_save_and_load_gives_the_record_back(episode, tmp_path):
    assert Episode.load(episode.save(tmp_path / "e.npz")).allclose(episode, atol=0)


def annotation(num_frames: int = 4) -> dict:
    """A small annotation with a left hand that leaves in the last frame."""
    rng = np.random.default_rng(0)
    T = np.tile(np.eye(4), (num_frames, 1, 1))
    T[:, :3, 3] = rng.normal(size=(num_frames, 3))
    wrist = rng.normal(size=(num_frames, 3))
    hand = {
        "beta": rng.normal(size=10),
        "global_orient_worldspace": np.tile(np.eye(3), (num_frames, 1, 1)),
        "hand_pose": np.tile(np.eye(3), (num_frames, 15, 1, 1)),
        "transl_worldspace": wrist,
        "kept_frames": np.array([1] * (num_frames - 1) + [0]),
    }
    return {
        "extrinsics": T,
        "intrinsics": np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]]),
        "video_decode_frame": np.arange(60, 60 + num_frames),
        "video_name": "clip",
        "anno_type": "left",
        "text": {"left": [("stir", (0, 9))], "right": []},
        "left": hand,
    }


def write(folder: Path, fields: object) -> Path:
    path = folder / "ssv2_Clip.1_ep_000003.npy"
    np.save(path, np.array(fields, dtype=object), allow_pickle=True)
    return path


def test_an_annotation_with_the_wrist_in_the_world_alone(tmp_path):
    fields = annotation()
    episode = from_vitra(write(tmp_path, fields))
    assert episode.key == "ssv2_clip-1_ep_000003"
    assert_array_equal(episode.presence, [[True, False]] * 3 + [[False, False]])
    expected = fields["left"]["transl_worldspace"] + fields["extrinsics"][:, :3, 3]
    assert_allclose(episode.hand_state[:3, 0, hands.TRANSLATION], expected[:3], atol=1e-6)
    assert_allclose(episode.timestamps_s, 2 + np.arange(4) / 30)
    assert episode.text[0].end == 4  # cut to the episode


BAD = {
    "extrinsics: expected this field": lambda f: f.pop("extrinsics"),
    r"extrinsics: expected shape \(T, 4, 4\), got \(4, 3, 4\)": lambda f: f.update(
        extrinsics=f["extrinsics"][:, :3]
    ),
    "extrinsics: expected finite numbers, got nan": lambda f: f["extrinsics"].__setitem__(
        (0, 0, 0), np.nan
    ),
    "left.hand_pose: expected rotations": lambda f: f["left"].update(
        hand_pose=2 * f["left"]["hand_pose"]
    ),
    r"left.kept_frames: expected shape \(4,\), got \(3,\)": lambda f: f["left"].update(
        kept_frames=np.ones(3)
    ),
    "left: expected joints_camspace.*MANO's transl": lambda f: f["left"].pop("transl_worldspace"),
    "left.transl_worldspace: expected the wrist of the joints": lambda f: f["left"].update(
        joints_camspace=np.zeros((4, 21, 3))
    ),
    r"text.left\[0\]: expected \(words, \(start, end\)\)": lambda f: f.update(
        text={"left": ["stir"]}
    ),
    "video_decode_frame: expected numbers": lambda f: f.update(video_decode_frame="none"),
}


@pytest.mark.parametrize("message", BAD)
def test_bad_annotations_are_one_clear_error_with_the_file(tmp_path, message):
    fields = annotation()
    BAD[message](fields)
    with pytest.raises(ValueError, match=rf"ssv2_Clip\.1_ep_000003\.npy: .*{message}"):
        from_vitra(write(tmp_path, fields))


def test_a_hostile_pickle_runs_nothing_and_is_refused(tmp_path):
    flag = tmp_path / "flag"

    class Hostile:
        def __reduce__(self):
            return (os.mkdir, (str(flag),))

    name = r"ssv2_Clip\.1_ep_000003\.npy: "
    with pytest.raises(ValueError, match=rf"^[^ ]*{name}[^/]*mkdir"):
        from_vitra(write(tmp_path, {**annotation(), "extra": Hostile()}))
    assert not flag.exists()
    path = write(tmp_path, annotation())
    whole = path.read_bytes()
    for part in (whole[:-400], whole[:200], whole[:60], whole[:4], b""):
        path.write_bytes(part)
        with pytest.raises(ValueError, match=rf"^[^ ]*{name}(?!.*{name})"):
            from_vitra(path)
    with pytest.raises(ValueError, match="expected a dict"):
        from_vitra(write(tmp_path, [1, 2]))
