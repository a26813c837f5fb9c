"""World-space hands: against a plain loop, cases worked out by hand, and laws."""

import json
from dataclasses import replace
from math import isnan
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mint_hub.geometry import rigid as rg
from mint_hub.geometry.metrics import (
    WORLD_MEASURES,
    WorldHands,
    WorldStatistics,
    align_paths,
    world_hand_statistics,
)

laws = settings(deadline=None, max_examples=25, derandomize=True)
seeds = st.integers(0, 2**31 - 1)


def clip(rng: np.random.Generator, frames: int, keep: float = 0.95) -> WorldHands:
    """Two wobbling hands before a wandering camera."""
    steps = rg.se3_exp(0.02 * rng.normal(size=(frames, 6)))
    path = [steps[0]]
    for step in steps[1:]:
        path.append(path[-1] @ step)
    hand = 0.05 * rng.normal(size=(2, 21, 3)) + np.array([0, 0, 0.4])
    sway = 0.01 * rng.normal(size=(frames, 2, 1, 3)).cumsum(axis=0)
    joints = hand + sway + 0.002 * rng.normal(size=(frames, 2, 21, 3))
    return WorldHands(np.stack(path), joints, rng.random((frames, 2)) < keep)


def noisy(rng: np.random.Generator, truth: WorldHands) -> WorldHands:
    T = truth.T_world_from_camera @ rg.se3_exp(0.01 * rng.normal(size=(len(truth.present), 6)))
    joints = truth.joints_camera + 0.01 * rng.normal(size=truth.joints_camera.shape)
    return WorldHands(T, joints, rng.random(truth.present.shape) < 0.95)


def still(frames: int) -> WorldHands:
    """A hand pair at rest before a camera on a straight line."""
    T = np.tile(np.eye(4), (frames, 1, 1))
    T[:, 0, 3] = 0.01 * np.arange(frames)
    world = np.random.default_rng(0).normal(size=(2, 21, 3))
    joints = world - T[:, None, None, :3, 3]
    return WorldHands(T, joints, np.ones((frames, 2), bool))


def shifted(hands: WorldHands, offset: Any, present: Any = None) -> WorldHands:
    """With joints moved; the camera of ``still`` does not turn, so also in the world."""
    moved = replace(hands, joints_camera=hands.joints_camera + offset)
    return moved if present is None else replace(moved, present=present)


def plain(predicted: WorldHands, truth: WorldHands, fps: float, with_scale: bool) -> dict:
    """One hand, one run, one chunk at a time."""
    fit = align_paths(predicted.T_world_from_camera, truth.T_world_from_camera, with_scale)
    sums = {"W-MPJPE": [], "WA-MPJPE": [], "RTE": [], "Acceleration error": []}
    for hand in (0, 1):
        world, true = [], []
        for t in range(len(truth.present)):
            P, G = predicted.T_world_from_camera[t], truth.T_world_from_camera[t]
            centre = fit.scale * fit.rotation @ P[:3, 3] + fit.translation
            world.append(predicted.joints_camera[t, hand] @ (fit.rotation @ P[:3, :3]).T + centre)
            true.append(truth.joints_camera[t, hand] @ G[:3, :3].T + G[:3, 3])
        world, true = np.array(world), np.array(true)
        both = [*(predicted.present & truth.present)[:, hand], False]
        run: list[int] = []
        for t, seen in enumerate(both):
            if seen:
                run.append(t)
                continue
            for i in range(0, len(run), 100):
                part = run[i : i + 100]
                for name, frames in (("W-MPJPE", part[:2]), ("WA-MPJPE", part)):
                    fitted = rg.umeyama(world[frames].reshape(-1, 3), true[frames].reshape(-1, 3))
                    far = np.linalg.norm(fitted.apply(world[part]) - true[part], axis=-1)
                    sums[name] += list(1e3 * far.mean(axis=1))
            if len(run) >= 2:
                a, b = world[run, 0], true[run, 0]
                length = np.linalg.norm(np.diff(b, axis=0), axis=1).sum()
                far = np.linalg.norm(rg.umeyama(a, b, with_scale=False).apply(a) - b, axis=1)
                sums["RTE"] += list(100 * far / length)
            if len(run) >= 5:
                a, b = (np.diff(x[run], 2, axis=0)[1:-1] * fps**2 for x in (world, true))
                sums["Acceleration error"] += list(np.linalg.norm(a - b, axis=-1).mean(axis=1))
            run = []
    return {name: np.mean(values) for name, values in sums.items()}


@pytest.mark.parametrize("with_scale", [False, True])
@pytest.mark.parametrize("seed", [0, 1])
def test_equals_a_plain_loop(seed: int, with_scale: bool) -> None:
    rng = np.random.default_rng(seed)
    truth = clip(rng, 230, keep=0.99 if seed else 0.8)
    predicted = noisy(rng, truth)
    predicted = replace(predicted, present=predicted.present | (rng.random() < 2 * seed))
    got = world_hand_statistics(predicted, truth, 30.0, with_scale).metrics()
    want = plain(predicted, truth, 30.0, with_scale)
    for name, value in want.items():
        assert got[name] == pytest.approx(value, rel=1e-9), name


# ---------------------------------------------------------------- worked out by hand


def test_w_is_fitted_on_two_frames_and_chunks_have_tails() -> None:
    truth = still(202)  # chunks of 100, 100 and 2
    late = np.zeros((202, 1, 1, 3))
    late[2:] = [0, 0.05, 0]  # seen in the first chunk only: the later ones are shifted throughout
    got = world_hand_statistics(shifted(truth, late), truth).metrics()
    assert got["W-MPJPE"] == pytest.approx(50 * 98 / 202, rel=1e-6)
    assert 0 < got["WA-MPJPE"] < got["W-MPJPE"]
    assert got["World coverage"] == 1


def test_relative_path_error() -> None:
    """A wrist 1.1 times too fast on a line of eleven samples, fitted by SE(3) at its middle."""
    truth = still(11)
    t = np.arange(11.0)[:, None, None, None] * np.array([0.0, 0.1, 0])
    got = world_hand_statistics(shifted(truth, 1.1 * t), shifted(truth, t))
    off = 0.1 * 0.1 * np.abs(np.arange(11) - 5).mean()
    assert got.metrics()["RTE"] == pytest.approx(100 * off / 1.0, rel=1e-6)
    assert (got.rte_frames, got.still_runs) == (22, 0)
    rest = world_hand_statistics(shifted(truth, t), truth)
    assert (rest.rte_frames, rest.still_runs) == (0, 2)


def test_acceleration_error() -> None:
    truth = still(12)
    t = np.arange(12.0)[:, None, None, None] / 10
    predicted = shifted(truth, 0.5 * 3.0 * t**2 * np.array([0.6, 0, 0.8]))
    got = world_hand_statistics(predicted, truth, fps=10)
    assert got.acceleration_count == 2 * (12 - 4)
    assert got.metrics()["Acceleration error"] == pytest.approx(3.0, rel=1e-6)
    holes = truth.present.copy()
    holes[4], holes[10, 0] = False, False  # runs of 4 and 7 left: of 4, 5 and 1 for the left hand
    got = world_hand_statistics(replace(predicted, present=holes), truth, fps=10)
    assert got.acceleration_count == (5 - 4) + (7 - 4)


def test_camera_scale_moves_centres_and_not_hand_size() -> None:
    rng = np.random.default_rng(4)
    truth = clip(rng, 40, keep=2)
    T = truth.T_world_from_camera.copy()
    T[:, :3, 3] *= 3
    predicted = replace(truth, T_world_from_camera=T)
    perfect = world_hand_statistics(predicted, truth, with_scale=True).metrics()
    for measure in WORLD_MEASURES:
        assert perfect[measure.name] == pytest.approx(measure.ideal, abs=1e-6)
    wrong = world_hand_statistics(predicted, truth).metrics()
    assert wrong["W-MPJPE"] > 1
    assert wrong["RTE"] > 1


def test_missed_hands_show_in_the_coverage_only() -> None:
    truth = still(20)
    half = truth.present.copy()
    half[:10] = False
    got = world_hand_statistics(replace(truth, present=half), truth).metrics()
    assert got["World coverage"] == 0.5
    assert got["W-MPJPE"] == pytest.approx(0, abs=1e-9)


# ---------------------------------------------------------------- laws


@laws
@given(seeds, st.integers(1, 40), st.booleans())
def test_perfect_prediction_is_ideal_in_any_world(seed: int, frames: int, scale: bool) -> None:
    rng = np.random.default_rng(seed)
    truth = clip(rng, frames)
    predicted = replace(
        truth, T_world_from_camera=rg.se3_exp(rng.normal(size=6)) @ truth.T_world_from_camera
    )
    got = world_hand_statistics(predicted, truth, with_scale=scale).metrics()
    for measure in WORLD_MEASURES:
        if not isnan(got[measure.name]):
            assert got[measure.name] == pytest.approx(measure.ideal, abs=1e-5), measure.name


@laws
@given(seeds, st.booleans())
def test_worlds_do_not_matter(seed: int, with_scale: bool) -> None:
    rng = np.random.default_rng(seed)
    truth = clip(rng, 30)
    predicted = noisy(rng, truth)
    want = world_hand_statistics(predicted, truth, with_scale=with_scale)
    moved = [
        replace(h, T_world_from_camera=rg.se3_exp(rng.normal(size=6)) @ h.T_world_from_camera)
        for h in (predicted, truth)
    ]
    got = world_hand_statistics(*moved, with_scale=with_scale)
    assert got.to_dict() == pytest.approx(want.to_dict(), rel=1e-6)


@laws
@given(seeds)
def test_left_and_right_are_treated_alike_and_clips_add_up(seed: int) -> None:
    rng = np.random.default_rng(seed)
    found = []
    for _ in range(3):
        truth = clip(rng, 15)
        pair = noisy(rng, truth), truth
        found.append(world_hand_statistics(*pair))
        swapped = [
            replace(h, joints_camera=h.joints_camera[:, ::-1], present=h.present[:, ::-1])
            for h in pair
        ]
        other = world_hand_statistics(*swapped).to_dict()
        assert other == pytest.approx(found[-1].to_dict(), rel=1e-9)
    whole = sum(found, WorldStatistics())
    again = [WorldStatistics.from_dict(json.loads(json.dumps(s.to_dict()))) for s in found[::-1]]
    assert sum(again, WorldStatistics()).to_dict() == pytest.approx(whole.to_dict(), rel=1e-12)


def test_still_camera_keeps_its_own_turn() -> None:
    """No centre moves, so the camera rotations decide how the worlds are laid on each other."""
    rng = np.random.default_rng(5)
    truth = clip(rng, 20, keep=2)
    T = truth.T_world_from_camera.copy()
    T[:, :3, 3] = 0.3
    truth = replace(truth, T_world_from_camera=T)
    predicted = replace(truth, T_world_from_camera=rg.se3_exp(rng.normal(size=6)) @ T)
    for with_scale in (False, True):
        got = world_hand_statistics(predicted, truth, with_scale=with_scale).metrics()
        assert got["Acceleration error"] == pytest.approx(0, abs=1e-6)


# ---------------------------------------------------------------- inputs


def test_nothing_in_common_is_nan() -> None:
    truth = still(6)
    got = world_hand_statistics(replace(truth, present=~truth.present), truth)
    assert got.metrics()["World coverage"] == 0
    assert isnan(got.metrics()["W-MPJPE"])
    assert all(isnan(v) for v in WorldStatistics().metrics().values())


def test_absent_hands_are_not_read() -> None:
    rng = np.random.default_rng(6)
    truth = clip(rng, 30, keep=0.7)
    predicted = noisy(rng, truth)
    holes = [
        replace(h, joints_camera=np.where(h.present[..., None, None], h.joints_camera, np.nan))
        for h in (predicted, truth)
    ]
    assert world_hand_statistics(*holes) == world_hand_statistics(predicted, truth)


def test_bad_input_is_named() -> None:
    truth = still(5)
    cases = [
        ({"T_world_from_camera": np.zeros((0, 4, 4))}, r"predicted.T_world_from_camera: expected"),
        ({"joints_camera": np.zeros((4, 2, 21, 3))}, r"predicted.joints_camera: expected shape"),
        ({"joints_camera": truth.joints_camera * np.nan}, r"in 10 of 10 hands, the first in frame"),
        ({"present": np.ones((5, 2))}, r"predicted.present: expected booleans"),
    ]
    for changed, message in cases:
        with pytest.raises(ValueError, match=message):
            world_hand_statistics(replace(truth, **changed), truth)
    with pytest.raises(ValueError, match="fps"):
        world_hand_statistics(truth, truth, fps=float("nan"))
