"""How far cameras move in a window: the scales that camera losses are divided by.

Windows are re-anchored to their first frame: R_k R_0^T and t_k - R_k R_0^T t_0, so that frame 0 is
the identity. Sums add, so that every split is counted once and the sums are kept.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mint_hub.loaders.schema import Episode

FLOOR = 1e-6

Floats = NDArray[np.float64]


def reanchored(T_camera_from_world: Floats) -> Floats:
    """Poses relative to the first frame, (T, 4, 4): ``T_camera_from_first``; frame 0 is exact."""
    poses = np.asarray(T_camera_from_world, np.float64)
    rotation = poses[:, :3, :3] @ poses[0, :3, :3].T
    result = np.tile(np.eye(4), (len(poses), 1, 1))
    result[1:, :3, :3] = rotation[1:]
    result[1:, :3, 3] = (poses[:, :3, 3] - rotation @ poses[0, :3, 3])[1:]
    return result


def window_starts(num_frames: int, length: int, stride: int) -> range:
    """First frames of the windows of an episode; a tail shorter than ``length`` is dropped."""
    return range(0, num_frames - length + 1, stride)


@dataclass(frozen=True)
class CameraScales:
    """Standard deviations over the windows of a training set, each (3,), metres.

    Attributes:
        translation: of t_k.
        velocity: of the SE(3) increments t_{k+1} - (R_{k+1} R_k^T) t_k.
        acceleration: of second differences of t_k.

    """

    translation: Floats
    velocity: Floats
    acceleration: Floats


@dataclass(frozen=True)
class CameraSums:
    """Counts, sums and sums of squares behind `CameraScales`: (3 kinds, 1 + 3 + 3) numbers."""

    values: Floats

    @classmethod
    def none(cls) -> "CameraSums":
        """Return the sums of nothing."""
        return cls(np.zeros((3, 7)))

    @classmethod
    def of(cls, episode: Episode, length: int, stride: int) -> "CameraSums":
        """Sum over the windows of an episode."""
        sums = np.zeros((3, 7))
        for start in window_starts(episode.num_frames, length, stride):
            poses = reanchored(episode.T_camera_from_world[start : start + length])
            R, t = poses[:, :3, :3], poses[:, :3, 3]
            turn = R[1:] @ R[:-1].swapaxes(-1, -2)
            velocity = t[1:] - (turn @ t[:-1, :, None])[..., 0]
            for kind, x in enumerate((t, velocity, np.diff(t, n=2, axis=0))):
                sums[kind] += np.concatenate([[len(x)], x.sum(0), (x * x).sum(0)])
        return cls(sums)

    def __add__(self, other: "CameraSums") -> "CameraSums":
        return CameraSums(self.values + other.values)

    def scales(self) -> CameraScales:
        """Population standard deviations, at least 1e-6; 1e-6 of nothing."""
        count = np.maximum(self.values[:, :1], 1)
        mean = self.values[:, 1:4] / count
        variance = self.values[:, 4:] / count - mean * mean
        std = np.maximum(np.sqrt(np.maximum(variance, 0)), FLOOR)
        return CameraScales(*std)

    def to_list(self) -> list[list[float]]:
        """Return the numbers as JSON holds them."""
        return self.values.tolist()

    @classmethod
    def from_list(cls, values: Any) -> "CameraSums":
        """Invert ``to_list``; ValueError for another shape."""
        array = np.asarray(values, np.float64)
        if array.shape != (3, 7):
            raise ValueError(f"camera sums: expected (3, 7) numbers, got {array.shape}")
        return cls(array)
