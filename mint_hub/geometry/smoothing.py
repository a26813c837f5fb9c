"""Smoothing of hand trajectories: a constant-velocity Kalman filter and its RTS backward pass.

The method is the unscented Kalman filter (alpha 1, beta 2, kappa 1) of the MINT paper's "+ UKF",
per scalar channel of a hand: wrist position 3, wrist quaternion 4, joint rotation vectors 45,
shape 10. Motion [x, v] -> [x + dt v, v] and measurement x are both linear, and for linear functions
the unscented transform returns mean and covariance exactly, whatever its parameters (Julier &
Uhlmann 1997, section 3). So filter and smoother *are* the Kalman filter and the Rauch-Tung-Striebel
smoother, and here they are computed as such: a closed 2 x 2 recursion that runs over time only, for
every channel, hand and clip at once.

Legend: N steps, S sequences (one hand of one clip, its present frames in order), C = 62 channels.
"""

import math
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mint_hub.geometry import hand_state as hands
from mint_hub.geometry import rotations

Float = NDArray[np.float64]

MIN_FRAMES: Final = 4
"""A hand present in fewer frames than this is returned as it came."""

_MAD_TO_SIGMA: Final = 1.4826
_SIGMA_FLOOR: Final = 1e-6
_SPEED_BOX: Final = 5
_IGNORED: Final = 1e200  # measurement variance of the steps that pad a short sequence
_FRAMES_AT_ONCE: Final = 32768  # N * S filtered together: bounds the memory, about 250 MB


@dataclass(frozen=True)
class SmoothingSettings:
    """How strongly, and whether backward as well.

    Attributes:
        q: process noise, as a multiple of the measured noise of a channel; > 0.
        r: measurement noise, as a multiple of the same; > 0.
        b: how much less the measurements of a fast-moving wrist are trusted; >= 0.
        rts: run the backward pass, so that every frame sees the whole clip.

    Raises:
        ValueError: a number outside its range.

    """

    q: float = 0.6
    r: float = 0.6
    b: float = 2.0
    rts: bool = True

    def __post_init__(self) -> None:
        for name, value, fits in (
            ("q", self.q, self.q > 0),
            ("r", self.r, self.r > 0),
            ("b", self.b, self.b >= 0),
        ):
            if not (fits and np.isfinite(value)):
                raise ValueError(
                    f"SmoothingSettings.{name}: expected a finite number "
                    f"{'>= 0' if name == 'b' else '> 0'}, got {value}"
                )


def smooth_hands(
    hand_state: np.ndarray,
    presence: np.ndarray,
    settings: SmoothingSettings | None = None,
) -> np.ndarray:
    """Smooth both hands of a clip, or of a batch of clips.

    The present frames of a hand form one sequence across gaps, with time in frames. Absent frames,
    and hands present in fewer than MIN_FRAMES frames, come back untouched; all others are valid
    states, their 6D rows orthonormal. Clips and hands do not influence each other.

    Args:
        hand_state: (..., T, 2, 109) numpy array of floats, left hand first, in one fixed frame.
        presence: (..., T, 2) bool, True where the hand is there.
        settings: the defaults are the paper's.

    Returns:
        An array like ``hand_state``, same dtype; computed in float64.

    Raises:
        ValueError: shapes that do not fit, no floats; in a present frame, non-finite numbers or
            a degenerate 6D row.

    """
    settings = settings or SmoothingSettings()
    state, present = np.asarray(hand_state), np.asarray(presence, dtype=bool)
    if state.ndim < 3 or state.shape[-2:] != (2, hands.HAND_STATE_SIZE):
        raise ValueError(
            f"hand_state: expected (..., T, 2, {hands.HAND_STATE_SIZE}), got {state.shape}"
        )
    if not np.issubdtype(state.dtype, np.floating):
        raise ValueError(f"hand_state: expected floats, got {state.dtype}")
    if present.shape != state.shape[:-1]:
        raise ValueError(f"presence: expected {state.shape[:-1]}, got {present.shape}")
    if not np.isfinite(state[present]).all():
        raise ValueError("hand_state: expected finite numbers in present frames")

    smoothed = np.swapaxes(state, -2, -3).copy()  # (..., 2, T, 109)
    num_frames = state.shape[-3]
    flat = smoothed.reshape(math.prod(smoothed.shape[:-2]), num_frames, hands.HAND_STATE_SIZE)
    frames = [np.flatnonzero(row) for row in np.swapaxes(present, -1, -2).reshape(flat.shape[:2])]
    long_enough = [i for i, row in enumerate(frames) if len(row) >= MIN_FRAMES]
    group = max(1, _FRAMES_AT_ONCE // max(1, num_frames))
    for start in range(0, len(long_enough), group):
        members = long_enough[start : start + group]
        tracks = [_Track.measure(flat[i, frames[i]], frames[i], settings.b) for i in members]
        for i, values in zip(members, _smooth_tracks(tracks, settings), strict=True):
            flat[i, frames[i]] = _state_from_channels(values)
    return np.ascontiguousarray(np.swapaxes(smoothed, -2, -3))


class _Track(NamedTuple):
    """One hand's present frames, as the filter sees them."""

    channels: Float  # (n, C)
    dt: Float  # (n - 1,) frames
    sigma: Float  # (C,) measured noise
    distrust: Float  # (n,) factor on the measurement variance
    step_variance: Float  # (C,) of the first differences

    @staticmethod
    def measure(state: np.ndarray, frames: NDArray[np.int64], b: float) -> "_Track":
        """From (n, 109) states at (n,) frame numbers."""
        channels = _channels_from_state(state)
        dt = np.diff(frames).astype(np.float64)
        bend = np.diff(channels, 2, axis=0)
        spread = np.median(np.abs(bend - np.median(bend, axis=0)), axis=0)
        # White noise of deviation s has second differences of deviation sqrt(1 + 4 + 1) s.
        sigma = np.maximum(_MAD_TO_SIGMA * spread / np.sqrt(6.0), _SIGMA_FLOOR)
        step_variance = np.var(np.diff(channels, axis=0), axis=0)
        return _Track(channels, dt, sigma, _distrust(channels[:, :3], dt, b), step_variance)


def _distrust(wrist: Float, dt: Float, b: float) -> Float:
    """(n,) factors >= 1 on the measurement variance: (1 + b max(speed / median - 1, 0))^2.

    ``wrist`` (n, 3) metres. A wrist at rest in most frames (median speed 0) has no usual speed to
    compare with: all factors are 1.
    """
    speed = np.linalg.norm(np.diff(wrist, axis=0), axis=-1) / dt
    speed = np.concatenate([speed[:1], speed])
    padded = np.pad(speed, _SPEED_BOX // 2, mode="edge")
    speed = np.lib.stride_tricks.sliding_window_view(padded, _SPEED_BOX).mean(axis=-1)
    usual = np.median(speed)
    if usual <= 0:
        return np.ones_like(speed)
    return (1.0 + b * np.maximum(speed / usual - 1.0, 0.0)) ** 2


def _channels_from_state(state: np.ndarray) -> Float:
    """(n, 109) states in time order -> (n, 62) scalar channels."""
    hand = hands.unpack(np.asarray(state, dtype=np.float64))
    quat = rotations.continuous_quat_xyzw(rotations.matrix_to_quat_xyzw(hand.orientation()))
    rotvec = rotations.matrix_to_rotvec(hand.joint_rotations()).reshape(len(state), -1)
    return np.concatenate([hand.translation, quat, rotvec, hand.shape_params], axis=-1)


def _state_from_channels(channels: Float) -> np.ndarray:
    """Turn (n, 62) channels back into (n, 109) states; the quaternion is renormalised."""
    translation, quat, rotvec, shape = np.split(channels, (3, 7, 52), axis=-1)
    orientation = rotations.quat_xyzw_to_matrix(quat)
    joints = rotations.rotvec_to_matrix(rotvec.reshape(len(channels), -1, 3))
    hand = hands.HandState.from_matrices(translation, orientation, joints, shape)
    return np.asarray(hand.pack())


def _smooth_tracks(tracks: list[_Track], settings: SmoothingSettings) -> list[Float]:
    """Smooth the channels (n, C) of each track.

    Shorter tracks are padded with steps in which no time passes and nothing is measured (dt 0, a
    boundless variance): both passes cross them unchanged.
    """
    longest = max(len(track.channels) for track in tracks)
    num_channels = tracks[0].channels.shape[-1]
    z = np.zeros((longest, len(tracks), num_channels))
    dt = np.zeros((longest - 1, len(tracks), 1))
    R = np.full((longest, len(tracks), 1), _IGNORED)
    for s, track in enumerate(tracks):
        n = len(track.channels)
        z[:n, s] = track.channels
        dt[: n - 1, s, 0] = track.dt
        R[:n, s, 0] = settings.r**2 * track.distrust
    # Variances are in units of sigma^2, so that Q and R are the same for every channel of a hand.
    velocity_variance = np.stack([t.step_variance / t.sigma**2 for t in tracks])
    passed = _filter(z, dt, R, settings.q**2, velocity_variance)
    x = _smooth_back(passed, dt, settings.q**2) if settings.rts else passed.x
    return [x[: len(track.channels), s] for s, track in enumerate(tracks)]


class _Filtered(NamedTuple):
    """Mean [x, v] and covariance [[p00, p01], [p01, p11]] after each update, all (N, S, C).

    ``det`` is the covariance's determinant, carried along by its own recursion: every term of it
    is a sum of non-negative numbers, while p00 p11 - p01^2 cancels for a channel that jumps once.
    """

    x: Float
    v: Float
    p00: Float
    p01: Float
    p11: Float
    det: Float


def _filter(z: Float, dt: Float, R: Float, q2: float, velocity_variance: Float) -> _Filtered:
    """Forward pass over measurements ``z`` (N, S, C), steps ``dt`` (N - 1, S, 1), variances ``R``.

    Process noise q2 [[dt^3 / 3, dt^2 / 2], [dt^2 / 2, dt]]; the first measurement is the start.
    """
    out = _Filtered(*(np.empty_like(z) for _ in _Filtered._fields))
    x, v = z[0].copy(), np.zeros_like(z[0])
    p00, p01, p11 = np.broadcast_to(R[0], x.shape).copy(), np.zeros_like(x), velocity_variance
    det = p00 * p11
    q00, q01, q11, qdet = q2 * dt**3 / 3, q2 * dt**2 / 2, q2 * dt, q2**2 * dt**4 / 12
    dt2_3 = dt**2 / 3
    for k in range(len(z)):
        if k > 0:
            h = dt[k - 1]
            x = x + h * v
            hp01, hp11 = h * p01, h * p11
            det = det + qdet[k - 1] + q11[k - 1] * (p00 + hp01 + dt2_3[k - 1] * p11)
            p00 = p00 + hp01 + h * (p01 + hp11) + q00[k - 1]
            p01 = p01 + hp11 + q01[k - 1]
            p11 = p11 + q11[k - 1]
            gain = 1.0 / (p00 + R[k])
            error = (z[k] - x) * gain
            x = x + p00 * error
            v = v + p01 * error
            kept = R[k] * gain
            p11 = (det + p11 * R[k]) * gain
            p00, p01, det = p00 * kept, p01 * kept, det * kept
        for array, value in zip(out, (x, v, p00, p01, p11, det), strict=True):
            array[k] = value
    return out


def _smooth_back(passed: _Filtered, dt: Float, q2: float) -> Float:
    """Backward pass (Rauch, Tung & Striebel 1965): the smoothed x (N, S, C).

    The gain P F' (F P F' + Q)^-1 is multiplied out by hand, which leaves no difference of large
    numbers in it.
    """
    x, v = passed.x.copy(), passed.v.copy()
    p00, p01, p11, det = (array[:-1] for array in passed[2:])
    q11 = q2 * dt
    det_next = det + q2**2 * dt**4 / 12 + q11 * (p00 + dt * p01 + dt**2 / 3 * p11)
    g00 = (det + q11 * (p00 + dt / 2 * p01)) / det_next
    g01 = -dt * (det + q11 * (p00 / 2 + dt / 6 * p01)) / det_next
    g10 = q11 * (p01 + dt / 2 * p11) / det_next
    g11 = (det - q11 * dt * (p01 / 2 + dt / 6 * p11)) / det_next
    for k in range(len(x) - 2, -1, -1):
        x_error = x[k + 1] - (x[k] + dt[k] * v[k])
        v_error = v[k + 1] - v[k]
        x[k] += g00[k] * x_error + g01[k] * v_error
        v[k] += g10[k] * x_error + g11[k] * v_error
    return x
