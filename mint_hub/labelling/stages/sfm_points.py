"""The points a camera path was solved from, kept beside the clip for whoever asks for a depth.

A file of a clip stays right when the clip is cut, joined to others and rescaled later: it holds its
own copy of the path, by source time, and depths are returned in units of the path asked about.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from mint_hub.labelling.records import Clip
from mint_hub.loaders.atomic import replacing

Float = NDArray[np.float64]
Int = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class MapPoints:
    """Map points of a piece of video and where keyframes saw them.

    Attributes:
        timestamps_s: (F,) source times of its frames.
        T_camera_from_world: (F, 4, 4).
        image_size_hw: of the frames that pixels belong to.
        points: (P, 3), in the world of the poses.
        obs_frame: (O,) index into the F frames.
        obs_point: (O,) index into the points.
        obs_uv: (O, 2) pixels.

    """

    timestamps_s: Float
    T_camera_from_world: Float
    image_size_hw: tuple[int, int]
    points: Float
    obs_frame: Int
    obs_point: Int
    obs_uv: Float

    def save(self, path: Path) -> None:
        """Write to an ``.npz``, whole or not at all."""
        arrays: dict[str, Any] = {name: np.asarray(value) for name, value in vars(self).items()}
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing(path) as temporary, temporary.open("wb") as file:
            np.savez(file, **arrays)

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read what `save` wrote.

        Raises:
            FileNotFoundError: there is no such file.
            ValueError: it is something else; the message names it.

        """
        try:
            with np.load(path, allow_pickle=False) as stored:
                values: dict[str, Any] = {name: stored[name] for name in cls.__annotations__}
        except (KeyError, ValueError, EOFError, OSError) as error:
            if isinstance(error, FileNotFoundError):
                raise
            raise ValueError(f"{path}: expected map points of a clip, got {error}") from None
        values["image_size_hw"] = tuple(int(n) for n in values["image_size_hw"])
        return cls(**values)

    def frame_at(self, time_s: float, tolerance_s: float) -> int | None:
        """Index of the frame at a source time, None where there is none within the tolerance."""
        at = int(np.abs(self.timestamps_s - time_s).argmin())
        return at if abs(self.timestamps_s[at] - time_s) <= tolerance_s else None

    def seen_near(self, frame: int, reach: int, K: Float) -> tuple[Float, Float]:
        """Pixels (N, 2) in ``frame`` and depths (N,) of points that frames within reach observe."""
        near = np.unique(self.obs_point[np.abs(self.obs_frame - frame) <= reach])
        T = self.T_camera_from_world[frame]
        camera = self.points[near] @ T[:3, :3].T + T[:3, 3]
        camera = camera[camera[:, 2] > 1e-9]
        uv = camera[:, :2] / camera[:, 2:] * (K[0, 0], K[1, 1]) + K[:2, 2]
        return uv, camera[:, 2]

    def units_of(self, clip: Clip) -> float | None:
        """How many units of the clip's path make one of this map's, None where none can be told.

        The two paths are compared by the distances that the camera travels between their common
        frames. A clip that was cut from, or joined by a similarity to others from, the one that
        the map was made of has the same path but for its unit.
        """
        if clip.camera is None:
            return None
        times = clip.source_timestamps_s
        nearest = np.abs(times[:, None] - self.timestamps_s[None]).argmin(axis=1)
        same = np.abs(self.timestamps_s[nearest] - times) < 0.5 / clip.fps
        if same.sum() < 2:
            return None
        here = centres(clip.camera.T_camera_from_world[same])
        there = centres(self.T_camera_from_world[nearest[same]])
        spread = [float(np.linalg.norm(c - c.mean(axis=0))) for c in (here, there)]
        return spread[0] / spread[1] if min(spread) > 1e-9 else None


def centres(T_camera_from_world: Float) -> Float:
    """Camera centres (..., 3) in the world."""
    R, t = T_camera_from_world[..., :3, :3], T_camera_from_world[..., :3, 3]
    return -np.einsum("...ji,...j->...i", R, t)


def points_path(clip: Clip) -> Path:
    """Where the points of a clip are kept: beside its video."""
    return clip.video.parent / f"{clip.key}.points.npz"


def points_of(clip: Clip) -> list[MapPoints]:
    """All map points that the clip's reports name and that are still there.

    A report of the camera stage names its file as ``numbers["map_points"]``; where files have
    moved together with the video they are found beside it.
    """
    found: list[MapPoints] = []
    names = [r.numbers.get("map_points") for r in clip.reports if r.stage == "camera"]
    for name in dict.fromkeys(str(n) for n in names if n):
        for path in (Path(name), clip.video.parent / Path(name).name):
            if path.is_file():
                found.append(MapPoints.load(path))
                break
    return found
