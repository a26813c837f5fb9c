"""The user's MANO files: read without running anything, compared with smplx, converted once."""

import os
import pickle
import sys
import types
import warnings
from pathlib import Path

import numpy as np
import pytest
import scipy.sparse
import torch
from numpy.testing import assert_allclose, assert_array_equal

from mint_hub.conventions import JOINT_PARENTS, MANO_FINGERTIP_VERTICES, SIDES
from mint_hub.geometry.hand_model import HandModel
from mint_hub.geometry.hand_state import HandState, mirror_rotations
from mint_hub.geometry.mano_files import MANO_FILE_NAMES, find_mano_files, read_mano_file
from mint_hub.geometry.plain_pickle import (
    Opaque,
    UnreadablePickleError,
    load_plain_npy,
    load_plain_pickle,
)
from mint_hub.geometry.rotations import rotvec_to_matrix

V = 778
RING, ROWS = 16, 48


def open_tube() -> np.ndarray:
    """Outward faces of a tube closed at one end: one open loop of 16, as at MANO's wrist."""
    faces = []
    for row in range(ROWS - 1):
        for i in range(RING):
            a, b = row * RING + i, row * RING + (i + 1) % RING
            faces += [(a, b, b + RING), (a, b + RING, a + RING)]
    last = (ROWS - 1) * RING
    return np.array(faces + [(last, last + i, last + i + 1) for i in range(1, RING - 1)])


def mano_fields(seed: int) -> dict:
    """Random contents in MANO's format (778 vertices, sparse regressor, no chumpy)."""
    rng = np.random.default_rng(seed)
    weights = rng.random((V, 16)) ** 4
    regressor = scipy.sparse.random(16, V, density=0.05, random_state=seed, format="csc")
    regressor = scipy.sparse.csc_matrix(regressor / regressor.sum(axis=1))
    return {
        "v_template": rng.normal(0, 0.05, (V, 3)),
        "shapedirs": rng.normal(0, 0.01, (V, 3, 10)),
        "posedirs": rng.normal(0, 0.005, (V, 3, 135)),
        "J_regressor": regressor,
        "weights": weights / weights.sum(1, keepdims=True),
        "f": open_tube().astype(np.uint32),
        "kintree_table": np.array([[2**32 - 1, *JOINT_PARENTS[1:]], range(16)], dtype=np.int64),
        "hands_components": rng.normal(size=(45, 45)),
        "hands_mean": rng.normal(size=45),
        "bs_style": "lbs",
        "bs_type": "lrotmin",
    }


def write_mano(folder: Path, right: dict, left: dict | None) -> Path:
    folder.mkdir(exist_ok=True)
    (folder / "MANO_RIGHT.pkl").write_bytes(pickle.dumps(right, protocol=2))
    if left is not None:
        (folder / "MANO_LEFT.pkl").write_bytes(pickle.dumps(left, protocol=2))
    return folder


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_mano(tmp_path / "mano", mano_fields(0), mano_fields(1))


def smplx_hand(folder: Path, side: str, **inputs: np.ndarray):
    """Vertices, joints and wrist rest J0 from smplx, the true rotations of this side going in."""
    import smplx

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        hand = smplx.MANO(
            str(folder / MANO_FILE_NAMES[side]),
            is_rhand=side == "right",
            use_pca=False,
            flat_hand_mean=True,
            dtype=torch.float64,
            batch_size=len(inputs["betas"]),
        )
    tensors = {k: torch.from_numpy(v) for k, v in inputs.items()}
    rest = hand(
        betas=tensors["betas"],
        global_orient=torch.zeros(len(inputs["betas"]), 3, dtype=torch.float64),
        hand_pose=torch.zeros(len(inputs["betas"]), 45, dtype=torch.float64),
    )
    out = hand(**tensors)
    return out.vertices.detach().numpy(), out.joints.detach().numpy(), rest.joints[:, 0].detach()


@pytest.mark.parametrize("side", SIDES)
def test_skinning_equals_smplx(folder, side):
    rng = np.random.default_rng(7)
    n = 5
    orient, pose = rng.normal(size=(n, 3)), rng.normal(0, 0.7, (n, 15, 3))
    betas, transl = rng.normal(size=(n, 10)), rng.normal(size=(n, 3))
    vertices, joints, rest_wrist = smplx_hand(
        folder,
        side,
        betas=betas,
        global_orient=orient,
        hand_pose=pose.reshape(n, 45),
        transl=transl,
    )
    true = rotvec_to_matrix(pose)
    stored = mirror_rotations(true) if side == "left" else true
    wrist = transl + rest_wrist.numpy()
    state = HandState.from_matrices(wrist, rotvec_to_matrix(orient), stored, betas).pack()
    model = HandModel.from_mano(folder)
    assert_allclose(model.vertices(state, side), vertices, atol=1e-5)
    assert_allclose(model.joints(state, side), joints[:, :16], atol=1e-5)
    assert_allclose(model.joints(state, side)[:, 0], wrist, atol=1e-12)
    assert_allclose(model.rest_joints(betas, side)[:, 0], rest_wrist, atol=1e-7)
    both = np.stack([state, state], axis=1)
    tips = model.keypoints(both)[:, SIDES.index(side), [4, 8, 12, 16, 20]]
    assert_allclose(tips, vertices[:, list(MANO_FINGERTIP_VERTICES)], atol=1e-5)


def test_left_shape_directions_are_flipped_only_when_they_are_the_right_hands(tmp_path):
    right, left = mano_fields(0), mano_fields(1)
    sound = HandModel.from_mano(write_mano(tmp_path / "sound", right, left))
    assert_allclose(sound.left.shape_directions, left["shapedirs"])
    defect = {**left, "shapedirs": right["shapedirs"]}
    repaired = HandModel.from_mano(write_mano(tmp_path / "defect", right, defect))
    flipped = right["shapedirs"] * np.array([-1.0, 1.0, 1.0])[:, None]
    assert_allclose(repaired.left.shape_directions, flipped)
    assert_allclose(repaired.right.shape_directions, right["shapedirs"])


def test_wrist_is_closed_by_fourteen_faces_and_left_faces_are_turned(folder):
    model = HandModel.from_mano(folder)
    for side in SIDES:
        faces = model.faces(side)
        assert len(faces) == len(open_tube()) + 14
        edges = {(a, b) for f in faces for a, b in zip(f, np.roll(f, -1), strict=True)}
        assert len(edges) == 3 * len(faces)
        assert all((b, a) in edges for a, b in edges)
    n = len(open_tube())
    assert_array_equal(model.faces("left")[:n], model.faces("right")[:n][:, [0, 2, 1]])


def test_right_file_alone_gives_a_mirrored_left_hand_and_says_so(tmp_path):
    folder = write_mano(tmp_path / "mano", mano_fields(0), None)
    with pytest.warns(UserWarning, match=r"MANO_LEFT.*mirror"):
        model = HandModel.from_mano(folder)
    assert "mirrored" in model.name
    rng = np.random.default_rng(3)
    state = HandState.from_matrices(
        np.zeros(3), np.eye(3), rotvec_to_matrix(rng.normal(size=(15, 3))), rng.normal(size=10)
    ).pack()
    mirrored = model.vertices(state, "right") * [-1, 1, 1]
    assert_allclose(model.vertices(state, "left"), mirrored, atol=1e-12)


def test_missing_files_say_what_and_where(tmp_path, monkeypatch):
    with pytest.raises(FileNotFoundError, match=r"MANO_RIGHT\.pkl.*mano\.is\.tue\.mpg\.de"):
        HandModel.default(tmp_path)
    write_mano(tmp_path, mano_fields(0), mano_fields(1))
    (tmp_path / "MANO_RIGHT.pkl").unlink()
    with pytest.raises(FileNotFoundError, match=r"found MANO_LEFT\.pkl"):
        HandModel.default(tmp_path)
    monkeypatch.delenv("MINT_HUB_MANO_DIR", raising=False)
    assert HandModel.default().shape_space == "mint"


def test_environment_variable_and_usual_subfolders_are_found(folder, tmp_path, monkeypatch):
    usual = tmp_path / "unpacked" / "mano_v1_2" / "models"
    usual.parent.mkdir(parents=True)
    folder.rename(usual)
    assert set(find_mano_files(tmp_path / "unpacked")) == {"left", "right"}
    monkeypatch.setenv("MINT_HUB_MANO_DIR", str(tmp_path / "unpacked"))
    assert HandModel.default().shape_space == "mano"


def test_conversion_is_kept_and_then_used_instead_of_the_pickle(folder, tmp_path, monkeypatch):
    first = read_mano_file(folder / "MANO_RIGHT.pkl", tmp_path / "cache")
    (kept,) = (tmp_path / "cache").iterdir()
    assert kept.suffix == ".safetensors"
    monkeypatch.setattr("mint_hub.geometry.mano_files.load_plain_pickle", None)
    again = read_mano_file(folder / "MANO_RIGHT.pkl", tmp_path / "cache")
    for name, array in first.items():
        assert_array_equal(again[name], array)


def test_hostile_pickles_run_nothing_and_are_refused(tmp_path):
    flag = tmp_path / "flag"

    class Hostile:
        def __reduce__(self):
            return (os.mkdir, (str(flag),))

    folder = write_mano(tmp_path / "mano", {**mano_fields(0), "extra": Hostile()}, None)
    with pytest.raises(ValueError, match=r"MANO_RIGHT.*refused.*mkdir.*Nothing was run"):
        HandModel.from_mano(folder)
    assert not flag.exists()
    for name in (b"builtins\neval", b"numpy\nload", b"os\nsystem", b"numpy.lib.npyio\nNpzFile"):
        with pytest.raises(UnreadablePickleError, match="asks for"):
            load_plain_pickle(b"c" + name + b"\n(V1+1\ntR.")
    with pytest.raises(UnreadablePickleError):
        load_plain_pickle(b"cchumpy.ch\nCh\n(V1\ntR(dVx\ncbuiltins\nexec\nsb.")


def test_damaged_and_unbelievable_pickles_are_refused():
    good = pickle.dumps({"a": np.arange(5)})
    for bad in (b"", good[:-20], b"\x80\x02garbage"):
        with pytest.raises(UnreadablePickleError):
            load_plain_pickle(bad)
    holds_itself: list = []
    holds_itself.append(holds_itself)
    with pytest.raises(UnreadablePickleError, match="within itself"):
        load_plain_pickle(pickle.dumps(holds_itself))
    outside = scipy.sparse.csc_matrix(np.eye(3))
    outside.indices[:] = 99
    with pytest.raises(UnreadablePickleError, match="outside"):
        load_plain_pickle(pickle.dumps(outside))


@pytest.mark.parametrize("protocol", range(6))
def test_plain_data_comes_back(protocol):
    rng = np.random.default_rng(0)
    dense = rng.normal(size=(4, 6)) * (rng.random((4, 6)) < 0.4)
    data = {
        "f": np.asfortranarray(rng.normal(size=(3, 4)).astype(np.float32)),
        "i": np.arange(6, dtype=">i4").reshape(2, 3),
        "b": np.array([True, False]),
        "s": np.array(["a", "bc"]),
        "o": np.array([{"x": 1}, None, [2]], dtype=object),
        "empty": np.zeros((0, 3)),
        "scalar": np.float64(2.5),
        "list": [1, 2.5, "text", b"bytes", bytearray(b"\xff"), 2j, None, (1, {2}, b"")],
        "csc": scipy.sparse.csc_matrix(dense),
        "csr": scipy.sparse.csr_matrix(dense),
    }
    back = load_plain_pickle(pickle.dumps(data, protocol=protocol))
    for name in ("f", "i", "b", "s", "empty"):
        assert_array_equal(back[name], data[name])
        assert back[name].shape == data[name].shape
    assert back["o"].tolist() == data["o"].tolist()
    assert back["scalar"] == 2.5
    assert back["list"] == data["list"]
    assert_allclose(back["csc"], dense)
    assert_allclose(back["csr"], dense)


@pytest.mark.parametrize("protocol", [0, 2, 4])
def test_chumpy_objects_are_read_as_arrays(tmp_path, protocol, monkeypatch):
    class Ch:
        def __init__(self, x):
            self.x = x

    class Select:
        def __init__(self, a, idxs, preferred_shape):
            self.a, self.idxs, self.preferred_shape = a, idxs, preferred_shape

    class Expression:
        pass

    for module, cls in (
        ("chumpy.ch", Ch),
        ("chumpy.reordering", Select),
        ("chumpy.ops", Expression),
    ):
        cls.__module__, cls.__qualname__ = module, cls.__name__
        stand_in = types.ModuleType(module)
        setattr(stand_in, cls.__name__, cls)
        monkeypatch.setitem(sys.modules, module, stand_in)
    monkeypatch.setitem(sys.modules, "chumpy", types.ModuleType("chumpy"))
    fields = mano_fields(0)
    wide = np.random.default_rng(1).normal(size=(V, 3, 12))
    picks = np.arange(wide.size).reshape(wide.shape)[..., :10].ravel()
    data = {
        **fields,
        "v_template": Ch(fields["v_template"]),
        "shapedirs": Select(Ch(wide), picks, (V, 3, 10)),
        "J": Expression(),
    }
    path = tmp_path / "MANO_RIGHT.pkl"
    path.write_bytes(pickle.dumps(data, protocol=protocol))
    for module in ("chumpy.ch", "chumpy.reordering", "chumpy.ops"):
        monkeypatch.delitem(sys.modules, module)
    assert isinstance(load_plain_pickle(path)["J"], Opaque)
    tensors = read_mano_file(path)
    assert_array_equal(tensors["v_template"], fields["v_template"])
    assert_array_equal(tensors["shapedirs"], wide[..., :10])


def test_files_that_are_no_mano_hand_name_the_field(tmp_path):
    path = tmp_path / "MANO_RIGHT.pkl"
    cases = {
        "weights missing": {k: v for k, v in mano_fields(0).items() if k != "weights"},
        "posedirs: expected": {**mano_fields(0), "posedirs": np.zeros((V, 3, 207))},
        "kintree_table": {**mano_fields(0), "kintree_table": np.zeros((2, 16), dtype=np.int64)},
        "dict": [1, 2],
    }
    for message, content in cases.items():
        path.write_bytes(pickle.dumps(content))
        with pytest.raises(ValueError, match=message):
            read_mano_file(path)


def test_npy_files_read_as_numpy_reads_them(tmp_path):
    annotation = {"a": np.arange(3), "text": [("pick up", (0, np.int64(5)))]}
    np.save(tmp_path / "dict.npy", annotation, allow_pickle=True)
    back = load_plain_npy(tmp_path / "dict.npy")
    assert_array_equal(back["a"], annotation["a"])
    assert back["text"] == annotation["text"]
    np.save(tmp_path / "plain.npy", np.eye(2))
    assert_array_equal(load_plain_npy(tmp_path / "plain.npy"), np.eye(2))
    (tmp_path / "no.npy").write_bytes(b"nothing")
    with pytest.raises(UnreadablePickleError, match=r"no\.npy"):
        load_plain_npy(tmp_path / "no.npy")
