"""Camera trajectories that a device recorded beside its video, and episodes that use them.

Readers for TUM text, EgoDex HDF5 and Project Aria's MPS csv (``trajectory_files``) return a
``DeviceTrajectory`` on the device's own clock, world-to-camera with OpenCV's axes. ``camera_at``
takes it to a video's times; ``time_offset_s`` is what has to be added to a video time to get the
device's.

Law: a trajectory sampled at its own times, with offset 0, is itself.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mint_hub.geometry import hand_state as hands
from mint_hub.geometry import rigid
from mint_hub.geometry.camera import K_to_fov_vh
from mint_hub.loaders.schema import Episode
from mint_hub.loaders.trajectory_files import (
    AriaCalibration,
    DeviceTrajectory,
    read_aria_calibration,
    read_aria_mps_csv,
    read_egodex_hdf5,
    read_egodex_intrinsics,
    read_tum,
)

__all__ = [
    "MAX_GAP_S",
    "AriaCalibration",
    "DeviceTrajectory",
    "camera_at",
    "episode_from_trajectory",
    "read_aria_calibration",
    "read_aria_mps_csv",
    "read_egodex_hdf5",
    "read_egodex_intrinsics",
    "read_tum",
    "with_device_camera",
]

Float = NDArray[np.float64]

MAX_GAP_S: Final = 0.5
"""Longest stretch without a pose that is bridged by interpolation."""


def camera_at(
    trajectory: DeviceTrajectory,
    video_times_s: NDArray[Any] | Sequence[float],
    *,
    time_offset_s: float = 0.0,
    max_gap_s: float = MAX_GAP_S,
) -> Float:
    """T_camera_from_world (T, 4, 4) at a video's times, interpolated on SE(3).

    The camera's centre moves straight between poses. Times up to one median step outside the
    trajectory get its end pose.

    Args:
        trajectory: on the device's clock.
        video_times_s: (T,).
        time_offset_s: device time = video time + this.
        max_gap_s: a longer stretch without a pose around a video time raises.

    Raises:
        ValueError: times that are not covered, or fall into a gap.

    """
    times, poses = trajectory
    at = np.asarray(video_times_s, np.float64) + time_offset_s
    if at.ndim != 1 or not len(at) or not np.isfinite(at).all():
        raise ValueError(f"video_times_s: expected finite (T,), got {at.shape}")
    slack = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
    if at.min() < times[0] - slack or at.max() > times[-1] + slack:
        raise ValueError(
            f"trajectory: expected times that cover the video, {at.min():.3f} to {at.max():.3f} s "
            f"on the device's clock (time_offset_s {time_offset_s:g}), got {times[0]:.3f} to "
            f"{times[-1]:.3f} s"
        )
    after = np.searchsorted(times, at, side="left").clip(1, max(len(times) - 1, 1))
    if len(times) > 1:
        gap = np.where(times[after] == at, 0.0, times[after] - times[after - 1])
        if gap.max() > max_gap_s:
            k = int(np.argmax(gap))
            raise ValueError(
                f"trajectory: expected poses at most {max_gap_s:g} s apart, got none between "
                f"{times[after[k] - 1]:.3f} and {times[after[k]]:.3f} s, around video frame {k}"
            )
    # Interpolate the camera's place in the world, not the inverse.
    return rigid.inverse(rigid.interpolate_path(times, rigid.inverse(poses), at))


def episode_from_trajectory(
    key: str,
    trajectory: DeviceTrajectory,
    video_times_s: NDArray[Any] | Sequence[float],
    K: NDArray[Any],
    image_size_hw: tuple[int, int],
    *,
    time_offset_s: float = 0.0,
    max_gap_s: float = MAX_GAP_S,
    meta: dict[str, Any] | None = None,
) -> Episode:
    """Make an episode of a video's camera, with no hands.

    Args:
        key: of the episode.
        trajectory: on the device's clock.
        video_times_s: (T,) presentation times of its frames.
        K: (3, 3) pinhole intrinsics of the video, pixels; principal point at the centre.
        image_size_hw: of the video.
        time_offset_s: device time = video time + this.
        max_gap_s: see ``camera_at``.
        meta: added to the episode's; what is known of the video (``source``, ``uid``,
            ``native_fps``, ``video_duration_s``, ``lens``) is where `attach` looks for it. Times
            are the container's, so there is no ``video_start_sec``.

    Raises:
        ValueError: see ``camera_at``; also what ``Episode`` refuses.

    """
    times = np.asarray(video_times_s, np.float64)
    poses = camera_at(trajectory, times, time_offset_s=time_offset_s, max_gap_s=max_gap_s)
    count = len(times)
    fov = np.tile(K_to_fov_vh(np.asarray(K, np.float64), image_size_hw), (count, 1))
    bare = Episode(
        key=key,
        timestamps_s=times,
        T_camera_from_world=poses,
        fov_vh_rad=fov.astype(np.float32),
        hand_state=np.asarray(hands.absent((count, 2)), np.float32),
        presence=np.zeros((count, 2), bool),
        image_size_hw=image_size_hw,
        meta=meta or {},
    )
    return replace(bare, meta=_with_provenance(bare.meta, time_offset_s))


def with_device_camera(
    episode: Episode,
    trajectory: DeviceTrajectory,
    *,
    time_offset_s: float = 0.0,
    max_gap_s: float = MAX_GAP_S,
) -> Episode:
    """Replace an episode's camera by the device's; hands stay where they are in the camera.

    The world becomes the device's. ``meta["provenance"]["camera"]`` and ``scale_status`` say so.

    Args:
        episode: on the video's clock.
        trajectory: on the device's clock.
        time_offset_s: device time = video time + this.
        max_gap_s: see ``camera_at``.

    Raises:
        ValueError: see ``camera_at``.

    """
    poses = camera_at(
        trajectory, episode.timestamps_s, time_offset_s=time_offset_s, max_gap_s=max_gap_s
    )
    meta = _with_provenance(episode.meta, time_offset_s)
    if episode.presence.any() and (before := episode.meta.get("scale_status")):
        meta["scale_status"] = f"camera: {meta['scale_status']}; hands: {before}"
    return replace(episode, T_camera_from_world=poses, meta=meta)


def _with_provenance(meta: dict[str, Any], time_offset_s: float) -> dict[str, Any]:
    camera = {"source": "device trajectory", "time_offset_s": time_offset_s}
    return {
        **meta,
        "scale_status": "metric as the device's tracking",
        "provenance": {**meta.get("provenance", {}), "camera": camera},
    }
