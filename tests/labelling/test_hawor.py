"""HaWoR's MANO parameters become hand states: the wrist is transl plus J0, sides as stored."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from mint_hub.geometry.hand_model import HandModel
from mint_hub.geometry.hand_state import HandState, absent, unpack
from mint_hub.geometry.rotations import rotvec_to_matrix
from mint_hub.labelling.stage import NotReadyError, StageError
from mint_hub.labelling.stages.hawor import HaworHands, HaworSettings, read_hands
from tests import video_files as make
from tests.geometry.test_mano_files import mano_fields, write_mano
from tests.labelling.research_projects import (
    HAWOR_DETECT,
    HAWOR_MOTION,
    clip_of,
    video_of,
    write_files,
)

SIDES = ("left", "right")


@pytest.fixture(scope="module")
def mano(tmp_path_factory) -> Path:
    return write_mano(tmp_path_factory.mktemp("m") / "mano", mano_fields(0), mano_fields(1))


def true_hand(side: str, count: int, seed: int) -> dict[str, np.ndarray]:
    """A hand as MANO has it: rotations of that hand itself, the wrist where it really is."""
    rng = np.random.default_rng(seed)
    return {
        "orientation": rotvec_to_matrix(rng.normal(size=(count, 3))),
        "joints": rotvec_to_matrix(rng.normal(0, 0.4, (count, 15, 3))),
        "wrist": rng.normal((0, 0, 0.5), 0.1, (count, 3)),
        "betas": rng.normal(size=(count, 10)),
    }


def write_stretch(folder: Path, side: str, first: int, hand: dict, model: HandModel) -> None:
    """Write what HaWoR writes of a stretch of frames."""
    rest = np.asarray(model.rest_joints(hand["betas"], side))[:, 0]
    stored = {
        "init_root_orient": hand["orientation"][None],
        "init_hand_pose": hand["joints"][None],
        "init_trans": (hand["wrist"] - rest)[None],
        "init_betas": hand["betas"][None],
    }
    path = folder / str(SIDES.index(side)) / f"{first}_{first + len(hand['wrist']) - 1}.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({k: v.tolist() for k, v in stored.items()}))


def check_hand(state: np.ndarray, side: str, hand: dict) -> None:
    got = unpack(state.astype(np.float64))
    np.testing.assert_allclose(got.translation, hand["wrist"], atol=1e-6)
    np.testing.assert_allclose(got.shape_params, hand["betas"], atol=1e-6)
    np.testing.assert_allclose(got.orientation(), hand["orientation"], atol=1e-6)
    np.testing.assert_allclose(got.joint_rotations(side), hand["joints"], atol=1e-6)


def test_stretches_of_both_hands(mano, tmp_path):
    model = HandModel.from_mano(mano)
    left, right, later = (
        true_hand("left", 4, 1),
        true_hand("right", 3, 2),
        true_hand("right", 12, 3),
    )
    write_stretch(tmp_path, "left", 2, left, model)
    write_stretch(tmp_path, "right", 0, right, model)
    write_stretch(tmp_path, "right", 5, later, model)
    hands = read_hands(tmp_path, 20, model)
    assert np.flatnonzero(hands.presence[:, 0]).tolist() == [2, 3, 4, 5]
    assert np.flatnonzero(hands.presence[:, 1]).tolist() == [0, 1, 2, *range(5, 17)]
    check_hand(hands.hand_state[2:6, 0], "left", left)
    check_hand(hands.hand_state[0:3, 1], "right", right)
    check_hand(hands.hand_state[5:17, 1], "right", later)
    missing = hands.hand_state[~hands.presence]
    np.testing.assert_array_equal(missing, absent((len(missing),)))
    np.testing.assert_array_equal(hands.score > 0, hands.presence)
    assert not hands.filled.any()
    assert (hands.shape_space, hands.hand_model) == ("mano", model.name)


def test_joints_are_where_mano_puts_them(mano, tmp_path):
    """The wrist joint of the model is the wrist that HaWoR's transl leads to."""
    model = HandModel.from_mano(mano)
    hand = true_hand("left", 2, 5)
    write_stretch(tmp_path, "left", 0, hand, model)
    hands = read_hands(tmp_path, 2, model)
    joints = model.joints(hands.hand_state[:, 0].astype(np.float64), "left")
    np.testing.assert_allclose(np.asarray(joints)[:, 0], hand["wrist"], atol=1e-6)


def test_a_clip(mano, tmp_path):
    model = HandModel.from_mano(mano)
    checkout = write_files(
        tmp_path / "HaWoR",
        {
            "scripts/scripts_test_video/detect_track_video.py": HAWOR_DETECT,
            "scripts/scripts_test_video/hawor_video.py": HAWOR_MOTION,
            "weights/external/detector.pt": "",
            "weights/hawor/checkpoints/hawor.ckpt": "hawor weights",
        },
    )
    right = true_hand("right", 6, 4)
    write_stretch(checkout / "recorded", "right", 1, right, model)
    clip = clip_of(make.video(tmp_path / "a.mp4", 12), 9, first=3, focal=80.0)
    settings = HaworSettings(str(checkout), mano_dir=str(mano), python=sys.executable)
    stage = HaworHands(settings)
    assert stage.lacks() == ()
    try:
        after = stage.run_clip(clip, video_of(clip)).clips[0]
    finally:
        stage.close()
    assert after.hands is not None
    check_hand(after.hands.hand_state[1:7, 1], "right", right)
    numbers = after.reports[-1].numbers
    assert (numbers["left"], numbers["right"]) == (0.0, pytest.approx(6 / 9))


def test_no_hands_at_all(mano, tmp_path):
    hands = read_hands(tmp_path / "cam_space", 3, HandModel.from_mano(mano))
    assert not hands.presence.any()
    np.testing.assert_array_equal(hands.hand_state, absent((3, 2)))
    assert isinstance(unpack(hands.hand_state), HandState)


def test_files_that_are_not_as_expected(mano, tmp_path):
    model = HandModel.from_mano(mano)
    write_stretch(tmp_path, "right", 0, true_hand("right", 3, 1), model)
    file = tmp_path / "1" / "0_2.json"
    stored = json.loads(file.read_text())
    with pytest.raises(StageError, match=r"frames below 2, got 0_2\.json"):
        read_hands(tmp_path, 2, model)
    for change, words in (
        ({"init_trans": [[[0, 0]]]}, r"init_trans: expected \(1, 3, 3\), got \(1, 1, 2\)"),
        ({"init_betas": "x"}, "init_betas|ValueError"),
        ({"init_trans": [[[float("nan")] * 3] * 3]}, "init_trans"),
    ):
        file.write_text(json.dumps({**stored, **change}))
        with pytest.raises(StageError, match=words):
            read_hands(tmp_path, 3, model)
    file.write_text("{")
    with pytest.raises(StageError, match=r"0_2\.json"):
        read_hands(tmp_path, 3, model)
    file.rename(file.with_name("x.json"))
    with pytest.raises(StageError, match=r"FIRST_LAST\.json"):
        read_hands(tmp_path, 3, model)


def test_says_what_it_lacks(tmp_path):
    lacks = HaworHands().lacks()
    assert [lack.what.split(" (")[0] for lack in lacks] == [
        "an interpreter",
        "HaWoR",
        "HaWoR's weights",
        "MANO",
    ]
    assert "mano.is.tue.mpg.de" in lacks[-1].where
    clip = clip_of(make.video(tmp_path / "a.mp4", 3), 3, focal=80.0)
    with pytest.raises(NotReadyError, match="HaWoR"):
        HaworHands().run_clip(clip, video_of(clip))
