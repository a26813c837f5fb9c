"""Stage "clean": outliers out, gaps bridged, one shape a hand, smoothed."""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from mint_hub.geometry import hand_state
from mint_hub.geometry.smoothing import SmoothingSettings, smooth_hands
from mint_hub.labelling.cleaning import CleaningSettings, clean_hands
from mint_hub.labelling.records import Clip, Video
from mint_hub.labelling.stage import Outcome, Resources, report_of, reported, require


class Clean:
    """Cleans in the world, then smooths in the camera frame (UKF with RTS backward pass)."""

    stage, backend, version = "clean", "default", "1"
    needs, gives = ("camera", "hands"), ("hands",)
    resources = Resources(cpus=1)

    @dataclass(frozen=True)
    class Settings:
        """Thresholds, and whether and how to smooth.

        Attributes:
            cleaning: thresholds.
            smooth: whether to smooth.
            smoothing: how.

        """

        cleaning: CleaningSettings = field(default_factory=CleaningSettings)
        smooth: bool = True
        smoothing: SmoothingSettings = field(default_factory=SmoothingSettings)

    def __init__(self, settings: Settings | None = None) -> None:
        self.settings = settings or self.Settings()

    def run_clip(self, clip: Clip, video: Video) -> Outcome:
        """Clean one clip; a clip whose hands are all outliers goes on without hands."""
        require(self, clip)
        assert clip.camera is not None
        assert clip.hands is not None
        found = clip.hands
        cleaned = clean_hands(
            found.hand_state,
            found.presence & ~found.filled,
            clip.camera.T_camera_from_world,
            self.settings.cleaning,
        )
        observed = cleaned.presence & ~cleaned.filled
        state = one_shape(cleaned.hand_state, cleaned.presence, observed)
        if self.settings.smooth:
            smoothed = smooth_hands(state, cleaned.presence, self.settings.smoothing)
            state = np.asarray(smoothed, np.float32)
        hands = replace(
            found,
            hand_state=state,
            presence=cleaned.presence,
            filled=cleaned.filled,
            score=np.where(observed, found.score, 0).astype(np.float32),
            residual_px=np.where(observed, found.residual_px, np.nan).astype(np.float32),
        )
        report = report_of(
            self,
            spikes=int(cleaned.spikes.sum()),
            outliers=int(cleaned.outliers.sum()),
            filled=int(cleaned.filled.sum()),
            observed=int(observed.sum()),
        )
        return Outcome((reported(clip, report, hands=hands),))

    def close(self) -> None:
        """Nothing to end."""


def one_shape(
    state: NDArray[np.float32], presence: NDArray[np.bool_], observed: NDArray[np.bool_]
) -> NDArray[np.float32]:
    """Give each hand the median of its observed shapes, as a person has one (and shards hold one).

    Args:
        state: (T, 2, 109).
        presence: (T, 2), hands whose shape is set.
        observed: (T, 2), hands whose shape is trusted.

    """
    unpacked = hand_state.unpack(state)
    shapes = np.array(unpacked.shape_params)
    for side in range(2):
        if observed[:, side].any():
            shapes[presence[:, side], side] = np.median(shapes[observed[:, side], side], axis=0)
    return np.asarray(replace(unpacked, shape_params=shapes).pack(), np.float32)
