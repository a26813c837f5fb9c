"""Smoothing: our closed recursion over time against a plain sigma-point filter a channel.

    python benchmarks/smoothing.py

The plain filter is what one writes from a textbook: for every hand, channel and frame it draws five
sigma points, carries them through the motion model, and goes back over the clip. It runs on a short
clip, where it also checks that both give the same numbers; its time grows linearly with frames.
"""

from typing import Any

import numpy as np
from _report import seconds, write_report

from mint_hub.geometry import hand_state as hands
from mint_hub.geometry import rotations
from mint_hub.geometry.smoothing import SmoothingSettings, smooth_hands

FRAMES, FEW_FRAMES, SEED = 10_000, 60, 0
SETTINGS = SmoothingSettings(b=0.0)  # constant trust: the plain filter below leaves the speed out


def make_clip(num_frames: int) -> tuple[np.ndarray, np.ndarray]:
    """Make a noisy clip (T, 2, 109) float64 and its presence (T, 2), nine frames of ten."""
    rng = np.random.default_rng(SEED)
    t = np.arange(num_frames)[:, None, None] / 30.0

    def wave(size: int) -> np.ndarray:
        phase, rate = rng.uniform(0, 6, (2, size)), rng.uniform(0.5, 2, (2, size))
        clean = 0.3 * np.sin(rate * t + phase)
        return clean + 0.01 * rng.standard_normal(clean.shape)

    joints = rotations.rotvec_to_matrix(wave(45).reshape(num_frames, 2, 15, 3))
    orientation = rotations.rotvec_to_matrix(3 * wave(3))
    state = hands.HandState.from_matrices(wave(3), orientation, joints, wave(10))
    return np.asarray(state.pack()), rng.random((num_frames, 2)) < 0.9


def plain_channels(state: np.ndarray) -> np.ndarray:
    """(n, 109) -> (n, 62) scalar channels."""
    hand = hands.unpack(state)
    quat = rotations.continuous_quat_xyzw(rotations.matrix_to_quat_xyzw(hand.orientation()))
    rotvec = rotations.matrix_to_rotvec(hand.joint_rotations()).reshape(len(state), -1)
    return np.concatenate([hand.translation, quat, rotvec, hand.shape_params], axis=-1)


def plain_ukf(z: np.ndarray, frames: np.ndarray) -> np.ndarray:
    """One channel: unscented Kalman filter (alpha 1, beta 2, kappa 1) and its smoother."""
    bend = np.diff(z, 2)
    sigma = max(1.4826 * np.median(np.abs(bend - np.median(bend))) / np.sqrt(6), 1e-6)
    R, q2 = (SETTINGS.r * sigma) ** 2, (SETTINGS.q * sigma) ** 2
    mean_weights = np.array([1 / 3] + 4 * [1 / 6])
    cov_weights = mean_weights + np.array([2.0, 0, 0, 0, 0])
    x, P = np.array([z[0], 0.0]), np.diag([R, np.var(np.diff(z))])
    xs, Ps = [x], [P]

    def predict(x: np.ndarray, P: np.ndarray, dt: float) -> tuple[np.ndarray, ...]:
        root = np.linalg.cholesky(3 * P)
        points = np.stack([x, *(x + root.T), *(x - root.T)])
        moved = points @ np.array([[1.0, 0.0], [dt, 1.0]])
        mean = mean_weights @ moved
        Q = q2 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
        cov = (cov_weights[:, None] * (moved - mean)).T @ (moved - mean) + Q
        cross = (cov_weights[:, None] * (points - x)).T @ (moved - mean)
        return mean, cov, cross

    for k in range(1, len(z)):
        mean, cov, _ = predict(x, P, float(frames[k] - frames[k - 1]))
        root = np.linalg.cholesky(3 * cov)
        points = np.stack([mean, *(mean + root.T), *(mean - root.T)])
        seen = points[:, 0]
        expected = mean_weights @ seen
        variance = cov_weights @ (seen - expected) ** 2 + R
        gain = (cov_weights * (seen - expected)) @ (points - mean) / variance
        x, P = mean + gain * (z[k] - expected), cov - variance * np.outer(gain, gain)
        xs.append(x)
        Ps.append(P)
    for k in range(len(z) - 2, -1, -1):
        mean, cov, cross = predict(xs[k], Ps[k], float(frames[k + 1] - frames[k]))
        xs[k] = xs[k] + cross @ np.linalg.inv(cov) @ (xs[k + 1] - mean)
    return np.array(xs)[:, 0]


def plain_smooth(clip: np.ndarray, presence: np.ndarray) -> np.ndarray:
    """Smooth translations and shapes (T, 2, 13); the other channels only cost their time."""
    out = np.concatenate([clip[..., hands.TRANSLATION], clip[..., hands.SHAPE]], axis=-1)
    for side in (0, 1):
        frames = np.flatnonzero(presence[:, side])
        channels = plain_channels(clip[frames, side])
        smoothed = np.stack([plain_ukf(z, frames) for z in channels.T], axis=-1)
        out[frames, side] = np.concatenate([smoothed[:, :3], smoothed[:, 52:]], axis=-1)
    return out


def main() -> None:
    clip, presence = make_clip(FRAMES)
    few, few_presence = make_clip(FEW_FRAMES)
    ours = smooth_hands(few, few_presence, SETTINGS)
    linear = np.concatenate([ours[..., hands.TRANSLATION], ours[..., hands.SHAPE]], axis=-1)
    difference = float(np.abs(linear - plain_smooth(few, few_presence)).max())
    batch = np.stack([clip[:300]] * 32), np.stack([presence[:300]] * 32)
    measured: dict[str, Any] = {
        "ms_a_frame": 1e3 * seconds(lambda: smooth_hands(clip, presence)) / FRAMES,
        "ms_a_frame_forward_only": 1e3
        * seconds(lambda: smooth_hands(clip, presence, SmoothingSettings(rts=False)))
        / FRAMES,
        "ms_a_frame_batch_of_32_clips": 1e3 * seconds(lambda: smooth_hands(*batch)) / (32 * 300),
        "ms_a_frame_plain_sigma_points": 1e3
        * seconds(lambda: plain_smooth(few, few_presence), repeats=3)
        / FEW_FRAMES,
        "largest_difference_from_plain": difference,
    }
    measured["times_faster"] = measured["ms_a_frame_plain_sigma_points"] / measured["ms_a_frame"]
    settings = {
        "frames": FRAMES,
        "hands": 2,
        "batch": "32 clips of 300 frames",
        "frames_plain": FEW_FRAMES,
        "seed": SEED,
        "time": "median of 5 runs (plain: 3) after one to warm up",
    }
    path = write_report("smoothing", measured, settings)
    for name, value in measured.items():
        print(f"{name:34} {value:.4g}")
    print(path)


if __name__ == "__main__":
    main()
