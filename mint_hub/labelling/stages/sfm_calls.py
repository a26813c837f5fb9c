"""How the SfM stages call `sfm_worker`: its environment, its process, and what it is sent."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from mint_hub.labelling.environments import Environment
from mint_hub.labelling.readiness import python_for
from mint_hub.labelling.records import Clip
from mint_hub.labelling.stage import LOCAL
from mint_hub.labelling.worker import Arrays, Worker

ENVIRONMENT: Final = Environment(
    name="sfm",
    requirements=("pycolmap==4.2.*", "opencv-python-headless>=4.10", "numpy>=2", "scipy>=1.13"),
    imports=("pycolmap", "cv2", "scipy"),
)
SCRIPT: Final = Path(__file__).with_name("sfm_worker.py")


@dataclass(frozen=True)
class SfmSettings:
    """Settings of both stages.

    Attributes:
        max_side_px: frames whose longer side is longer are shrunk to it.
        threads: for matching, and the cores that one worker occupies; the result does not depend on
            it. Many workers do more with one thread each.
        python: an interpreter that has the packages, instead of one made for them.
        timeout_s: longest time for one window or clip.

    """

    max_side_px: int = 1024
    threads: int = 2
    python: str = field(default="", metadata=LOCAL)
    timeout_s: float = 3600.0


class SfmWorker:
    """The worker that both stages call, started by its first call."""

    def __init__(self, settings: SfmSettings) -> None:
        self._settings = settings
        self._worker: Worker | None = None

    def call(self, method: str, arrays: Arrays, **values: Any) -> tuple[Arrays, dict[str, Any]]:
        """Call ``sfm_worker``.

        Raises:
            StageError, NotReadyError: as of `Worker.call`.

        """
        if self._worker is None:
            python = python_for(self._settings.python, ENVIRONMENT)
            self._worker = Worker(python, SCRIPT, "sfm", timeout_s=self._settings.timeout_s)
        return self._worker.call(method, arrays, threads=self._settings.threads, **values)

    def close(self) -> None:
        """End it."""
        if self._worker is not None:
            self._worker.close()
            self._worker = None


def gray_images(images: Any, max_side_px: int) -> tuple[NDArray[np.uint8], float]:
    """Gray images (N, h, w) of RGB ones, and by what factor they were shrunk (at most 1)."""
    gray: list[NDArray[np.uint8]] = []
    shrunk = 1.0
    for image in images:
        height, width = image.shape[:2]
        shrunk = min(1.0, max_side_px / max(height, width))
        one: Any = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        if shrunk < 1:
            size = (max(round(width * shrunk), 1), max(round(height * shrunk), 1))
            one = cv2.resize(one, size, interpolation=cv2.INTER_AREA)
        gray.append(one)
    return np.stack(gray), shrunk


def hands_seen(clip: Clip, shrunk: float) -> Arrays:
    """Where hands were seen, for the masks; nothing where nobody looked for them."""
    detections = clip.detections
    if detections is None:
        return {"hand_frame": np.zeros(0, np.int64), "hand_uv": np.zeros((0, 21, 2))}
    return {
        "hand_frame": detections.frame.astype(np.int64),
        "hand_uv": detections.landmarks_uv.astype(np.float64) * shrunk,
    }
