"""Laws of the smoother: it equals the unscented filter, and leaves alone what is not there."""

from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load_file

from mint_hub.geometry import hand_state as hands
from mint_hub.geometry import rotations
from mint_hub.geometry.smoothing import MIN_FRAMES, SmoothingSettings, smooth_hands

FORWARD = SmoothingSettings(rts=False)


def make_clip(num_frames: int, noise: float, seed: int) -> np.ndarray:
    """(T, 2, 109) float64: slow sinusoids in every channel, plus white noise."""
    rng = np.random.default_rng(seed)
    t = np.arange(num_frames)[:, None, None] / 30.0

    def wave(size: int, scale: float) -> np.ndarray:
        phase, rate = rng.uniform(0, 6, (2, size)), rng.uniform(0.5, 2, (2, size))
        clean = scale * np.sin(rate * t + phase)
        return clean + noise * rng.standard_normal(clean.shape)

    joints = wave(45, 0.4).reshape(num_frames, 2, 15, 3)
    state = hands.HandState.from_matrices(
        wave(3, 0.1) + np.array([0.0, 0.0, 0.4]),
        rotations.rotvec_to_matrix(wave(3, 1.5)),
        rotations.rotvec_to_matrix(joints),
        wave(10, 0.5),
    )
    return np.asarray(state.pack())


def gaps(num_frames: int, seed: int) -> np.ndarray:
    return np.random.default_rng(seed).random((num_frames, 2)) < 0.8


@pytest.mark.parametrize(
    ("name", "settings"),
    [
        ("smoothed_default", SmoothingSettings()),
        (
            "smoothed_q0.3_r1.2_beta1_forward_only",
            SmoothingSettings(q=0.3, r=1.2, b=1.0, rts=False),
        ),
    ],
)
def test_golden(golden_dir: Path, name: str, settings: SmoothingSettings):
    golden = load_file(golden_dir / "smoothing.safetensors")
    hand = golden["hand"].reshape(-1, 2, 109)
    got = smooth_hands(hand, golden["valid"].astype(bool), settings)
    assert got.dtype == np.float32
    assert np.abs(golden[name] - golden["hand"]).max() > 0.01
    np.testing.assert_allclose(got.reshape(len(hand), -1), golden[name], rtol=0, atol=1e-5)


def sigma_point_smoother(z: np.ndarray, frames: np.ndarray, settings: SmoothingSettings):
    """One channel, drawn out with sigma points and extended precision; wrist at constant trust."""
    z = z.astype(np.longdouble)
    spread = np.diff(z, 2)
    sigma = 1.4826 * np.median(np.abs(spread - np.median(spread))) / np.sqrt(6)
    sigma = max(sigma, np.longdouble(1e-6))
    r, q = (settings.r * sigma) ** 2, (settings.q * sigma) ** 2
    weights = np.array([1 / 3, 1 / 6, 1 / 6, 1 / 6, 1 / 6], np.longdouble)
    centre_weight = weights + np.array([2, 0, 0, 0, 0])

    def points(mean: np.ndarray, cov: np.ndarray) -> np.ndarray:
        a = np.sqrt(cov[0, 0])
        root = np.array([[a, 0], [cov[0, 1] / a, 0]])
        root[1, 1] = np.sqrt(max(cov[1, 1] - root[1, 0] ** 2, 0))
        root = root * np.sqrt(np.longdouble(3))
        return np.concatenate([mean[None], mean + root.T, mean - root.T])

    mean = np.array([z[0], 0])
    cov = np.diag([r, np.var(np.diff(z))])
    means, covs, gains, predictions = [mean], [cov], [], []
    for k in range(1, len(z)):
        dt = np.longdouble(frames[k] - frames[k - 1])
        before = points(mean, cov)
        after = np.stack([before[:, 0] + dt * before[:, 1], before[:, 1]], -1)
        pred = weights @ after
        P = (after - pred).T @ (centre_weight[:, None] * (after - pred))
        P = P + q * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
        cross = (before - mean).T @ (centre_weight[:, None] * (after - pred))
        inverse = np.array([[P[1, 1], -P[0, 1]], [-P[1, 0], P[0, 0]]])
        gains.append(cross @ inverse / (P[0, 0] * P[1, 1] - P[0, 1] ** 2))
        predictions.append(pred)
        K = P[:, 0] / (P[0, 0] + r)
        mean = pred + K * (z[k] - pred[0])
        cov = P - np.outer(K, P[0])
        means.append(mean)
        covs.append(cov)
    if settings.rts:
        for k in range(len(z) - 2, -1, -1):
            means[k] = means[k] + gains[k] @ (means[k + 1] - predictions[k])
    return np.array(means)[:, 0].astype(float)


@pytest.mark.parametrize("settings", [SmoothingSettings(b=0), SmoothingSettings(2, 0.1, 0, False)])
@pytest.mark.parametrize("kind", ["noisy", "one jump"])
def test_equals_the_sigma_point_filter(settings: SmoothingSettings, kind: str):
    """For a linear system the unscented transform is exact, so closed form and points agree."""
    clip, present = make_clip(90, 0.02, seed=1), gaps(90, seed=2)
    if kind == "one jump":  # sigma is at its floor, a million times below the step
        clip[..., hands.SHAPE] = (np.arange(90) > 40)[:, None, None]
    got = smooth_hands(clip, present, settings)
    for side in (0, 1):
        frames = np.flatnonzero(present[:, side])
        for channel in (*range(3), *range(hands.SHAPE.start, hands.SHAPE.stop)):
            want = sigma_point_smoother(clip[frames, side, channel], frames, settings)
            np.testing.assert_allclose(got[frames, side, channel], want, rtol=0, atol=1e-9)


def test_absent_frames_and_short_hands_come_back_untouched():
    clip, present = make_clip(40, 0.05, seed=3), gaps(40, seed=4)
    present[:, 1] = False
    present[[3, 9, 30], 1] = True
    assert present[:, 1].sum() == MIN_FRAMES - 1
    clip[~present] = np.nan
    got = smooth_hands(clip, present)
    np.testing.assert_array_equal(got[~present], clip[~present])
    np.testing.assert_array_equal(got[:, 1], clip[:, 1])
    assert (np.abs(got - clip)[present[:, 0], 0].max(axis=-1) > 1e-4).all()


def test_rotations_stay_rotations():
    clip, present = make_clip(60, 0.3, seed=5), gaps(60, seed=6)
    state = hands.unpack(smooth_hands(clip, present)[present])
    for rows in (state.orientation_rot6d_rows, state.joint_rot6d_rows):
        rows = np.asarray(rows).reshape(-1, 2, 3)
        np.testing.assert_allclose(
            rows @ np.swapaxes(rows, -1, -2),
            np.broadcast_to(np.eye(2), (len(rows), 2, 2)),
            atol=1e-12,
        )


def test_clips_and_hands_do_not_touch_each_other():
    clips = np.stack([make_clip(50, 0.03, seed=s) for s in range(6)])
    present = np.stack([gaps(50, seed=s) for s in range(6)])
    present[1, 10:] = False  # sequences of very different lengths share one recursion
    present[2, :, 0] = False
    alone = np.stack([smooth_hands(c, p) for c, p in zip(clips, present, strict=True)])
    shaped = smooth_hands(clips.reshape(2, 3, 50, 2, 109), present.reshape(2, 3, 50, 2))
    np.testing.assert_allclose(shaped.reshape(alone.shape), alone, rtol=0, atol=1e-12)
    swapped = smooth_hands(clips[:, :, ::-1], present[:, :, ::-1])[:, :, ::-1]
    np.testing.assert_allclose(swapped, alone, rtol=0, atol=1e-12)


@pytest.mark.parametrize("seed", range(5))
def test_noise_goes_down_and_the_backward_pass_helps(seed: int):
    clean, noisy = make_clip(300, 0.0, seed), make_clip(300, 0.01, seed)
    present = gaps(300, seed)

    def error(state: np.ndarray) -> float:
        return float(np.sqrt(np.mean((state - clean)[present] ** 2)))

    both = error(smooth_hands(noisy, present))
    assert both < 0.8 * error(noisy)
    assert both < error(smooth_hands(noisy, present, FORWARD))


def test_steady_motion_comes_back():
    """Without noise sigma is at its floor, and a straight track with gaps is its own estimate."""
    clip = np.asarray(hands.absent((80, 2))).astype(float)
    t = np.arange(80.0)[:, None, None]
    clip[..., hands.TRANSLATION] = [0.1, -0.2, 0.5] + t * [[0.002, 0.0, -0.001], [0.0, 0.003, 0.0]]
    got = smooth_hands(clip, gaps(80, 7))
    np.testing.assert_allclose(got, clip, rtol=0, atol=1e-6)


def test_where_the_world_lies_does_not_matter():
    clip, present = make_clip(60, 0.02, seed=8), gaps(60, seed=8)
    moved = clip.copy()
    moved[..., hands.TRANSLATION] += [3.0, -2.0, 1.0]
    got = smooth_hands(moved, present)
    got[..., hands.TRANSLATION][present] -= [3.0, -2.0, 1.0]
    got[~present] = clip[~present]
    np.testing.assert_allclose(got, smooth_hands(clip, present), rtol=0, atol=1e-9)


def test_fast_wrists_are_trusted_less():
    clip = make_clip(200, 0.01, seed=9)
    clip[100:110, :, 0] += np.linspace(0, 1, 10)[:, None]
    clip[110:, :, 0] += 1.0
    everywhere = np.ones((200, 2), bool)
    moved = [
        np.abs(smooth_hands(clip, everywhere, SmoothingSettings(b=b)) - clip)[100:110].mean()
        for b in (0.0, 2.0)
    ]
    assert moved[0] < moved[1]


def test_a_wrist_at_rest_keeps_full_trust():
    clip, everywhere = make_clip(50, 0.01, seed=10), np.ones((50, 2), bool)
    clip[..., hands.TRANSLATION] = [0.0, 0.0, 0.4]
    np.testing.assert_array_equal(
        smooth_hands(clip, everywhere), smooth_hands(clip, everywhere, SmoothingSettings(b=0))
    )


def test_the_empty_clip():
    empty = smooth_hands(np.zeros((0, 2, 109), np.float32), np.zeros((0, 2), bool))
    assert empty.shape == (0, 2, 109)


def test_errors_teach():
    clip, present = make_clip(10, 0.0, 0), np.ones((10, 2), bool)
    with pytest.raises(ValueError, match=r"hand_state: expected \(\.\.\., T, 2, 109\)"):
        smooth_hands(clip.reshape(10, 218), present)
    with pytest.raises(ValueError, match=r"presence: expected \(10, 2\), got \(9, 2\)"):
        smooth_hands(clip, present[:9])
    with pytest.raises(ValueError, match="floats"):
        smooth_hands(np.zeros((10, 2, 109), int), present)
    clip[4, 1, 7] = np.nan
    with pytest.raises(ValueError, match="finite"):
        smooth_hands(clip, present)
    for wrong in ({"q": 0.0}, {"r": -1.0}, {"b": -0.1}, {"q": np.inf}):
        with pytest.raises(ValueError, match=f"SmoothingSettings.{next(iter(wrong))}"):
            SmoothingSettings(**wrong)
