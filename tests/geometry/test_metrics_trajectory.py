"""Trajectory metrics: the golden pair, the evo package's numbers, and laws."""

import json
from dataclasses import replace
from math import isnan, log, nan
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mint_hub.geometry import rigid as rg
from mint_hub.geometry.metrics import (
    TRAJECTORY_MEASURES,
    TrajectoryErrors,
    TrajectoryStatistics,
    align_paths,
    associate,
    ranked_sequences,
    trajectory_errors,
)
from mint_hub.geometry.rotations import quat_xyzw_to_matrix, rotvec_to_matrix

laws = settings(deadline=None, max_examples=40, derandomize=True)
seeds = st.integers(0, 2**31 - 1)
RATIO = "Arc-length ratio (predicted / true)"


def walk(rng: np.random.Generator, frames: int, turn: float = 0.02, move: float = 0.01) -> Any:
    """A camera's random way (T, 4, 4)."""
    steps = rg.se3_exp(rng.normal(size=(frames, 6)) * np.repeat([move, turn], 3))
    path = [steps[0]]
    for step in steps[1:]:
        path.append(path[-1] @ step)
    return np.stack(path)


def straight(frames: int, step_m: float = 0.1) -> Any:
    T = np.tile(np.eye(4), (frames, 1, 1))
    T[:, 0, 3] = step_m * np.arange(frames)
    return T


def scaled(T: Any, scale: float) -> Any:
    moved = T.copy()
    moved[:, :3, 3] *= scale
    return moved


def moved(rng: np.random.Generator, T: Any) -> Any:
    return rg.se3_exp(rng.normal(size=6)) @ T


# ---------------------------------------------------------------- golden


def test_golden(golden_dir: Path) -> None:
    given_ = np.load(golden_dir / "trajectory_inputs.npz")
    expected = json.loads((golden_dir / "trajectory_expected.json").read_text())
    got = trajectory_errors(given_["pred_c2w"], given_["gt_c2w"])
    pairs = {
        "ATE_mm": got.sim3.ate_mm,
        "RPE_T_mm": got.sim3.rpe_translation_mm,
        "RPE_R_deg": got.rpe_rotation_deg,
        "ATE_S_mm": got.se3.ate_mm,
        "RPE_T_S_mm": got.se3.rpe_translation_mm,
        "ATE_pct": got.sim3.ate_percent,
        "ATE_S_pct": got.se3.ate_percent,
        "scale": got.scale,
        "path_scale": 1 / got.arc_length_ratio,
        "n_frames": got.frames,
        "degenerate": got.degenerate,
        "_gt_path_m": got.true_path_m,
        "_pred_path_m": got.predicted_path_m,
    }
    for name, value in pairs.items():
        assert value == pytest.approx(expected[name], rel=1e-6), name


def read_tum(path: Path) -> tuple[Any, Any]:
    rows = np.loadtxt(path)
    return rows[:, 0], rg.rigid(quat_xyzw_to_matrix(rows[:, 4:8]), rows[:, 1:4])


@pytest.mark.real
def test_equals_evo_on_tum(real_dir: Path, golden_dir: Path) -> None:
    expected = json.loads((golden_dir / "tum_fr2_desk_evo.json").read_text())
    true_times, truth = read_tum(real_dir / "tum" / "fr2_desk_groundtruth.txt")
    times, predicted = read_tum(real_dir / "tum" / "fr2_desk_ORB.txt")
    true_index, index = associate(true_times, times, max_diff_s=0.01)
    assert len(index) == expected["pairs"]
    got = trajectory_errors(predicted[index], truth[true_index], fps=30)
    assert got.true_path_m == pytest.approx(expected["true_path_m"], rel=1e-6)
    assert got.predicted_path_m == pytest.approx(expected["predicted_path_m"], rel=1e-6)
    assert got.scale == pytest.approx(expected["sim3"]["scale"], rel=1e-6)
    for name, part in (("se3", got.se3), ("sim3", got.sim3)):
        want = expected[name]
        assert part.ate_mm == pytest.approx(1e3 * want["ate_m"], rel=1e-6)
        assert part.rpe_translation_mm == pytest.approx(1e3 * want["rpe_1_m"], rel=1e-6)
        assert part.rpe_1s_translation_mm == pytest.approx(1e3 * want["rpe_30_m"], rel=1e-6)
        assert got.rpe_rotation_deg == pytest.approx(want["rpe_1_deg"], rel=1e-6)
        assert got.rpe_1s_rotation_deg == pytest.approx(want["rpe_30_deg"], rel=1e-6)


# ---------------------------------------------------------------- worked out by hand


def test_the_ratio_is_predicted_over_true() -> None:
    truth = straight(40)
    got = trajectory_errors(scaled(truth, 2), truth, fps=10)
    assert got.arc_length_ratio == pytest.approx(2)
    assert got.scale == pytest.approx(0.5)
    assert got.log_scale_1s == pytest.approx(log(2))
    assert got.se3.rpe_translation_mm == pytest.approx(100)
    assert got.se3.rpe_1s_translation_mm == pytest.approx(1000)
    x = 0.1 * (np.arange(40) - 19.5)
    assert got.se3.ate_mm == pytest.approx(1e3 * np.sqrt((x**2).mean()))
    assert got.se3.ate_percent == pytest.approx(100 * np.sqrt((x**2).mean()) / 3.9)
    for value in (got.sim3.ate_mm, got.sim3.rpe_translation_mm, got.sim3.rpe_1s_translation_mm):
        assert value == pytest.approx(0, abs=1e-8)


def test_relative_rotation_is_in_degrees() -> None:
    T = straight(5)
    T[:, :3, :3] = rotvec_to_matrix(np.arange(5.0)[:, None] * np.array([0, 0, 0.1]))
    got = trajectory_errors(T, straight(5), fps=2)
    assert got.rpe_rotation_deg == pytest.approx(np.degrees(0.1))
    assert got.rpe_1s_rotation_deg == pytest.approx(np.degrees(0.2))


def test_drift_is_measured_in_stretches_with_a_fit_each() -> None:
    """1201 frames at 1 Hz; each stretch of 10 s is right in itself, every second one turned."""
    rng = np.random.default_rng(0)
    truth = walk(rng, 1201)
    predicted = truth.copy()
    for start in range(0, 1200, 20):
        predicted[start : start + 10] = moved(rng, predicted[start : start + 10])
    got = trajectory_errors(predicted, truth, fps=1).se3
    assert got.ate_10s_mm == pytest.approx(0, abs=1e-6)
    assert got.ate_1min_mm > 10
    assert got.ate_10min_mm >= got.ate_1min_mm
    both = np.concatenate([predicted[600:1200], predicted[:600]])
    true_both = np.concatenate([truth[600:1200], truth[:600]])
    assert trajectory_errors(both, true_both, fps=1).se3.ate_10min_mm == pytest.approx(
        got.ate_10min_mm
    )
    short = trajectory_errors(predicted[:599], truth[:599], fps=1).se3
    assert isnan(short.ate_10min_mm)
    assert not isnan(short.ate_1min_mm)


def test_ten_minutes_of_ten_minutes_is_the_ate() -> None:
    rng = np.random.default_rng(1)
    got = trajectory_errors(walk(rng, 600), walk(rng, 600), fps=1)
    assert got.se3.ate_10min_mm == pytest.approx(got.se3.ate_mm)
    assert got.sim3.ate_10min_mm == pytest.approx(got.sim3.ate_mm)


def test_still_displacements_do_not_vote_on_scale() -> None:
    truth = straight(60)
    truth[20:40, 0, 3] = truth[20, 0, 3]
    truth[40:, 0, 3] = truth[20, 0, 3] + 0.1 * np.arange(20)
    predicted = scaled(truth, 0.5)
    predicted[20:40, 1, 3] += 0.01 * np.random.default_rng(0).normal(size=20)
    got = trajectory_errors(predicted, truth, fps=5)
    assert got.log_scale_1s == pytest.approx(log(2), rel=0.02)
    assert isnan(trajectory_errors(truth, straight(60, step_m=1e-4), fps=5).log_scale_1s)


# ---------------------------------------------------------------- laws


@laws
@given(seeds, st.integers(2, 80))
def test_perfect_prediction_is_ideal(seed: int, frames: int) -> None:
    rng = np.random.default_rng(seed)
    truth = walk(rng, frames)
    got = trajectory_errors(moved(rng, truth), truth, fps=5)
    for measure in TRAJECTORY_MEASURES:
        value = got.values()[measure.name]
        if not isnan(value):
            assert value == pytest.approx(measure.ideal, abs=1e-7), measure.name
    assert got.values()["RPE-T"] == pytest.approx(0, abs=1e-9)
    assert set(got.values()) == {m.name for m in TRAJECTORY_MEASURES}


@laws
@given(seeds, st.floats(0.1, 10))
def test_worlds_do_not_matter_and_sim3_forgets_the_scale(seed: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    truth, predicted = walk(rng, 60), walk(rng, 60)
    want = trajectory_errors(predicted, truth, fps=5).values()
    got = trajectory_errors(moved(rng, predicted), moved(rng, truth), fps=5).values()
    assert got == pytest.approx(want, rel=1e-6, nan_ok=True)
    other = trajectory_errors(scaled(predicted, scale), truth, fps=5).values()
    for name in want:
        if "Sim(3)" in name or name.startswith("RPE-R"):
            assert other[name] == pytest.approx(want[name], rel=1e-6, nan_ok=True), name
    assert other[RATIO] == pytest.approx(scale * want[RATIO])


@laws
@given(seeds)
def test_sim3_fits_no_worse_than_se3(seed: int) -> None:
    rng = np.random.default_rng(seed)
    got = trajectory_errors(walk(rng, 60), walk(rng, 60), fps=5)
    assert got.sim3.ate_mm <= got.se3.ate_mm * (1 + 1e-9)
    assert got.sim3.ate_10s_mm <= got.se3.ate_10s_mm * (1 + 1e-9)


@laws
@given(seeds)
def test_a_corpus_does_not_depend_on_order_or_shards(seed: int) -> None:
    rng = np.random.default_rng(seed)
    found = [
        trajectory_errors(walk(rng, n), walk(rng, n), fps=5)
        for n in rng.integers(1, 70, size=7).tolist()
    ]
    whole = TrajectoryStatistics(tuple(found))
    cut = int(rng.integers(0, 8))
    order = [found[i] for i in rng.permutation(7)]
    shards = [TrajectoryStatistics(tuple(part)) for part in (order[:cut], order[cut:])]
    texts = [json.dumps(s.to_dict(), allow_nan=False) for s in shards]
    again = [TrajectoryStatistics.from_dict(json.loads(t)) for t in texts]
    total = sum(again, TrajectoryStatistics())
    np.testing.assert_equal(total.metrics(), whole.metrics())
    np.testing.assert_equal(
        total.metrics(with_degenerate=True), whole.metrics(with_degenerate=True)
    )


def test_mean_and_median_over_sequences() -> None:
    one = trajectory_errors(scaled(straight(9), 2), straight(9), fps=2)
    rows = [replace(one, rpe_rotation_deg=v) for v in (1.0, 2.0, 6.0, nan)]
    metrics = TrajectoryStatistics(tuple(rows)).metrics()
    assert metrics["sequences"] == 4
    assert metrics["RPE-R mean"] == 3
    assert metrics["RPE-R median"] == 2
    assert isnan(metrics["ATE 10 min mean"])
    assert all(isnan(v) for k, v in TrajectoryStatistics().metrics().items() if k[-3:] == "ean")


# ---------------------------------------------------------------- degenerate and bad input


def test_zero_motion_is_reported_and_not_ranked() -> None:
    truth = straight(40)
    still = trajectory_errors(straight(40, 0.0), truth, fps=10)
    assert still.degenerate
    assert still.arc_length_ratio == 0
    assert still.se3.rpe_translation_mm == pytest.approx(100)
    assert still.se3.ate_mm == pytest.approx(1e3 * np.std(0.1 * np.arange(40)))
    assert isnan(still.scale)
    assert all(isnan(v) for name, v in still.values().items() if "Sim(3)" in name)
    assert np.isfinite(still.log_scale_1s)
    good = trajectory_errors(scaled(truth, 2), truth, fps=10)
    corpus = TrajectoryStatistics((still, good, good))
    assert corpus.metrics()["degenerate"] == 1
    assert corpus.metrics()[f"{RATIO} mean"] == pytest.approx(2)
    assert corpus.metrics(with_degenerate=True)[f"{RATIO} mean"] == pytest.approx((0 + 2 + 2) / 3)
    other = trajectory_errors(truth, straight(40, 0.0), fps=10)
    assert other.degenerate
    assert isnan(other.arc_length_ratio)
    assert isnan(other.se3.ate_percent)
    assert isnan(other.log_scale_1s)


def test_a_row_that_never_moves_is_not_averaged_over_cameras_that_do_not() -> None:
    """Where the true camera is still, zero motion errs by nothing, and nobody else is ranked."""
    still, truth = straight(40, 0.0), straight(40)
    row = [trajectory_errors(still, path, fps=10) for path in (truth, still, still)]
    assert ranked_sequences(row) == [False] * 3
    assert ranked_sequences(row, with_degenerate=True) == [True, False, False]
    metrics = TrajectoryStatistics(tuple(row)).metrics(with_degenerate=True)
    assert metrics["RPE-T mean"] == metrics["RPE-T median"] == pytest.approx(100)
    assert (metrics["sequences"], metrics["degenerate"]) == (3, 3)
    alone = TrajectoryStatistics(tuple(row[1:])).metrics(with_degenerate=True)
    assert alone["RPE-T mean"] == 0


def test_a_single_frame_has_no_relative_pose() -> None:
    got = trajectory_errors(np.eye(4)[None], np.eye(4)[None])
    assert got.degenerate
    assert isnan(got.se3.rpe_translation_mm)
    assert got.se3.ate_mm == 0


@pytest.mark.parametrize("frames", [1, 2, 30])
@pytest.mark.parametrize("step", [0.0, 0.1])
def test_turns_the_centres_leave_free_follow_the_cameras(frames: int, step: float) -> None:
    rng = np.random.default_rng(2)
    truth, motion = straight(frames, step), rg.se3_exp(rng.normal(size=6))
    fit = align_paths(motion @ truth, truth, with_scale=True)
    np.testing.assert_allclose(fit.matrix(), rg.inverse(motion), atol=1e-6)


def test_poses_are_made_rigid_before_they_are_compared() -> None:
    rng = np.random.default_rng(3)
    truth = walk(rng, 30)
    rough = truth.copy()
    rough[:, :3, :3] *= 1.02
    assert trajectory_errors(rough, truth).rpe_rotation_deg == pytest.approx(0, abs=1e-9)
    assert trajectory_errors(rough, truth).se3.rpe_translation_mm == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize(
    ("predicted", "message"),
    [
        (straight(4), r"predicted: expected \(5, 4, 4\) poses, got shape \(4, 4, 4\)"),
        (straight(5)[:, :3], r"predicted: expected \(5, 4, 4\)"),
        (straight(5) * np.nan, r"predicted: expected finite poses, got 5 others of 5"),
        (straight(5) * [[-1.0], [1], [1], [1]], r"no rotation in 5 of 5, the first in frame 0"),
        (np.zeros((5, 4, 4)), r"no rotation in 5 of 5"),
    ],
)
def test_bad_paths_are_named(predicted: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        trajectory_errors(predicted, straight(5))


def test_other_bad_input_is_named() -> None:
    with pytest.raises(ValueError, match=r"truth: expected \(T, 4, 4\)"):
        trajectory_errors(straight(0), straight(0))
    with pytest.raises(ValueError, match="fps: expected a positive"):
        trajectory_errors(straight(3), straight(3), fps=0)
    values = trajectory_errors(straight(3), straight(3)).to_dict()
    del values["se3"]["ate_mm"]
    with pytest.raises(ValueError, match=r"AlignedErrors: .* missing \['ate_mm'\]"):
        TrajectoryErrors.from_dict(values)


def test_clocks_are_paired_by_the_nearest() -> None:
    few, many = np.array([0.0, 1.0, 2.004, 9.0]), np.array([0.004, 0.995, 1.004, 2.0, 2.008, 3.0])
    np.testing.assert_array_equal(associate(few, many), [[0, 1, 2], [0, 2, 3]])
    np.testing.assert_array_equal(associate(many, few), [[0, 2, 3], [0, 1, 2]])
    assert len(associate(few, many + 100)[0]) == 0
    with pytest.raises(ValueError, match="other_times_s: expected times"):
        associate(few, many[::-1])
    with pytest.raises(ValueError, match=r"^times_s: expected times"):
        associate(few[:0], many)
