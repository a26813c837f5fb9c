"""Intrinsics that the user knows: a field of view, a focal length, K, or a whole lens."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mint_hub.geometry.camera import K_to_fov_vh
from mint_hub.geometry.lenses import PinholeLens, lens_from
from mint_hub.labelling.records import Intrinsics, Video
from mint_hub.labelling.stage import Resources, report_of

CENTRED_PX = 1.0
"""A principal point this near the middle, at the size it was given for, is in the middle."""


@dataclass(frozen=True)
class GivenIntrinsicsSettings:
    """Settings of `GivenIntrinsics`; exactly one is given.

    Attributes:
        fov_deg: horizontal field of view of a pinhole with square pixels.
        focal_px: focal length at the source video's own size.
        lens: whatever else `geometry.lenses.lens_from` takes as a mapping, as nested lists and
            numbers: ``{"K": [[...], ...]}``, or a lens model with distortion.

    """

    fov_deg: float | None = None
    focal_px: float | None = None
    lens: dict[str, Any] | None = None


class GivenIntrinsics:
    """The user's camera for every clip of the video."""

    stage: str = "intrinsics"
    backend: str = "given"
    version: str = "1"
    needs: tuple[str, ...] = ()
    gives: tuple[str, ...] = ("intrinsics",)
    resources: Resources = Resources(cpus=0.1, memory_gib=0.1)

    def __init__(self, settings: GivenIntrinsicsSettings | None = None) -> None:
        """Raise ValueError unless exactly one thing is given, and believable."""
        self._settings = settings or GivenIntrinsicsSettings()
        given = {name: value for name, value in vars(self.settings).items() if value is not None}
        if len(given) != 1:
            raise ValueError(
                f"intrinsics (given): expected one of fov_deg, focal_px and lens, got "
                f"{', '.join(given) or 'none'}"
            )
        fov, focal = self.settings.fov_deg, self.settings.focal_px
        if fov is not None and not 0 < fov < 180:
            raise ValueError(f"fov_deg: expected degrees between 0 and 180, got {fov:g}")
        if focal is not None and not 0 < focal < float("inf"):
            raise ValueError(f"focal_px: expected positive pixels, got {focal:g}")

    @property
    def settings(self) -> GivenIntrinsicsSettings:
        """See `GivenIntrinsicsSettings`."""
        return self._settings

    def close(self) -> None:
        """Nothing to end."""

    def run_video(self, video: Video) -> Video:
        """Give the clips what the user gave.

        A lens that is more than a centred pinhole is recorded for the undistort stage; the field
        of view is then that of the pinhole with its focal lengths and the same image size.

        Raises:
            ValueError: a lens that cannot be read, or of another aspect ratio.

        """
        intrinsics = self._of(video.image_size_hw)
        numbers = {"fov_vh_deg": [float(np.degrees(x)) for x in intrinsics.fov_vh_rad]}
        report = report_of(self, **numbers)
        clips = tuple(replace(clip, intrinsics=intrinsics) for clip in video.clips)
        return replace(video, clips=clips, reports=(*video.reports, report))

    def _of(self, image_size_hw: tuple[int, int]) -> Intrinsics:
        height, width = image_size_hw
        settings = self.settings
        if settings.fov_deg is not None:
            spec: dict[str, Any] = {"f": width / 2 / np.tan(np.radians(settings.fov_deg) / 2)}
        elif settings.focal_px is not None:
            spec = {"f": settings.focal_px}
        else:
            assert settings.lens is not None
            spec = settings.lens
        lens = lens_from(spec, image_size_hw)
        K = np.array([[lens.fx, 0, width / 2], [0, lens.fy, height / 2], [0, 0, 1.0]])
        vertical, horizontal = (float(x) for x in K_to_fov_vh(K, image_size_hw))
        off = max(abs(lens.cx - (width - 1) / 2), abs(lens.cy - (height - 1) / 2))
        plain = isinstance(lens, PinholeLens) and off <= CENTRED_PX
        return Intrinsics((vertical, horizontal), "given", 1.0, None if plain else lens.to_dict())
