"""The four fused signals of a video, grown window by window."""

from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from mint_hub.inference.fusion import CameraFuser, HandFuser, OverlapFuser, Seam
from mint_hub.inference.network import WindowPrediction

_WORST_SEAMS = 5


@dataclass(frozen=True, eq=False)
class Track:
    """What was predicted of a whole video of T frames.

    Attributes:
        T_camera_from_world: (T, 4, 4) float64, metres; the world is the first window's.
        fov_vh_rad: (T, 2) float64.
        hand_state: (T, 2, 109) float32, camera frame.
        presence_logits: (T, 2) float32.
        seams: how well each window agreed with what came before.

    """

    T_camera_from_world: NDArray[np.float64]
    fov_vh_rad: NDArray[np.float64]
    hand_state: NDArray[np.float32]
    presence_logits: NDArray[np.float32]
    seams: tuple[Seam, ...]

    def seam_report(self) -> dict[str, Any]:
        """Agreement of windows in numbers: count, medians, and the worst few with their frames."""
        if not self.seams:
            return {"count": 0}
        worst = sorted(self.seams, key=lambda seam: -seam.translation_m)[:_WORST_SEAMS]
        return {
            "count": len(self.seams),
            "median_rotation_deg": float(np.median([s.rotation_deg for s in self.seams])),
            "median_translation_m": float(np.median([s.translation_m for s in self.seams])),
            "worst": [asdict(seam) for seam in worst],
        }


class TrackBuilder:
    """Fuses predictions of windows, pushed from left to right, into a `Track`.

    Args:
        chain_over: align a window over "all" frames it shares, or the "first" one.

    """

    def __init__(self, chain_over: Literal["all", "first"] = "all") -> None:
        self._cameras = CameraFuser(chain_over)
        self._fusers: tuple[CameraFuser | OverlapFuser, ...] = (
            self._cameras,
            OverlapFuser(),
            HandFuser(),
            OverlapFuser(),
        )
        self._pieces: list[list[NDArray[Any]]] = [[] for _ in self._fusers]

    def push(self, prediction: WindowPrediction) -> None:
        """Add the next window.

        Raises:
            ValueError: it does not follow the last one, or its rotations are degenerate.

        """
        values = (
            prediction.T_camera_from_world,
            prediction.fov_vh_rad,
            prediction.hand_state,
            prediction.presence_logits,
        )
        for fuser, pieces, value in zip(self._fusers, self._pieces, values, strict=True):
            pieces.append(fuser.push(prediction.window, value))

    def finish(self) -> Track:
        """The whole track.

        Raises:
            ValueError: no window was pushed.

        """
        arrays = [
            np.concatenate([*pieces, fuser.finish()])
            for fuser, pieces in zip(self._fusers, self._pieces, strict=True)
        ]
        return Track(*arrays, seams=tuple(self._cameras.seams))  # pyright: ignore[reportArgumentType]
