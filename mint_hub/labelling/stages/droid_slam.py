"""Camera path by DROID-SLAM (Teed and Deng 2021, arXiv 2108.10869), monocular.

Its path has units of its own and says so: the scale stage makes metres of them. This adapter was
run on recorded results only, made to what DROID-SLAM's demo shows, and not with the project itself,
which needs an NVIDIA GPU.
"""

from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mint_hub.geometry.rigid import rigid
from mint_hub.geometry.rotations import quat_xyzw_to_matrix
from mint_hub.labelling.frames import clip_frames
from mint_hub.labelling.readiness import Lack, path_lacks
from mint_hub.labelling.records import CameraPath, Clip, Video
from mint_hub.labelling.stage import (
    LOCAL,
    Outcome,
    Resources,
    StageError,
    report_of,
    reported,
    require,
)
from mint_hub.labelling.stages.research import ResearchStage, camera_path, focal_px

OPTIONS: Final[dict[str, Any]] = {
    "disable_vis": True,
    "stereo": False,
    "upsample": False,
    "buffer": 1024,
    "beta": 0.3,
    "filter_thresh": 2.4,
    "warmup": 8,
    "keyframe_thresh": 4.0,
    "frontend_thresh": 16.0,
    "frontend_window": 25,
    "frontend_radius": 2,
    "frontend_nms": 1,
    "backend_thresh": 22.0,
    "backend_radius": 2,
    "backend_nms": 3,
}
"""Options of its demo, by their names there, at their values there; a buffer for long clips."""


@dataclass(frozen=True)
class DroidSettings:
    """Settings of `DroidCamera`.

    Attributes:
        checkout: folder of DROID-SLAM's repository.
        weights: ``droid.pth``.
        python: the interpreter it was installed for.
        timeout_s: for a clip.

    """

    checkout: str = field(default="", metadata=LOCAL)
    weights: str = field(default="", metadata=LOCAL)
    python: str = field(default="", metadata=LOCAL)
    timeout_s: float = 3600.0


class DroidCamera(ResearchStage):
    """Stage "camera", backend "droid_slam"."""

    stage: str = "camera"
    backend: str = "droid_slam"
    version: str = "1"
    needs: tuple[str, ...] = ("intrinsics",)
    gives: tuple[str, ...] = ("camera",)
    resources: Resources = Resources(cpus=1.0, gpus=1.0, memory_gib=8.0)

    def __init__(self, settings: DroidSettings | None = None) -> None:
        self.settings = settings or DroidSettings()

    def files_lack(self) -> tuple[Lack, ...]:
        """Return what is missing of the user's files."""
        settings = self.settings
        clone = "git clone --recursive https://github.com/princeton-vl/DROID-SLAM, and install it"
        where = "droid.pth, linked from the README of github.com/princeton-vl/DROID-SLAM"
        return (
            *path_lacks("checkout", settings.checkout, "DROID-SLAM", clone, "droid_slam"),
            *path_lacks("weights", settings.weights, "DROID-SLAM's weights", where),
        )

    def run_clip(self, clip: Clip, video: Video) -> Outcome:
        """Track the camera through every frame.

        Raises:
            StageError: intrinsics are missing, or DROID-SLAM fails.
            NotReadyError: checkout, weights or interpreter are missing.

        """
        require(self, clip)
        arrays, _ = self.call(
            "droid",
            {"images": np.stack(list(clip_frames(clip)))},
            checkout=self.settings.checkout,
            weights=self.settings.weights,
            focal=list(focal_px(clip)),
            settings=OPTIONS,
        )
        path = to_path(arrays["camera_to_world"], clip)
        return Outcome((reported(clip, report_of(self, frames=clip.num_frames), camera=path),))


def to_path(camera_to_world: NDArray[Any], clip: Clip) -> CameraPath:
    """Make a path of (T, 7): translation in units of its own, quaternion xyzw, camera to world.

    Raises:
        StageError: another shape, or a quaternion that is none.

    """
    if camera_to_world.shape != (clip.num_frames, 7):
        raise StageError(
            f"droid_slam: expected (T, 7) poses of {clip.num_frames} frames, got "
            f"{camera_to_world.shape}"
        )
    try:
        rotations = quat_xyzw_to_matrix(camera_to_world[:, 3:].astype(np.float64))
    except ValueError as error:
        raise StageError(f"droid_slam: {error}") from error
    poses = rigid(rotations, camera_to_world[:, :3].astype(np.float64))
    return camera_path(poses, clip, "droid_slam", metric=False)
