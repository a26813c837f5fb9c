"""Cleaning of hand tracks: spikes and outliers out, short gaps bridged and marked.

Judged in the world, where a hand moves smoothly whatever the head does. Nothing is invented beyond
short gaps, and what is bridged says so.
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mint_hub.geometry import hand_state as hands
from mint_hub.geometry import rigid
from mint_hub.geometry.rotations import geodesic_angle, matrix_to_rot6d_rows, slerp

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]

_MAD_TO_SIGMA: Final = 1.4826


@dataclass(frozen=True)
class CleaningSettings:
    """Thresholds of the cleaner.

    Attributes:
        spike_step_m, spike_step_deg: a step a frame beyond either opens a block that may be a
            spike; a return closer than both ends it.
        spike_frames: frames that such a block has at most.
        outlier_sigmas: steps beyond the median by so many robust standard deviations are outliers,
        outlier_floor_m, outlier_floor_deg: but never below these, a frame.
        gap_frames: missing frames that are bridged at most.

    """

    spike_step_m: float = 0.15
    spike_step_deg: float = 45.0
    spike_frames: int = 15
    outlier_sigmas: float = 3.0
    outlier_floor_m: float = 0.10
    outlier_floor_deg: float = 30.0
    gap_frames: int = 30


class Cleaned(NamedTuple):
    """What came of cleaning; T frames, 2 hands.

    Attributes:
        hand_state: (T, 2, 109) float32, camera frame; absent hands are `hand_state.absent`.
        presence: (T, 2) bool, observed or filled.
        filled: (T, 2) bool.
        spikes, outliers: (T, 2) bool, observed before and taken out.

    """

    hand_state: NDArray[np.float32]
    presence: Bool
    filled: Bool
    spikes: Bool
    outliers: Bool


def clean_hands(
    hand_state: NDArray[np.float32],
    presence: Bool,
    T_camera_from_world: Float64,
    settings: CleaningSettings | None = None,
) -> Cleaned:
    """Take out block spikes and single outliers, then bridge short gaps.

    Args:
        hand_state: (T, 2, 109), camera frame, metres.
        presence: (T, 2), observed hands.
        T_camera_from_world: (T, 4, 4), metres.
        settings: thresholds.

    Raises:
        ValueError: shapes that do not go together.

    """
    settings = settings or CleaningSettings()
    frames = len(hand_state)
    if presence.shape != (frames, 2) or T_camera_from_world.shape != (frames, 4, 4):
        raise ValueError(
            f"expected hand_state (T, 2, 109), presence (T, 2) and poses (T, 4, 4), got "
            f"{hand_state.shape}, {presence.shape} and {T_camera_from_world.shape}"
        )
    T_world_from_camera = rigid.inverse(T_camera_from_world)
    state = np.array(hand_state, np.float64)
    filled = np.zeros((frames, 2), bool)
    spikes, outliers = np.zeros((frames, 2), bool), np.zeros((frames, 2), bool)
    for side in range(2):
        seen = np.flatnonzero(presence[:, side])
        if not len(seen):
            continue
        wrist = T_world_from_camera @ _wrist(state[:, side])
        spikes[_spikes(wrist, seen, settings), side] = True
        kept = np.flatnonzero(presence[:, side] & ~spikes[:, side])
        outliers[_outliers(wrist, kept, settings), side] = True
        kept = np.flatnonzero(presence[:, side] & ~spikes[:, side] & ~outliers[:, side])
        filled[:, side] = _bridged(state[:, side], wrist, kept, T_camera_from_world, settings)
    present = (presence & ~spikes & ~outliers) | filled
    absent = np.asarray(hands.absent((frames, 2)))
    out = np.where(present[..., None], state, absent).astype(np.float32)
    return Cleaned(out, present, filled, spikes, outliers)


def _wrist(state: Float64) -> Float64:
    unpacked = hands.unpack(state)
    return np.asarray(rigid.rigid(unpacked.orientation(), unpacked.translation))


class _Steps(NamedTuple):
    """From each sample to the next: metres and degrees, in all and a frame."""

    m: Float64
    deg: Float64
    m_frame: Float64
    deg_frame: Float64


def _steps(wrist: Float64, first: Any, second: Any) -> _Steps:
    frames = np.maximum(np.abs(np.asarray(second) - np.asarray(first)), 1)
    m = np.linalg.norm(wrist[second, :3, 3] - wrist[first, :3, 3], axis=-1)
    deg = np.degrees(geodesic_angle(wrist[first, :3, :3], wrist[second, :3, :3]))
    return _Steps(m, deg, m / frames, deg / frames)


def _spikes(wrist: Float64, seen: NDArray[np.intp], settings: CleaningSettings) -> list[int]:
    """Frames of blocks that jump away and come back.

    A block opens with a step beyond a threshold. It is a spike when, at most ``spike_frames``
    frames on, a sample lies again within the thresholds of the last one before the block, and the
    step back is a jump as well.
    """
    step = _steps(wrist, seen[:-1], seen[1:])
    jumps = (step.m_frame > settings.spike_step_m) | (step.deg_frame > settings.spike_step_deg)
    found: list[int] = []
    i = 0
    while i < len(jumps):
        if not jumps[i]:
            i += 1
            continue
        before = seen[i]
        end = i + 1
        while end < len(jumps) and seen[end] - seen[i + 1] < settings.spike_frames:
            if jumps[end]:
                back = _steps(wrist, before, seen[end + 1])
                if back.m < settings.spike_step_m and back.deg < settings.spike_step_deg:
                    found += seen[i + 1 : end + 1].tolist()
                    break
            end += 1
        else:
            i += 1
            continue
        i = end + 1
    return found


def _outliers(wrist: Float64, seen: NDArray[np.intp], settings: CleaningSettings) -> list[int]:
    """Samples whose steps from before and to after are both out of line (Hampel's rule)."""
    if len(seen) < 3:
        return []
    step = _steps(wrist, seen[:-1], seen[1:])
    far = step.m_frame > _limit(step.m_frame, settings.outlier_floor_m, settings)
    turned = step.deg_frame > _limit(step.deg_frame, settings.outlier_floor_deg, settings)
    bad = (far[:-1] & far[1:]) | (turned[:-1] & turned[1:])
    return seen[1:-1][bad].tolist()


def _limit(steps: Float64, floor: float, settings: CleaningSettings) -> float:
    median = float(np.median(steps))
    sigma = _MAD_TO_SIGMA * float(np.median(np.abs(steps - median)))
    return max(floor, median + settings.outlier_sigmas * sigma)


def _bridged(
    state: Float64,
    wrist: Float64,
    kept: NDArray[np.intp],
    T_camera_from_world: Float64,
    settings: CleaningSettings,
) -> Bool:
    """Fill short gaps of one hand in place; return which frames were filled.

    Position and shape are linear, rotations spherical, the wrist in the world.
    """
    filled = np.zeros(len(state), bool)
    for before, after in pairwise(kept.tolist()):
        missing = np.arange(before + 1, after)
        if not 0 < len(missing) <= settings.gap_frames:
            continue
        share = (missing - before) / (after - before)
        weight = share[:, None]
        position = (1 - weight) * wrist[before, :3, 3] + weight * wrist[after, :3, 3]
        turned = slerp(wrist[before, :3, :3], wrist[after, :3, :3], share)
        T_camera_from_wrist = T_camera_from_world[missing] @ rigid.rigid(turned, position)
        ends = hands.unpack(state[[before, after]])
        fingers = ends.joint_rotations()
        filling = hands.HandState(
            translation=T_camera_from_wrist[:, :3, 3],
            orientation_rot6d_rows=matrix_to_rot6d_rows(T_camera_from_wrist[:, :3, :3]),
            joint_rot6d_rows=matrix_to_rot6d_rows(
                slerp(fingers[0][None], fingers[1][None], np.tile(weight, (1, 15)))
            ),
            shape_params=(1 - weight) * ends.shape_params[0] + weight * ends.shape_params[1],
        )
        state[missing] = np.asarray(filling.pack())
        filled[missing] = True
    return filled
