"""What tells metres: parsing, lengths, depth, hands."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from mint_hub.labelling.stages import scale_evidence as evidence
from tests.labelling import sfm_scenes as scenes


def plane(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Random pixels and the depths of the plane there."""
    rng = np.random.default_rng(seed)
    uv = rng.uniform([0, 0], scenes.SIZE_HW[::-1], (count, 2))
    return uv, scenes.on_plane(uv, np.eye(4))[:, 2]


def test_lengths_in_several_units() -> None:
    for text in ("0.42m:1,2-30,40@5", "42cm:1,2-30,40@5s", " 420 mm : 1,2 - 30,40 @ 5.0 "):
        got = evidence.parse_scale(text)
        assert isinstance(got, evidence.KnownLength)
        assert got.metres == pytest.approx(0.42)
        assert (got.first_uv, got.second_uv, got.time_s) == ((1, 2), (30, 40), 5)


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("", "expected a factor"),
        ("0.42", None),
        ("0", "positive factor"),
        ("-1", "expected a factor"),
        ("0.42m", "expected a factor"),
        ("0.42ft:1,2-3,4@5", "expected a factor"),
        ("0.42m:1,2-3,4", "expected a factor"),
        ("0m:1,2-30,4@5", "positive length"),
        ("1m:1,2-1,2@5", "two pixels"),
        ("nan", "expected a factor"),
    ],
)
def test_errors_teach_the_syntax(text: str, match: str | None) -> None:
    if match is None:
        assert isinstance(evidence.parse_scale(text), evidence.GivenFactor)
        return
    with pytest.raises(ValueError, match=match) as caught:
        evidence.parse_scale(text)
    assert repr(text) in str(caught.value)


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 1000), st.floats(0.1, 10))
def test_a_length_on_a_plane_gives_the_scale(seed: int, factor: float) -> None:
    uv, depth = plane(300, seed)
    ends = np.random.default_rng(seed).uniform([60, 60], [260, 180], (2, 2))
    ends[1] += 25 * np.sign(ends[1] - ends[0])
    points = scenes.on_plane(ends, np.eye(4))
    metres = factor * float(np.linalg.norm(points[0] - points[1]))
    pair = (tuple(ends[0]), tuple(ends[1]))
    got = evidence.scale_from_length(metres, pair, uv, depth, scenes.K, scenes.SIZE_HW)
    assert got.metres_per_unit == pytest.approx(factor, rel=0.01)
    assert 0 < got.log_sigma < 0.2


def test_depth_at_a_pixel_survives_wrong_neighbours() -> None:
    uv, depth = plane(200)
    truth = scenes.on_plane(np.array([[160.0, 120.0]]), np.eye(4))[0, 2]
    near = np.argsort(np.linalg.norm(uv - [160, 120], axis=1))
    depth[near[[1, 4, 7]]] *= 1.5
    got, sigma = evidence.depth_at((160.0, 120.0), uv, depth, scenes.SIZE_HW)
    assert got == pytest.approx(truth, rel=0.02)
    assert sigma < 0.05


def test_no_points_near_an_end_is_told() -> None:
    uv, depth = plane(200)
    left = uv[:, 0] < 100
    with pytest.raises(ValueError, match=r"map points near pixel \(300, 100\), got 0"):
        evidence.depth_at((300.0, 100.0), uv[left], depth[left], scenes.SIZE_HW)


def test_metric_depth_gives_the_scale_and_invalid_depth_says_nothing() -> None:
    uv, depth = plane(400)
    v, u = np.mgrid[0:120, 0:160]
    pixels = np.column_stack([u.ravel() * 2 + 1.0, v.ravel() * 2 + 1.0])
    metric = 0.6 * scenes.on_plane(pixels, np.eye(4))[:, 2].reshape(120, 160)
    metric[:, :60] = 0.0
    metric[:30] = np.nan
    metric[100:] = np.inf
    ratios = evidence.depth_ratios(uv, depth, metric, scenes.SIZE_HW)
    assert 100 < len(ratios) < 400
    got = evidence.scale_from_ratios([ratios], evidence.DEPTH_SIGMA)
    assert got is not None
    assert got.metres_per_unit == pytest.approx(0.6, rel=0.01)
    metric[:] = 0
    assert not len(evidence.depth_ratios(uv, depth, metric, scenes.SIZE_HW))


def test_frames_vote_by_median_and_disagreement_widens() -> None:
    good, wrong = np.full(20, 0.5), np.full(20, 5.0)
    agree = evidence.scale_from_ratios([good] * 6, 0.05)
    differ = evidence.scale_from_ratios([good, good * 1.2, good * 0.8, good, wrong], 0.05)
    assert agree is not None
    assert differ is not None
    assert agree.metres_per_unit == pytest.approx(0.5)
    assert differ.metres_per_unit == pytest.approx(0.5)
    assert agree.log_sigma == pytest.approx(0.05)
    assert differ.log_sigma > agree.log_sigma
    bound = evidence.scale_from_ratios([good, good * 1.2, good * 0.8, good], 0.05, quantile=1.0)
    assert bound is not None
    assert bound.metres_per_unit == pytest.approx(0.6)
    assert evidence.scale_from_ratios([good[:3]], 0.05) is None
    assert evidence.scale_from_ratios([good] * 2, 0.05, min_frames=3) is None


def test_a_hand_at_the_surface_around_it_gives_the_scale() -> None:
    uv, depth = plane(2000)
    far = uv[:, 0] < 150  # half of what is around the hand is the far end of the room
    depth = np.where(far, depth * 6, depth)
    hand = np.random.default_rng(0).uniform([130, 90], [190, 150], (21, 2))
    surface = scenes.on_plane(np.array([[170.0, 120.0]]), np.eye(4))[0, 2]
    ratios = evidence.hand_ratios(hand, 0.7 * surface, uv, depth)
    got = evidence.scale_from_ratios([ratios], evidence.HAND_SIGMA)
    assert got is not None
    assert math.log(got.metres_per_unit / 0.7) == pytest.approx(0, abs=0.15)
    nowhere = evidence.hand_ratios(hand + 5000, 0.7, uv, depth)
    assert not len(nowhere)


@pytest.mark.parametrize("seed", range(4))
def test_how_far_a_hand_is_follows_from_how_large_it_looks(seed: int) -> None:
    rng = np.random.default_rng(seed)
    hand = rng.normal(0, 0.05, (21, 3))
    R = Rotation.random(random_state=seed).as_matrix()
    camera = hand @ R.T + [0.05, -0.03, 0.45]
    uv = camera[:, :2] / camera[:, 2:] * scenes.FOCAL + scenes.K[:2, 2]
    got = evidence.hand_depth(uv, hand, scenes.K)
    assert got == pytest.approx(float(np.median(camera[:, 2])), rel=1e-3)
    assert evidence.hand_depth(np.full((21, 2), np.nan), hand, scenes.K) is None
