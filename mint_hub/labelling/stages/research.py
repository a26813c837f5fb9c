"""What the adapters to other projects share: a worker in the Python that has the project."""

from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mint_hub.geometry.camera import fov_vh_to_K
from mint_hub.geometry.rigid import inverse, rigid, rotation_of, translation_of
from mint_hub.geometry.rotations import nearest_rotation
from mint_hub.labelling.environments import Environment
from mint_hub.labelling.readiness import Lack, check, python_for, python_lacks
from mint_hub.labelling.records import CameraPath, Clip
from mint_hub.labelling.stage import StageError
from mint_hub.labelling.worker import Arrays, Worker

SCRIPT: Final = Path(__file__).with_name("research_worker.py")


class ResearchStage:
    """An adapter: says what it lacks, and calls `research_worker` once nothing is missing.

    The settings of a subclass have ``python`` and ``timeout_s``; ``environment`` is what is made
    where ``python`` is not given, None where only the user can make one.
    """

    backend: str = ""
    environment: Environment | None = None
    settings: Any

    _worker: Worker | None = None

    def lacks(self) -> tuple[Lack, ...]:
        """Return what is missing for it to run."""
        return (*python_lacks(self.settings.python, self.environment), *self.files_lack())

    def files_lack(self) -> tuple[Lack, ...]:
        """Return what is missing of the user's files."""
        return ()

    def call(self, method: str, arrays: Arrays, **values: Any) -> tuple[Arrays, dict[str, Any]]:
        """Call the worker.

        Raises:
            NotReadyError: something is missing; all of it is named.
            StageError: the project failed on this clip.

        """
        if self._worker is None:
            check(self.files_lack())
            python = python_for(self.settings.python, self.environment)
            self._worker = Worker(python, SCRIPT, self.backend, timeout_s=self.settings.timeout_s)
        return self._worker.call(method, arrays, **values)

    def close(self) -> None:
        """End the worker."""
        if self._worker is not None:
            self._worker.close()
            self._worker = None


def camera_path(
    T_world_from_camera: NDArray[Any], clip: Clip, source: str, *, metric: bool
) -> CameraPath:
    """Make a path of what another project says of every frame.

    Covisibility and residual are NaN: these projects tell neither.

    Args:
        T_world_from_camera: (T, 4, 4), one a frame; rotations as exact as float32 leaves them.
        clip: whose path it is.
        source: the backend.
        metric: whether its units are metres.

    Raises:
        StageError: another number of poses than frames, or one that is no pose.

    """
    got = np.asarray(T_world_from_camera, np.float64)
    if got.shape != (clip.num_frames, 4, 4):
        raise StageError(
            f"{source}: expected a pose for each of {clip.num_frames} frames, got {got.shape}"
        )
    off = np.abs(rotation_of(got) @ np.swapaxes(rotation_of(got), -1, -2) - np.eye(3))
    bad = ~np.isfinite(got).all((-1, -2)) | (off.max((-1, -2)) > 1e-2)
    if bad.any():
        raise StageError(f"{source}: expected poses, got none at frame {int(bad.argmax())}")
    exact = rigid(nearest_rotation(rotation_of(got)), translation_of(got))
    return CameraPath(
        T_camera_from_world=inverse(exact),
        solved=np.ones(clip.num_frames, bool),
        covisible=np.full(clip.num_frames, np.nan, np.float32),
        residual_px=float("nan"),
        source=source,
        metric=metric,
    )


def focal_px(clip: Clip) -> tuple[float, float]:
    """(fx, fy) of a clip whose intrinsics are known, pixels of its frames."""
    assert clip.intrinsics is not None
    K = fov_vh_to_K(np.array(clip.intrinsics.fov_vh_rad, np.float64), clip.image_size_hw)
    return float(K[0, 0]), float(K[1, 1])
