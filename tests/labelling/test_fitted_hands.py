"""The stage from detections to hands: sides, states, scores, and what it says of itself."""

import json
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

from mint_hub.conventions import LEFT, RIGHT
from mint_hub.geometry import hand_state
from mint_hub.geometry.camera import K_to_fov_vh
from mint_hub.geometry.hand_model import HandModel
from mint_hub.geometry.rotations import geodesic_angle, rotvec_to_matrix
from mint_hub.labelling.records import Clip, Intrinsics, Video
from mint_hub.labelling.stage import ClipStage, StageError
from mint_hub.labelling.stages.fitted_hands import (
    FittedHands,
    FittedHandsSettings,
    NeighbourSettings,
    neighbourhood,
    scores,
)
from mint_hub.labelling.stages.hand_evidence import Pose
from mint_hub.synth.hand_pose import POSTURES
from tests.labelling import hand_scenes as scene

T = 30
ALONE = FittedHandsSettings(neighbours=NeighbourSettings(frames=0))


def moving(hand, count=T, seed=0):
    """States (count, 109) of one hand that moves, turns and closes steadily."""
    rng = np.random.default_rng(seed + hand)
    share = np.linspace(0, 1, count)[:, None]
    angles = POSTURES["relaxed"] * (1 - share) + POSTURES["claw"] * share
    state = scene.states(rng, np.full(count, hand), angles_deg=angles)
    start = np.array([-0.12 if hand == LEFT else 0.12, 0.05, 0.4])
    turn = rotvec_to_matrix(rng.normal(0, 0.7, 3)) @ rotvec_to_matrix(0.5 * share * [0.3, 1, 0.2])
    parts = hand_state.unpack(state)
    return hand_state.HandState.from_matrices(
        start + share * [0.0, -0.08, 0.06], turn, parts.joint_rotations(), parts.shape_params
    ).pack()


def clip_of(uv, metres, frame, right_score, score=0.9, count=T):
    found = scene.detections(frame, uv, metres, right_score, score)
    fov = K_to_fov_vh(scene.K, scene.SIZE_HW)
    return Clip(
        key="a",
        video=Path("a.mp4"),
        first_frame=0,
        image_size_hw=scene.SIZE_HW,
        fps=30.0,
        source_timestamps_s=np.arange(count) / 30,
        detections=found,
        intrinsics=Intrinsics((float(fov[0]), float(fov[1])), "given", 1.0),
    )


def two_hands(pixels=0.0, metres=0.0, wrong=()):
    """A clip of both hands; labels of the frames ``wrong`` name the other hand, with its depth."""
    rng = np.random.default_rng(7)
    hands = np.repeat([LEFT, RIGHT], T)
    true = np.concatenate([moving(LEFT), moving(RIGHT)])
    uv, local = scene.landmarks(scene.keypoints(true, hands), rng, pixels, metres)
    frame = np.tile(np.arange(T), 2)
    taken = np.isin(frame, wrong)
    local[taken] *= [1, 1, -1]
    right = np.where((hands == RIGHT) ^ taken, 0.95, 0.05)
    return clip_of(uv, local, frame, right), np.stack([true[:T], true[T:]], 1)


def run(clip, settings=None):
    stage = FittedHands(settings)
    video = Video("v", "v", "user", Path("v.mp4"), 1.0, 30.0, scene.SIZE_HW)
    (made,) = stage.run_clip(clip, video).clips
    assert made.hands is not None
    return made.hands, made.reports[-1]


def joints_off_mm(found, true):
    model = HandModel.template()
    return 1e3 * np.linalg.norm(model.keypoints(found) - model.keypoints(true), axis=-1)


class TestBothHands:
    def test_come_back_exactly(self):
        clip, true = two_hands()
        hands, report = run(clip, ALONE)
        assert hands.presence.all()
        assert joints_off_mm(hands.hand_state, true).max() < 2.0
        assert hands.hand_state.dtype == np.float32
        assert not hands.filled.any()
        assert np.nanmax(hands.residual_px) < 0.5
        assert (hands.shape_space, hands.source) == ("mint", "ik")
        assert report.numbers["coverage"] == [1.0, 1.0]
        assert report.numbers["tracks"] == [1, 1]

    def test_come_back_with_neighbours_asked(self):
        """A steady motion is hardly pulled."""
        clip, true = two_hands()
        hands, _ = run(clip)
        assert np.median(joints_off_mm(hands.hand_state, true)) < 2.0

    def test_of_noisy_landmarks_are_steadier_with_neighbours(self):
        clip, true = two_hands(pixels=1.5, metres=0.008)
        alone, steadied = run(clip, ALONE)[0], run(clip)[0]
        depth = true[..., 2]

        def off(hands):
            return np.abs(hands.hand_state[..., 2] - depth).mean()

        assert off(steadied) < 0.8 * off(alone)
        assert np.median(joints_off_mm(steadied.hand_state, true)) < 20

    def test_taken_for_the_other_one_are_put_right(self):
        """Ten frames of wrong labels, whose depth comes reversed."""
        clip, true = two_hands(wrong=range(5, 15))
        hands, report = run(clip, ALONE)
        assert report.numbers["side_flips_repaired"] == 20
        assert report.numbers["depths_reversed"] == 20
        assert hands.presence.all()
        assert joints_off_mm(hands.hand_state, true).max() < 2.0


class TestScores:
    def test_fall_with_noise_and_outside_the_image(self):
        exact, noisy = run(two_hands()[0])[0], run(two_hands(4.0, 0.02)[0])[0]
        assert exact.score.min() > 0.7
        assert np.median(noisy.score[noisy.presence]) < 0.6 * np.median(exact.score)
        detector, share, turn = np.full(2, 0.9, np.float32), np.full(2, 0.01), np.full(2, 0.1)
        weight = np.ones((2, 21))
        weight[1, :10] = 0.2
        inside, cut = scores(detector, weight, share, turn)
        assert cut < 0.7 * inside

    def test_are_between_0_and_1(self):
        odd = np.array([np.nan, 2.0, -1.0, 1.0], np.float32)
        none = np.zeros(4)
        known = scores(odd, np.ones((4, 21)), none, np.array([0.0, 0.0, 0.0, np.nan]))
        assert_allclose(known, [0, 1, 0, 0.1])


class TestWhatIsNotAHand:
    def test_is_dropped_and_counted(self):
        """Landmarks of no hand, one too far away, one with too few landmarks."""
        rng = np.random.default_rng(1)
        true = moving(RIGHT)
        true[20:, 2] = 3.0
        uv, metres = scene.landmarks(scene.keypoints(true, np.full(T, RIGHT)))
        centre = uv[:, 9:10].copy()
        uv[5] = centre[5] + rng.uniform(-60, 60, (21, 2))
        uv[8, 5:] = np.nan
        uv[20:] += centre[19] - uv[20:].mean(1, keepdims=True)
        clip = clip_of(uv, metres, np.arange(T), np.full(T, 0.9))
        hands, report = run(clip, ALONE)
        present = np.flatnonzero(hands.presence[:, RIGHT])
        assert present.tolist() == [f for f in range(20) if f not in (5, 8)]
        gone = ~hands.presence
        assert (hands.hand_state[gone] == hand_state.absent()).all()
        assert np.isnan(hands.residual_px[gone]).all()
        assert (hands.score[gone] == 0).all()
        assert report.numbers["outliers_dropped"] + report.numbers["detections_dropped"] == 12

    def test_is_never_a_reason_to_crash(self):
        """Behind the camera, no numbers, infinite ones, all points in one."""
        hand = np.full(T, RIGHT)
        points = scene.keypoints(moving(RIGHT), hand)
        uv, metres = scene.landmarks(points)
        uv[:5], metres[:5] = scene.landmarks(points[:5] * [1, 1, -1])
        uv[5:8], metres[8:11], uv[11:13] = np.nan, np.nan, np.inf
        uv[13:15], uv[15:17, :, 0] = 100.0, 1e7
        metres[17:19] = 0
        hands, report = run(clip_of(uv, metres, np.arange(T), np.full(T, 0.9)))
        assert np.isfinite(hands.hand_state).all()
        assert hands.presence[20:, RIGHT].all()
        hand_state.unpack(hands.hand_state).orientation()
        json.dumps(report.numbers, allow_nan=False)

    def test_a_clip_without_any_goes_on_without_hands(self):
        none = np.zeros((0, 21, 2)), np.zeros((0, 21, 3)), np.zeros(0, np.int32), np.zeros(0)
        hands, report = run(clip_of(*none))
        assert not hands.presence.any()
        assert (hands.hand_state == hand_state.absent((T, 2))).all()
        assert report.numbers["median_residual_px"] is None
        json.dumps(report.numbers, allow_nan=False)


class TestNeighbourhood:
    def test_is_the_median_of_the_same_hand_without_itself(self):
        frames = np.array([0, 1, 2, 2, 3, 9])
        hand = np.array([RIGHT, RIGHT, RIGHT, LEFT, RIGHT, RIGHT])
        turn = rotvec_to_matrix(np.array([0.1, 0.2, 2.0, 1.0, 0.3, 0.5])[:, None] * [0, 0, 1.0])
        depth = np.array([0.4, 0.42, 0.9, 0.3, 0.44, 0.7])
        place = np.column_stack([0.1 * depth, 0 * depth, depth])
        angles = np.tile(np.array([1.0, 2, 30, 5, 3, 6])[:, None], (1, 21))
        near, known = neighbourhood(Pose(turn, place, angles), frames, hand, 2)
        assert known.tolist() == [True, True, True, False, True, False]
        assert_allclose(near.angles[2], np.full(21, 2.0))
        assert_allclose(near.translation[2], [0.042, 0, 0.42], atol=1e-9)
        assert geodesic_angle(near.rotation[2], turn[1]) < 0.02
        assert_allclose(near.rotation[~known], turn[~known], atol=1e-9)


class TestStage:
    def test_is_a_stage_that_tells_what_it_misses(self):
        stage = FittedHands()
        assert isinstance(stage, ClipStage)
        clip, _ = two_hands()
        video = Video("v", "v", "user", Path("v.mp4"), 1.0, 30.0, scene.SIZE_HW)
        bare = Clip("b", clip.video, 0, clip.image_size_hw, 30.0, clip.source_timestamps_s)
        with pytest.raises(StageError, match="expected detections of clip b"):
            stage.run_clip(bare, video)

    def test_report_is_plain_and_names_its_settings(self):
        _, report = run(two_hands()[0])
        said = json.loads(json.dumps(report.settings))
        assert said["neighbours"]["frames"] == 3
        json.dumps(report.numbers, allow_nan=False)

    def test_a_known_size_moves_the_hand(self):
        """A hand that is two standard deviations larger is as much farther away."""
        clip, true = two_hands()
        large = FittedHandsSettings(
            neighbours=NeighbourSettings(frames=0), shape_params=(2.0, *[0.0] * 9)
        )
        hands, _ = run(clip, large)
        farther = hands.hand_state[..., 2] / true[..., 2]
        assert_allclose(np.median(farther), 1.12, atol=0.03)
        assert_allclose(hand_state.unpack(hands.hand_state).shape_params[..., 0], 2.0)

    def test_a_shape_of_another_length_is_refused(self):
        with pytest.raises(ValueError, match="shape_params: expected 10 numbers, got 3"):
            FittedHands(FittedHandsSettings(shape_params=(1.0, 2.0, 3.0)))

    def test_a_folder_without_mano_is_refused(self, tmp_path):
        with pytest.raises(FileNotFoundError, match="MANO_RIGHT"):
            FittedHands(FittedHandsSettings(mano_dir=str(tmp_path)))
