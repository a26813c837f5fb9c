"""Coverage-aware hand metrics: the golden clip, cases worked out by hand, and laws."""

import json
from dataclasses import replace
from functools import cache
from math import isnan, sqrt
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mint_hub.geometry import hand_state as hs
from mint_hub.geometry.metrics import (
    HAND_MEASURES,
    Hands,
    HandStatistics,
    Measure,
    canonical_joints,
    hand_statistics,
    measure_of,
    present_hands,
)
from mint_hub.geometry.rotations import rotvec_to_matrix

laws = settings(deadline=None, max_examples=40, derandomize=True)
seeds = st.integers(0, 2**31 - 1)
K = np.array([[100.0, 0, 50], [0, 100, 50], [0, 0, 1]])
SIZE_HW = (100, 100)
DIAGONAL = sqrt(2) * 100
POSE = ("MPJPE-p", "PA-MPJPE-p", "GO-p", "CT-p", "CT-along-p", "CT-lateral-p")


@cache
def stand_in() -> Any:
    joints = canonical_joints()
    joints.setflags(write=False)
    return joints


def random_hands(rng: np.random.Generator, frames: int) -> Hands:
    """Hands near the canonical one, some of them off screen or behind the camera."""
    R = rotvec_to_matrix(rng.normal(size=(frames, 2, 3)))
    shape = stand_in() - stand_in()[:, :1] + 0.01 * rng.normal(size=(frames, 2, 21, 3))
    place = rng.normal([0, 0, 0.3], [0.12, 0.12, 0.15], size=(frames, 2, 3))
    joints = np.einsum("thij,thkj->thki", R, shape) + place[:, :, None]
    return Hands(joints, R, place, rng.random((frames, 2)) < 0.8)


def random_pair(seed: int, frames: int = 12) -> tuple[Hands, Hands]:
    """Truth, and a prediction of it with errors from small to absurd."""
    rng = np.random.default_rng(seed)
    truth = random_hands(rng, frames)
    size = 10 ** rng.uniform(-3, 0.5, size=(frames, 2))
    move = size[..., None] * rng.normal(size=(frames, 2, 3))
    joints = (
        truth.joints
        + move[:, :, None]
        + 0.1 * size[..., None, None] * rng.normal(size=truth.joints.shape)
    )
    turn = rotvec_to_matrix(size[..., None] * rng.normal(size=(frames, 2, 3)))
    present = rng.random((frames, 2)) < 0.8
    return Hands(joints, turn @ truth.orientation, truth.translation + move, present), truth


def score(predicted: Hands, truth: Hands, **more: Any) -> HandStatistics:
    return hand_statistics(predicted, truth, K, SIZE_HW, more.pop("canonical", stand_in()), **more)


def flat_hand(*uv: tuple[float, float], z: float = 1.0, frames: int = 1) -> Hands:
    """Left hands whose joints project to the given pixels (the last for all others) at depth z."""
    pixels = np.array([*uv, *[uv[-1]] * (21 - len(uv))], float)
    joint = np.concatenate([(pixels - 50) / 100 * z, np.full((21, 1), z)], axis=1)
    joints = np.zeros((frames, 2, 21, 3))
    joints[:, 0] = joint
    present = np.zeros((frames, 2), bool)
    present[:, 0] = True
    return Hands(joints, np.broadcast_to(np.eye(3), (frames, 2, 3, 3)), joints[:, :, 0], present)


def gone(hands: Hands) -> Hands:
    return replace(hands, present=np.zeros_like(hands.present))


# ---------------------------------------------------------------- golden


def test_golden(golden_dir: Path) -> None:
    given_ = np.load(golden_dir / "coverage_inputs.npz")
    expected = json.loads((golden_dir / "coverage_expected.json").read_text())
    predicted, truth = (
        Hands(given_[f"{s}_joints"], given_[f"{s}_orientation"], given_[f"{s}_translation"], flags)
        for s, flags in (("pred", given_["pred_presence"]), ("gt", given_["gt_valid"]))
    )
    assert np.array_equal(given_["canonical_orientation"], np.broadcast_to(np.eye(3), (2, 3, 3)))
    got = hand_statistics(
        predicted, truth, np.array(expected["K"]), expected["hw"], given_["canonical_joints"]
    )
    for name, value in expected["stats"].items():
        assert getattr(got, name) == pytest.approx(value, rel=1e-9), name
    metrics = got.metrics()
    for name, value in expected["metrics"].items():
        assert metrics[name] == pytest.approx(value, rel=1e-9), name


# ---------------------------------------------------------------- worked out by hand


@pytest.mark.parametrize(
    ("uv", "z", "present"),
    [
        ((0, 0), 1.0, True),  # the first pixel's corner is inside
        ((100, 50), 1.0, False),  # W is outside
        ((50, 100), 1.0, False),  # H is outside
        ((-1e-9, 50), 1.0, False),
        ((50, 50), 0.01, False),  # z must exceed 0.01
        ((50, 50), 0.010001, True),
        ((50, 50), -1.0, False),
    ],
)
def test_what_is_on_screen(uv: tuple[float, float], z: float, present: bool) -> None:
    truth = flat_hand(uv, z=z)
    missed = score(gone(truth), truth)
    assert (missed.fn, missed.facc_frames, missed.off_screen) == (present, present, not present)
    assert missed.epe_joint_count == (21 if present else 0)
    found = score(truth, truth)
    assert (found.tp, found.fp, found.facc_correct) == (present, 0, present)
    assert found.off_screen_predicted == (not present)
    assert present_hands(truth, K, SIZE_HW).tolist() == [[present, False]]
    assert not present_hands(gone(truth), K, SIZE_HW).any()


def test_one_joint_on_screen_makes_a_hand_and_only_it_is_measured_in_pixels() -> None:
    truth = flat_hand((50, 50), (500, 50))
    moved = replace(truth, joints=np.add(truth.joints, [0.1, 0, 0]))
    got = score(moved, truth)
    assert (got.tp, got.epe_joint_count) == (1, 1)
    assert got.metrics()["EPE-p"] == pytest.approx(10)
    assert got.metrics()["MPJPE-p"] == pytest.approx(0, abs=1e-9)


def test_pixel_errors_are_capped_at_the_diagonal_and_depths_floored() -> None:
    truth = flat_hand((50, 50))
    far = replace(truth, joints=np.add(truth.joints, [3.0, 0, 0]))
    assert score(far, truth).metrics()["EPE-p"] == pytest.approx(DIAGONAL)
    assert score(gone(truth), truth).metrics()["EPE-p"] == pytest.approx(DIAGONAL)
    behind = truth.joints.copy()
    behind[..., 2], behind[..., 0] = -5.0, 0.003  # drawn at depth 0.01: 100 * 0.3 px to the right
    assert score(replace(truth, joints=behind), truth).metrics()["EPE-p"] == pytest.approx(30)


def test_what_a_missed_hand_pays() -> None:
    truth = random_hands(np.random.default_rng(0), 1)
    R = rotvec_to_matrix(np.array([[[0, 0, 0.5], [0, 0, -0.25]]]))
    place = np.array([[[0.03, 0, 0.4], [0, 0.04, 0.3]]])
    joints = np.einsum("thij,hkj->thki", R, stand_in()) + place[:, :, None]
    truth = Hands(joints, R, place, np.ones((1, 2), bool))
    got = score(gone(truth), truth).metrics()
    turned = stand_in() - stand_in()[:, :1]
    far = [np.linalg.norm(turned[i] @ R[0, i].T - turned[i], axis=-1).mean() for i in (0, 1)]
    assert got["MPJPE-p"] == pytest.approx(1e3 * np.mean(far))
    assert got["PA-MPJPE-p"] == got["MPJPE-p"]
    assert got["GO-p"] == pytest.approx(np.degrees(0.375))
    length = (np.hypot(0.03, 0.4) + np.hypot(0.04, 0.3)) / 2
    for name in ("CT-p", "CT-along-p", "CT-lateral-p"):
        assert got[name] == pytest.approx(length)
    assert (got["Recall"], got["F1"], got["FAcc"]) == (0, 0, 0)
    assert isnan(got["Jitter"])


def test_translation_error_along_the_ray_and_across_it() -> None:
    truth = flat_hand((50, 50))
    place = np.array([[[0, 3.0, 4.0], [0, 0, 0]]])
    error = np.array([[[0.02, 0.06, 0.08], [0, 0, 0]]])
    truth = replace(truth, translation=place)
    got = score(replace(truth, translation=place - error), truth).metrics()
    assert got["CT-along-p"] == pytest.approx(0.1)
    assert got["CT-lateral-p"] == pytest.approx(0.02)
    assert got["CT-p"] == pytest.approx(sqrt(0.1**2 + 0.02**2))
    at_camera = replace(truth, translation=0 * place)
    got = score(replace(truth, translation=error), at_camera).metrics()
    assert got["CT-along-p"] == pytest.approx(0.08)  # along z


def test_jitter_counts_true_positives_in_a_row() -> None:
    truth = flat_hand((50, 50), frames=9)
    t = np.arange(9.0)[:, None, None, None]
    bent = replace(truth, joints=truth.joints + 0.5e-3 * t**2 * np.array([1.0, 0, 0]))
    got = score(bent, truth)
    assert got.jitter_count == 7
    assert got.metrics()["Jitter"] == pytest.approx(1.0)
    assert got.metrics()["Jitter-excess"] == pytest.approx(1.0)
    smooth = score(truth, bent).metrics()
    assert (smooth["Jitter"], smooth["Jitter-excess"]) == (0, pytest.approx(-1.0))
    holes = bent.present.copy()
    holes[[3, 6], 0] = False
    got = score(replace(bent, present=holes), truth)
    assert (got.jitter_count, got.fn) == (1, 2)  # only frames 0, 1, 2 are three in a row


def test_presence_counts() -> None:
    """Frames: hit; miss; false alarm; predicted off screen; rightly nothing."""
    truth = flat_hand((50, 50), frames=5)
    joints = truth.joints.copy()
    joints[3, 0] += [9.0, 0, 0]
    valid, said = truth.present.copy(), truth.present.copy()
    valid[[2, 4]] = False
    said[[1, 4]] = False
    truth = replace(truth, joints=joints, present=valid)
    got = score(replace(truth, present=said), truth)
    assert (got.tp, got.fn, got.fp, got.off_screen, got.off_screen_predicted) == (1, 1, 1, 1, 1)
    assert (got.facc_frames, got.facc_correct) == (2, 1)
    assert (got.negatives, got.negatives_predicted) == (8, 2)  # the right hand's five included
    metrics = got.metrics()
    assert metrics["F1"] == pytest.approx(2 / 4)
    assert metrics["Presence-BA"] == pytest.approx((1 / 2 + 6 / 8) / 2)


def test_always_present_satisfies_the_published_presence_only() -> None:
    truth = flat_hand((50, 50), frames=4)
    joints = truth.joints.copy()
    joints[:, 1] = joints[:, 0]
    joints[:2, 1] += [9.0, 0, 0]
    truth = replace(truth, joints=joints, present=np.ones((4, 2), bool))
    got = score(truth, truth).metrics()
    assert (got["FAcc"], got["Recall"], got["F1"]) == (1, 1, 1)
    assert got["Presence-BA"] == 0.5


def test_predicted_intrinsics_move_predicted_pixels() -> None:
    truth = flat_hand((60, 50))
    wide = K * np.array([[2.0, 1, 1], [1, 2, 1], [1, 1, 1]])
    assert score(truth, truth, predicted_K=wide).metrics()["EPE-p"] == pytest.approx(10)
    each_frame = score(truth, truth, predicted_K=wide[None])
    assert each_frame == score(truth, truth, predicted_K=wide)


def test_collapsed_prediction_counts_as_the_mean() -> None:
    truth = random_hands(np.random.default_rng(1), 1)
    joints = np.broadcast_to(np.array([0, 0, 0.4]), (1, 2, 21, 3))
    truth = replace(truth, joints=np.add(truth.joints, [0, 0, 2.0]), present=np.ones((1, 2), bool))
    got = score(replace(truth, joints=joints), truth)
    spread = truth.joints - truth.joints.mean(axis=2, keepdims=True)
    assert got.tp == 2
    assert got.pa_mpjpe_sum_mm == pytest.approx(1e3 * np.linalg.norm(spread, axis=-1).mean(2).sum())


# ---------------------------------------------------------------- laws


@laws
@given(seeds)
def test_perfect_prediction_is_ideal(seed: int) -> None:
    _, truth = random_pair(seed)
    statistics = score(truth, truth)
    got = statistics.metrics()
    assert statistics.jitter_sum_mm == statistics.true_jitter_sum_mm
    for measure in HAND_MEASURES:
        if measure.name not in ("Jitter", "Presence-BA") and not isnan(got[measure.name]):
            assert got[measure.name] == pytest.approx(measure.ideal, abs=2e-5), measure.name
    seen = replace(truth, present=present_mask(truth))
    if seen.present.any() and not seen.present.all():
        assert score(seen, truth).metrics()["Presence-BA"] == 1


def present_mask(truth: Hands) -> Any:
    """(T, 2) whether the true hand is present, joint by joint."""
    mask = np.zeros(truth.present.shape, bool)
    for at in np.argwhere(truth.present):
        for x, y, z in truth.joints[tuple(at)]:
            u, v = (100 * x / z + 50, 100 * y / z + 50) if z > 0.01 else (-1, -1)
            mask[tuple(at)] |= 0 <= u < 100 and 0 <= v < 100
    return mask


def plain_errors(predicted: Hands, truth: Hands, at: tuple[int, int]) -> dict[str, list[float]]:
    """[error, miss penalty] of one hand, written out."""
    p, g, c = (x - x[:1] for x in (predicted.joints[at], truth.joints[at], stand_in()[at[1]]))
    P, G = p - p.mean(0), g - g.mean(0)
    U, s, Vh = np.linalg.svd(G.T @ P)
    flip = np.diag([1, 1, np.linalg.det(U @ Vh)])
    R, scale = U @ flip @ Vh, (s * np.diag(flip)).sum() / (P * P).sum()

    def mean(a: Any, b: Any) -> float:
        return 1e3 * sum(sqrt(float(v @ v)) for v in a - b) / 21

    def angle(a: Any, b: Any) -> float:
        return float(np.degrees(np.arccos(np.clip((np.trace(a.T @ b) - 1) / 2, -1, 1))))

    o, place = truth.orientation[at], truth.translation[at]
    error, far = predicted.translation[at] - place, float(np.linalg.norm(place))
    along = abs(float(error @ place) / far)
    total = float(np.linalg.norm(error))
    return {
        "MPJPE-p": [mean(p, g), mean(c, g)],
        "PA-MPJPE-p": [mean(scale * P @ R.T, G), mean(c, g)],
        "GO-p": [angle(predicted.orientation[at], o), angle(np.eye(3), o)],
        "CT-p": [total, far],
        "CT-along-p": [along, far],
        "CT-lateral-p": [sqrt(max(total**2 - along**2, 0)), far],
    }


@laws
@given(seeds)
def test_vectorised_sums_equal_a_plain_loop(seed: int) -> None:
    predicted, truth = random_pair(seed)
    got, mask = score(predicted, truth), present_mask(truth)
    rows = [
        (plain_errors(predicted, truth, at), 0 if predicted.present[at] else 1)
        for at in zip(*np.nonzero(mask), strict=True)
    ]
    assert got.pose_count == len(rows)
    for name in POSE if rows else ():
        want = sum(errors[name][missed] for errors, missed in rows) / len(rows)
        assert got.metrics()[name] == pytest.approx(want, rel=1e-7, abs=2e-6), name


@laws
@given(seeds, st.data())
def test_dropping_a_hand_pays_only_where_it_was_worse_than_its_penalty(
    seed: int, data: st.DataObject
) -> None:
    predicted, truth = random_pair(seed)
    hits = np.argwhere(predicted.present & present_mask(truth))
    if not len(hits):
        return
    at = tuple(int(i) for i in data.draw(st.sampled_from(hits.tolist())))
    kept = predicted.present.copy()
    kept[at] = False
    before = score(predicted, truth).metrics()
    after = score(replace(predicted, present=kept), truth).metrics()
    assert after["Recall"] < before["Recall"]
    assert after["F1"] < before["F1"]
    assert after["FAcc"] <= before["FAcc"]
    assert after["Presence-BA"] < before["Presence-BA"] or isnan(before["Presence-BA"])
    assert after["EPE-p"] >= before["EPE-p"] - 1e-12
    for name, (error, penalty) in plain_errors(predicted, truth, (at[0], at[1])).items():
        if abs(error - penalty) > 1e-4 * penalty:
            assert (after[name] < before[name]) == (error > penalty), name


@laws
@given(seeds)
def test_clips_add_up_however_they_are_dealt_out(seed: int) -> None:
    rng = np.random.default_rng(seed)
    clips = [score(*random_pair(seed + i, frames=5)) for i in range(6)]
    whole = sum(clips, HandStatistics())
    shuffled = [clips[i] for i in rng.permutation(6)]
    cut = int(rng.integers(0, 7))
    shards = [sum(part, HandStatistics()) for part in (shuffled[:cut], shuffled[cut:])]
    again = [HandStatistics.from_dict(json.loads(json.dumps(s.to_dict()))) for s in shards]
    assert again == shards
    assert sum(again, HandStatistics()).to_dict() == pytest.approx(whole.to_dict(), rel=1e-12)


@laws
@given(seeds)
def test_strata_add_up_but_for_facc(seed: int) -> None:
    predicted, truth = random_pair(seed)
    part = np.random.default_rng(seed).random((12, 2)) < 0.5
    whole = score(predicted, truth).to_dict()
    parts = (score(predicted, truth, only=part) + score(predicted, truth, only=~part)).to_dict()
    for name in whole:
        if not name.startswith("facc"):
            assert parts[name] == pytest.approx(whole[name], rel=1e-12), name


@laws
@given(seeds)
def test_left_and_right_are_treated_alike(seed: int) -> None:
    pair = random_pair(seed)
    swapped = [
        Hands(*(x[:, ::-1] for x in (h.joints, h.orientation, h.translation, h.present)))
        for h in pair
    ]
    other = score(swapped[0], swapped[1], canonical=stand_in()[::-1])
    assert other.to_dict() == pytest.approx(score(*pair).to_dict(), rel=1e-12)


@laws
@given(seeds)
def test_what_is_not_present_is_not_read(seed: int) -> None:
    predicted, truth = random_pair(seed)
    hidden = []
    for hands in (predicted, truth):
        parts = [np.array(x) for x in (hands.joints, hands.orientation, hands.translation)]
        for part in parts:
            part[~hands.present] = np.nan
        hidden.append(Hands(*parts, hands.present))
    assert score(*hidden) == score(predicted, truth)


# ---------------------------------------------------------------- inputs


def test_from_state_reads_the_hand_state() -> None:
    state = hs.absent((3, 2)).astype(np.float64)
    state[..., hs.TRANSLATION] = [0.1, 0.2, 0.5]
    present = np.ones((3, 2), bool)
    present[1, 0] = False
    state[1, 0] = np.nan
    hands = Hands.from_state(state, present)
    np.testing.assert_array_equal(hands.present, present)
    np.testing.assert_allclose(hands.translation[0, 0], [0.1, 0.2, 0.5])
    np.testing.assert_allclose(hands.joints[2], stand_in() + np.array([0.1, 0.2, 0.5]), atol=1e-12)
    assert np.isfinite(hands.joints).all()
    with pytest.raises(ValueError, match="present: expected booleans"):
        Hands.from_state(state, present.astype(float))


def test_no_present_hand_is_nan() -> None:
    truth = flat_hand((500, 50), frames=3)
    metrics = score(gone(truth), truth).metrics()
    assert set(metrics) == {m.name for m in HAND_MEASURES}
    assert all(isnan(value) for value in metrics.values())
    assert score(gone(truth), gone(truth)).to_dict()["negatives"] == 6
    alarm = score(truth, gone(truth)).metrics()
    assert alarm["F1"] == 0
    assert isnan(alarm["MPJPE-p"])
    assert all(isnan(value) for value in HandStatistics().metrics().values())


def test_columns_of_tables_know_their_measure() -> None:
    for name in ("RPE-T mean", "RPE-T, Sim(3) mean", "RPE-T 1 s median", "ATE 10 min mean"):
        assert measure_of(name).title == f"{name} (mm)"
        assert measure_of(name).ideal == 0
    assert measure_of("EPE-p, known") == Measure("EPE-p, known", "px", 0.0)
    assert measure_of("FAcc").title == "FAcc"
    assert measure_of("Field of view error").unit == "deg"
    assert measure_of("Arc-length ratio (predicted / true) mean").ideal == 1
    assert measure_of("Arc-length ratio (direction disputed)").ideal is None


def test_bad_input_is_named() -> None:
    predicted, truth = random_pair(3)
    short = Hands(truth.joints[:-1], truth.orientation, truth.translation, truth.present[:-1])
    holes = {"joints": np.full(truth.joints.shape, np.nan)}
    everywhere = {"present": np.ones((12, 2), bool)}
    cases: list[tuple[str, dict[str, Any]]] = [
        (r"predicted.present: expected .* \(11, 2\), got bool of \(12, 2\)", {"truth": short}),
        (r"truth.joints: expected shape \(12,", {"truth": replace(truth, joints=short.joints)}),
        (r"predicted.joints: expected finite", {"predicted": replace(predicted, **holes)}),
        (r"truth.joints: expected finite", {"truth": replace(truth, **holes, **everywhere)}),
        (r"present: expected bool", {"predicted": replace(predicted, present=np.ones((12, 2)))}),
        (r"K: expected", {"K": K[:2]}),
        (r"predicted_K: expected", {"predicted_K": np.nan * K}),
        (r"image_size_hw", {"image_size_hw": (0, 3)}),
        (r"canonical: expected shape", {"canonical": stand_in()[0]}),
        (r"canonical: expected finite", {"canonical": np.nan * stand_in()}),
        (r"only: expected booleans", {"only": np.ones((12, 2))}),
    ]
    good = {"predicted": predicted, "truth": truth, "K": K, "image_size_hw": SIZE_HW}
    for message, changed in cases:
        with pytest.raises(ValueError, match=message):
            hand_statistics(**{**good, "canonical": stand_in(), **changed})
    values = HandStatistics().to_dict()
    del values["tp"]
    with pytest.raises(ValueError, match=r"missing \['tp'\] and unknown \['x'\]"):
        HandStatistics.from_dict({**values, "x": 0})


def test_clips_without_a_frame_are_refused() -> None:
    none = random_hands(np.random.default_rng(0), 0)
    with pytest.raises(ValueError, match=r"truth\.present: expected .* at least one frame"):
        score(none, none)
    with pytest.raises(ValueError, match=r"truth\.present: expected .* at least one frame"):
        present_hands(none, np.eye(3), (10, 10))
