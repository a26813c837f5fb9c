"""Answers that need no model: they are what they say, and a mean hand that is none is named."""

import json
from dataclasses import replace

import numpy as np
import pytest

from mint_hub.evaluation.trivial import MeanHand, trivial_predictions
from tests.evaluation_data import true_episode, without_hands


@pytest.fixture(scope="module")
def truth():
    return [true_episode(0)]


def test_last_frame_is_the_truth_one_frame_late(truth):
    late = trivial_predictions(truth[0], MeanHand.load())["last frame copied"]
    assert np.array_equal(late.hand_state[1:], truth[0].hand_state[:-1])
    assert np.array_equal(late.T_camera_from_world[1:], truth[0].T_camera_from_world[:-1])


def test_mean_hand_of_one_constant_clip_is_that_hand(truth, tmp_path):
    state = np.tile(truth[0].hand_state[20:21], (30, 1, 1))
    constant = replace(
        truth[0].window(0, 30), hand_state=state, presence=np.ones((30, 2), bool), text=()
    )
    mean = MeanHand.of([constant], "one clip", step=1)
    np.testing.assert_allclose(mean.state(), state[0], atol=2e-6)
    assert mean.presence_rate == [1, 1]
    assert MeanHand.load(mean.save(tmp_path / "m.json")) == mean
    (tmp_path / "m.json").write_text('{"frames": 3}')
    with pytest.raises(ValueError, match=r"m\.json: expected a mean hand"):
        MeanHand.load(tmp_path / "m.json")
    with pytest.raises(ValueError, match=r"none\.json: expected a mean hand, found no file"):
        MeanHand.load(tmp_path / "none.json")
    with pytest.raises(ValueError, match="expected frames with each hand"):
        MeanHand.of([without_hands(truth[0])], "none")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"presence_rate": [0.5]}, r"presence_rate: expected \(2,\), got \(1,\)"),
        ({"presence_rate": "a"}, "presence_rate: expected numbers"),
        ({"presence_rate": [0.5, 1.5]}, "presence_rate: expected finite numbers from 0 to 1"),
        ({"fov_vh_rad": [1, 2, 3]}, r"fov_vh_rad: expected \(2,\), got \(3,\)"),
        ({"fov_vh_rad": None}, "fov_vh_rad: expected"),
        ({"fov_vh_rad": [1.0, float("nan")]}, "fov_vh_rad: expected finite"),
        ({"hand_state": [[0.0] * 109]}, r"hand_state: expected \(2, 109\), got \(1, 109\)"),
        ({"hand_state": [[0.0] * 109] * 2}, "expected a mean hand, got rot6d"),
        ({"shape_space": "other"}, "shape_space: expected one of"),
    ],
)
def test_mean_hands_that_are_none_name_the_field(tmp_path, change, message):
    path = MeanHand.load().save(tmp_path / "m.json")
    path.write_text(json.dumps({**json.loads(path.read_text()), **change}))
    with pytest.raises(ValueError, match=rf"m\.json: .*{message}"):
        MeanHand.load(path)


def test_hands_by_lot_are_the_same_every_time_and_as_frequent_as_said(truth):
    mean = replace(MeanHand.load(), presence_rate=[0.25, 1.0])
    long = true_episode(0, 400)
    one, two = (trivial_predictions(long, mean)["mean hand"] for _ in range(2))
    assert np.array_equal(one.presence, two.presence)
    assert one.presence[:, 0].mean() == pytest.approx(0.25, abs=0.08)
    assert one.presence[:, 1].all()
