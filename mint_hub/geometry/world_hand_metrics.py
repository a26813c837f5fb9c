"""World-space hands: camera-frame hands carried by the predicted camera path.

The predicted path is first aligned once over its centres, by SE(3) or Sim(3); the scale moves the
centres only, never the size of a hand. Hands are compared where both sides have them, one hand at
a time, and ``coverage`` says how much of the truth that is: a missed hand costs nothing else here.

Sources: the MINT paper's evaluation; W-MPJPE, WA-MPJPE and RTE as in WHAM (Shin et al. 2024).
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mint_hub.conventions import MODEL_FPS
from mint_hub.geometry.additive_metrics import (
    Additive,
    Bools,
    Floats,
    Measure,
    checked_flags,
    checked_floats,
    checked_fps,
    checked_path,
    finite_where,
    ratio,
)
from mint_hub.geometry.arrays import runs
from mint_hub.geometry.rigid import rigid, transform_points, umeyama
from mint_hub.geometry.trajectory_metrics import DEGENERATE_PATH_M, align_paths

CHUNK = 100
"""Frames of a chunk."""

WORLD_MEASURES = (
    Measure("W-MPJPE", "mm", 0.0),
    Measure("WA-MPJPE", "mm", 0.0),
    Measure("RTE", "% of path", 0.0),
    Measure("Acceleration error", "m/s^2", 0.0),
    Measure("World coverage", "", 1.0),
)


@dataclass(frozen=True)
class WorldHands:
    """Two hands and the camera that carries them; what is not ``present`` may hold anything.

    Attributes:
        T_world_from_camera: (T, 4, 4) metres; the world is this side's own.
        joints_camera: (T, 2, 21, 3) metres, camera axes.
        present: (T, 2) bool.

    """

    T_world_from_camera: Any
    joints_camera: Any
    present: Any


@dataclass(frozen=True)
class WorldStatistics(Additive):
    """Sums over hand-frames; ``metrics`` divides.

    ``frames`` are hand-frames that both sides have, ``true_frames`` those the truth has.
    ``still_runs`` counts runs whose true wrist moves less than 1e-9 m, which RTE leaves out.
    """

    frames: int = 0
    true_frames: int = 0
    w_mpjpe_sum_mm: float = 0.0
    wa_mpjpe_sum_mm: float = 0.0
    rte_sum_percent: float = 0.0
    rte_frames: int = 0
    still_runs: int = 0
    acceleration_sum_m_s2: float = 0.0
    acceleration_count: int = 0

    def metrics(self) -> dict[str, float]:
        """Return the values of ``WORLD_MEASURES`` by name; NaN where nothing was counted."""
        return {
            "W-MPJPE": ratio(self.w_mpjpe_sum_mm, self.frames),
            "WA-MPJPE": ratio(self.wa_mpjpe_sum_mm, self.frames),
            "RTE": ratio(self.rte_sum_percent, self.rte_frames),
            "Acceleration error": ratio(self.acceleration_sum_m_s2, self.acceleration_count),
            "World coverage": ratio(self.frames, self.true_frames),
        }


def world_hand_statistics(
    predicted: WorldHands, truth: WorldHands, fps: float = MODEL_FPS, with_scale: bool = False
) -> WorldStatistics:
    """Score a clip's hands in the world.

    - W-MPJPE: in chunks of 100 frames (tails included) of runs both sides have, a Sim(3) fitted on
      the 21 joints of the chunk's first two frames; mean distance of the joints, frame-weighted.
    - WA-MPJPE: the same with the Sim(3) fitted on the whole chunk.
    - RTE: in runs of two frames or more, the wrist path aligned by SE(3); mean distance over the
      length of the true path of that run, frame-weighted, percent.
    - Acceleration error: in runs of five frames or more, distance of the joints' second differences
      times fps^2; the run's first and last sample are dropped.

    Args:
        predicted: T frames.
        truth: T frames.
        fps: frames a second.
        with_scale: align the camera path by Sim(3) instead of SE(3). A degenerate path has no
            scale: 1 is taken (see ``align_paths``).

    Raises:
        ValueError: shapes that disagree, no frame, numbers that are not finite in poses or in a
            hand that is present, poses that are not rigid, or a frame rate that is not positive.

    """
    G = checked_path("truth.T_world_from_camera", truth.T_world_from_camera)
    P = checked_path("predicted.T_world_from_camera", predicted.T_world_from_camera, len(G))
    checked_fps(fps)
    joints, present = _checked_joints("predicted", predicted, len(G))
    true_joints, true_present = _checked_joints("truth", truth, len(G))
    both = present & true_present

    fit = align_paths(P, G, with_scale)
    centres = transform_points(fit.matrix(), P[:, :3, 3])
    aligned = rigid(fit.rotation @ P[:, :3, :3], centres)
    world, true_world = transform_points(aligned, joints), transform_points(G, true_joints)

    total = WorldStatistics(frames=int(both.sum()), true_frames=int(true_present.sum()))
    for hand in (0, 1):
        pair = world[:, hand], true_world[:, hand]
        starts, stops = np.array(runs(both[:, hand]), np.intp).reshape(-1, 2).T
        total += _chunk_sums(*pair, starts, stops) + _path_sums(*pair, starts, stops)
        total += _acceleration_sums(*pair, both[:, hand], fps)
    return total


def _checked_joints(name: str, hands: WorldHands, frames: int) -> tuple[Floats, Bools]:
    present = checked_flags(f"{name}.present", hands.present, (frames, 2))
    field = f"{name}.joints_camera"
    joints = checked_floats(field, hands.joints_camera, (frames, 2, 21, 3))
    return finite_where(field, joints, present), present


def _equally_long(starts: NDArray[np.intp], stops: NDArray[np.intp]) -> Iterator[NDArray[np.intp]]:
    """Frame numbers (N, L) of the N stretches of each length L, so that they are fitted at once."""
    lengths = stops - starts
    for length in np.unique(lengths):
        yield starts[lengths == length][:, None] + np.arange(length)


def _chunk_sums(
    world: Floats, true_world: Floats, starts: NDArray[np.intp], stops: NDArray[np.intp]
) -> WorldStatistics:
    """W- and WA-MPJPE of one hand (T, 21, 3)."""
    cuts = [np.arange(a, b, CHUNK) for a, b in zip(starts, stops, strict=True)]
    firsts = np.concatenate([*cuts, np.zeros(0, np.intp)]).astype(np.intp)
    run_stops = np.repeat(stops, [len(cut) for cut in cuts])
    sums = [0.0, 0.0]
    for frames in _equally_long(firsts, np.minimum(firsts + CHUNK, run_stops)):
        shape = (len(frames), -1, 3)
        source, target = world[frames].reshape(shape), true_world[frames].reshape(shape)
        for i, fitted in enumerate((2 * 21, source.shape[1])):
            fit = umeyama(source[:, :fitted], target[:, :fitted], check=False)
            far = np.linalg.norm(fit.apply(source) - target, axis=-1)
            sums[i] += 1e3 * float(far.sum()) / 21
    return WorldStatistics(w_mpjpe_sum_mm=sums[0], wa_mpjpe_sum_mm=sums[1])


def _path_sums(
    world: Floats, true_world: Floats, starts: NDArray[np.intp], stops: NDArray[np.intp]
) -> WorldStatistics:
    """RTE of one hand (T, 21, 3): wrist paths of whole runs."""
    total, count, still = 0.0, 0, 0
    long = stops - starts >= 2
    for frames in _equally_long(starts[long], stops[long]):
        source, target = world[frames, 0], true_world[frames, 0]
        length = np.linalg.norm(np.diff(target, axis=1), axis=-1).sum(axis=-1)
        moving = length >= DEGENERATE_PATH_M
        still += int((~moving).sum())
        source, target, length = source[moving], target[moving], length[moving]
        aligned = umeyama(source, target, with_scale=False, check=False).apply(source)
        share = np.linalg.norm(aligned - target, axis=-1) / length[:, None]
        total += 100 * float(share.sum())
        count += share.size
    return WorldStatistics(rte_sum_percent=total, rte_frames=count, still_runs=still)


def _acceleration_sums(
    world: Floats, true_world: Floats, both: Bools, fps: float
) -> WorldStatistics:
    """Acceleration error of one hand (T, 21, 3), at frames with two of the run on either side."""
    error = world - true_world
    bend = (error[:-2] - 2 * error[1:-1] + error[2:])[1:-1]
    inside = both[:-4] & both[1:-3] & both[2:-2] & both[3:-1] & both[4:]
    far = fps**2 * np.linalg.norm(bend, axis=-1).mean(axis=-1)
    return WorldStatistics(
        acceleration_sum_m_s2=float(far[inside].sum()), acceleration_count=int(inside.sum())
    )
