"""Fitting hands to landmarks: exact ones give the hand back, bad ones never crash it."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

from mint_hub.conventions import LEFT, RIGHT
from mint_hub.geometry.hand_model import HandModel
from mint_hub.geometry.hand_state import unpack
from mint_hub.geometry.plain_pickle import load_plain_npy
from mint_hub.geometry.rotations import geodesic_angle, mean_rotation, rotvec_to_matrix
from mint_hub.labelling.stages.hand_evidence import (
    NoiseSettings,
    Pose,
    Seen,
    evidence_of,
    hand_states,
    rest_of,
    turn_from_axis,
)
from mint_hub.labelling.stages.hand_fitting import NEAR_M, FittingSettings, fit_hands
from mint_hub.labelling.stages.hand_skeleton import left_jacobian, pose, rest_points
from mint_hub.synth.hand_pose import LIMITS_DEG
from tests.labelling import hand_scenes as scene

NO_SHAPE = np.zeros(10)
REST = rest_of(HandModel.template(), NO_SHAPE)
SETTINGS = FittingSettings()


def evidence(uv, metres, hand, noise=None):
    return evidence_of(Seen(uv, metres, hand), scene.K, scene.SIZE_HW, REST, noise)


def refitted(count, seed=0, pixels=0.0, metres=0.0, **how):
    """Random hands of both sides, and what a fit to their landmarks makes of them."""
    rng = np.random.default_rng(seed)
    hand = scene.both_sides(count)
    true = scene.states(rng, hand, **how)
    points = scene.keypoints(true, hand)
    fit = fit_hands(evidence(*scene.landmarks(points, rng, pixels, metres), hand), SETTINGS)
    return true, points, hand_states(fit.pose, hand, NO_SHAPE), hand


def off_mm(a, b):
    return 1e3 * np.linalg.norm(a - b, axis=-1)


def turn_deg(a, b):
    return np.rad2deg(geodesic_angle(unpack(a).orientation(), unpack(b).orientation()))


def random_angles(count, seed=0):
    return np.deg2rad(np.random.default_rng(seed).uniform(*LIMITS_DEG.T, (count, 21)))


class TestSkeleton:
    @pytest.mark.parametrize("hand", [LEFT, RIGHT])
    def test_its_points_are_the_hand_models(self, hand):
        """Through the 109 numbers; left hands are mirrored both ways."""
        rng = np.random.default_rng(3)
        shape = rng.normal(0, 1, 10)
        rest = rest_points(HandModel.template(), ("left", "right")[hand], shape)
        turn = rotvec_to_matrix(rng.normal(0, 1, (6, 3)))
        found = Pose(turn, rng.normal(0, 0.2, (6, 3)) + np.array([0, 0, 0.6]), random_angles(6))
        points = pose(found.angles, rest, with_jacobian=False).points
        placed = points @ np.swapaxes(turn, 1, 2) + found.translation[:, None]
        hands = np.full(6, hand)
        if hand == LEFT:
            placed = placed * [-1, 1, 1]
        made = scene.keypoints(hand_states(found, hands, shape), hands)
        assert off_mm(placed, made).max() < 0.1  # tips are skinned with weights of .9995 and more

    def test_its_jacobian_is_the_slope(self):
        angles, step = random_angles(4, 1), 1e-6
        jacobian = pose(angles, REST[RIGHT]).jacobian
        for i in range(21):
            ahead, back = angles.copy(), angles.copy()
            ahead[:, i] += step
            back[:, i] -= step
            rise = pose(ahead, REST[RIGHT], False).points - pose(back, REST[RIGHT], False).points
            assert_allclose(jacobian[..., i], rise / (2 * step), atol=1e-8)

    def test_left_jacobian_turns_what_the_rotation_vector_turns(self):
        rng = np.random.default_rng(5)
        vector = np.concatenate([rng.normal(0, 1, (8, 3)), np.zeros((1, 3))])
        change = 1e-6 * rng.normal(0, 1, (9, 3))
        turned = rotvec_to_matrix((left_jacobian(vector) @ change[..., None])[..., 0])
        expected = rotvec_to_matrix(vector + change)
        assert_allclose(turned @ rotvec_to_matrix(vector), expected, atol=1e-10)


class TestExactLandmarks:
    def test_give_the_hand_back(self):
        """Any turn, both sides, a fifth of the hands partly outside the image.

        The turn of a straight thumb about itself hardly shows, so that the prior has a say in it.
        """
        true, points, found, hand = refitted(200)
        uv, _ = scene.landmarks(points)
        outside = ((uv < 0) | (uv >= scene.SIZE_HW[::-1])).any((1, 2))
        assert 20 < outside.sum() < 100
        off = off_mm(scene.keypoints(found, hand), points).max(1)
        assert np.quantile(off, 0.99) < 2.0
        assert np.median(off) < 0.1
        assert off.max() < 5.0
        assert turn_deg(found, true).max() < 0.5

    def test_joint_rotations_too(self):
        true, _, found, _ = refitted(100, seed=1)
        off = geodesic_angle(unpack(found).joint_rotations(), unpack(true).joint_rotations())
        assert np.rad2deg(off[:, :12]).max() < 1.0
        assert np.median(np.rad2deg(off[:, 12:])) < 1.0

    def test_of_a_hand_half_outside_the_image(self):
        rng = np.random.default_rng(2)
        hand = scene.both_sides(60)
        points = scene.keypoints(scene.states(rng, hand, spread_m=0.02, depth_m=(0.3, 0.4)), hand)
        border = scene.SIZE_HW[1] / 2 / scene.FOCAL
        points[..., 0] += (border * points[..., 2] - points[..., 0]).mean(1, keepdims=True)
        uv, metres = scene.landmarks(points)
        outside = (uv[..., 0] >= scene.SIZE_HW[1]).mean(1)
        assert ((outside > 0.2) & (outside < 0.8)).all()
        fit = fit_hands(evidence(uv, metres, hand), SETTINGS)
        found = scene.keypoints(hand_states(fit.pose, hand, NO_SHAPE), hand)
        assert np.quantile(off_mm(found, points).max(1), 0.97) < 2.0

    def test_with_some_missing(self):
        rng = np.random.default_rng(4)
        hand = scene.both_sides(40)
        points = scene.keypoints(scene.states(rng, hand), hand)
        uv, metres = scene.landmarks(points)
        uv[:, [4, 12]] = np.nan
        metres[:, 20] = np.nan
        fit = fit_hands(evidence(uv, metres, hand), SETTINGS)
        found = scene.keypoints(hand_states(fit.pose, hand, NO_SHAPE), hand)
        assert np.quantile(off_mm(found, points).max(1), 0.95) < 2.0

    def test_of_a_real_annotation(self, real_dir):
        """25 frames of MANO's right hand: another hand than ours, but rotations mean the same."""
        (path,) = (real_dir / "ego4d").glob("*.npy")
        raw = load_plain_npy(path)
        points = raw["right"]["joints_camspace"].astype(np.float64)
        K = raw["intrinsics"].astype(np.float64)
        on_plane = points[..., :2] / points[..., 2:]
        local = (points - points.mean(1, keepdims=True)) @ turn_from_axis(on_plane.mean(1))
        seen = Seen(on_plane * K[[0, 1], [0, 1]] + K[:2, 2], local, np.full(25, RIGHT))
        fit = fit_hands(evidence_of(seen, K, (1080, 1440), REST), SETTINGS)
        turn = geodesic_angle(fit.pose.rotation, raw["right"]["global_orient_camspace"])
        assert np.rad2deg(turn).max() < 6
        apart = np.swapaxes(raw["right"]["global_orient_camspace"], 1, 2) @ fit.pose.rotation
        assert np.rad2deg(geodesic_angle(mean_rotation(apart), np.eye(3))) < 3
        rooted = off_mm(fit.points - fit.points[:, :1], points - points[:, :1])
        assert rooted.mean() < 15
        nearness = fit.pose.translation[:, 2] / points[:, 0, 2]
        assert abs(nearness.mean() - 1) < 0.12  # as much as that hand is larger than ours


class TestNoisyLandmarks:
    def test_leave_bounded_errors(self):
        """A pixel and 3 mm of noise."""
        true, points, found, hand = refitted(200, seed=6, pixels=1.0, metres=0.003)
        made = scene.keypoints(found, hand)
        rooted = off_mm(made - made[:, :1], points - points[:, :1]).mean(1)
        assert np.median(rooted) < 4
        assert np.quantile(rooted, 0.95) < 8
        assert np.median(np.abs(made - points)[:, 0, 2]) < 0.010
        assert np.median(turn_deg(found, true)) < 4

    def test_one_landmark_far_off_hardly_matters(self):
        rng = np.random.default_rng(8)
        hand = scene.both_sides(60)
        points = scene.keypoints(scene.states(rng, hand), hand)
        uv, metres = scene.landmarks(points, rng, 0.5, 0.001)
        kept = np.arange(21) != 8
        uv[:, 8] += 60
        fit = fit_hands(evidence(uv, metres, hand), SETTINGS)
        made = scene.keypoints(hand_states(fit.pose, hand, NO_SHAPE), hand)
        assert np.median(off_mm(made, points)[:, kept].max(1)) < 15

    def test_are_reported(self):
        rng = np.random.default_rng(9)
        hand = scene.both_sides(60)
        points = scene.keypoints(scene.states(rng, hand), hand)
        exact = fit_hands(evidence(*scene.landmarks(points), hand), SETTINGS)
        noisy = fit_hands(evidence(*scene.landmarks(points, rng, 2.0, 0.01), hand), SETTINGS)
        assert np.median(exact.seen_residual) * scene.FOCAL < 0.1
        assert 0.5 < np.median(noisy.seen_residual) * scene.FOCAL < 3
        assert np.median(exact.direction_residual) < np.deg2rad(1)
        assert np.median(noisy.direction_residual) > np.deg2rad(5)
        assert (noisy.cost > exact.cost).all()


class TestOneAtATime:
    def test_equals_all_at_once(self):
        rng = np.random.default_rng(10)
        hand = scene.both_sides(12)
        points = scene.keypoints(scene.states(rng, hand), hand)
        known = evidence(*scene.landmarks(points, rng, 1.0, 0.004), hand)
        near = Pose(
            rotvec_to_matrix(rng.normal(0, 1, (12, 3))),
            np.tile([0.0, 0.0, 0.4], (12, 1)),
            random_angles(12),
        )
        for told in (known, replace(known, near=near, near_noise=np.full((12, 3), 0.5))):
            together = fit_hands(told, SETTINGS)
            for i in range(12):
                alone = fit_hands(told[[i]], SETTINGS)
                assert_allclose(alone.points[0], together.points[i], atol=1e-6)
                assert_allclose(alone.cost[0], together.cost[i], rtol=1e-5)


class TestNeighbours:
    def test_pull_where_landmarks_leave_it_open(self):
        """Fingers that nobody saw bend as they did in the frames around."""
        rng = np.random.default_rng(11)
        hand = np.full(20, RIGHT)
        true = scene.states(rng, hand)
        points = scene.keypoints(true, hand)
        uv, metres = scene.landmarks(points)
        unseen = [6, 7, 8, 10, 11, 12]
        uv[:, unseen] = metres[:, unseen] = np.nan
        known = evidence(uv, metres, hand)
        full = fit_hands(evidence(*scene.landmarks(points), hand), SETTINGS)
        told = replace(known, near=full.pose, near_noise=np.full((20, 3), 0.05))
        without = off_mm(fit_hands(known, SETTINGS).points, points)[:, unseen].mean()
        assert off_mm(fit_hands(told, SETTINGS).points, points)[:, unseen].mean() < 0.2 * without

    def test_of_infinite_spread_change_nothing(self):
        rng = np.random.default_rng(12)
        hand = scene.both_sides(8)
        points = scene.keypoints(scene.states(rng, hand), hand)
        known = evidence(*scene.landmarks(points, rng, 1.0, 0.003), hand)
        alone = fit_hands(known, SETTINGS)
        told = replace(known, near=alone.pose, near_noise=np.full((8, 3), np.inf))
        assert_allclose(fit_hands(told, SETTINGS).points, alone.points, atol=1e-9)


class TestEvidence:
    def test_directions_are_those_of_the_camera_frame(self):
        """However far from the optical axis the hand is seen."""
        rng = np.random.default_rng(13)
        hand = np.full(30, RIGHT)
        points = scene.keypoints(scene.states(rng, hand, spread_m=0.5), hand)
        bones = points[:, 9] - points[:, 0]
        known = evidence(*scene.landmarks(points), hand).directions
        assert_allclose(known[:, 8], bones / np.linalg.norm(bones, axis=-1)[:, None], atol=1e-6)

    def test_turn_from_axis_is_the_least_one(self):
        plane = np.array([[0.0, 0.0], [1.0, 0.0], [-0.4, 2.0]])
        turn = turn_from_axis(plane)
        sight = np.column_stack([plane, np.ones(3)])
        sight /= np.linalg.norm(sight, axis=1)[:, None]
        assert_allclose(turn[:, :, 2], sight, atol=1e-12)
        assert_allclose(geodesic_angle(turn, np.eye(3)), np.arccos(sight[:, 2]), atol=1e-7)

    def test_reversing_depth_makes_one_of_the_other_hand(self):
        """A right hand that was taken for a left one: its depth comes the wrong way round."""
        rng = np.random.default_rng(14)
        hand = np.full(60, RIGHT)
        points = scene.keypoints(scene.states(rng, hand), hand)
        uv, metres = scene.landmarks(points)
        wrong = evidence(uv, metres * [1, 1, -1], hand)
        right = wrong.with_depth_reversed()
        assert_allclose(right.directions, evidence(uv, metres, hand).directions, atol=1e-9)
        assert (fit_hands(right, SETTINGS).cost < fit_hands(wrong, SETTINGS).cost).all()

    def test_landmarks_outside_weigh_less_and_missing_ones_nothing(self):
        uv = np.full((1, 21, 2), 100.0)
        uv[0, 3], uv[0, 4], uv[0, 5] = (-1.0, 50.0), (50.0, 384.0), np.nan
        noise = NoiseSettings(outside_weight=0.3)
        weight = evidence(uv, np.zeros((1, 21, 3)), np.array([LEFT]), noise).weight[0]
        expected = np.ones(21)
        expected[[3, 4]], expected[5] = 0.3, 0.0
        assert_allclose(weight, expected)


class TestBadLandmarks:
    def test_of_a_hand_behind_the_camera_end_in_front(self):
        rng = np.random.default_rng(15)
        hand = scene.both_sides(30)
        points = scene.keypoints(scene.states(rng, hand), hand) * [1, 1, -1]
        fit = fit_hands(evidence(*scene.landmarks(points), hand), SETTINGS)
        assert np.isfinite(fit.points).all()
        assert (fit.points[..., 2] > NEAR_M).all()

    @pytest.mark.parametrize("pixels", [0.0, 1e4])
    def test_without_a_hand_in_them_stay_finite(self, pixels):
        """All in one place, or anywhere; without any depth."""
        rng = np.random.default_rng(16)
        uv = 200 + pixels * rng.normal(0, 1, (20, 21, 2))
        metres = np.full((20, 21, 3), np.nan)
        fit = fit_hands(evidence(uv, metres, scene.both_sides(20)), SETTINGS)
        assert np.isfinite(fit.points).all()
        assert np.isnan(fit.direction_residual).all()
