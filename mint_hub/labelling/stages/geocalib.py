"""Intrinsics and gravity by GeoCalib (Veicht et al. 2024, arXiv 2409.06704).

One pinhole is fitted to pictures spread over the video. This adapter was run on recorded results
only, made to what GeoCalib's README and interface document, and not with the project itself.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from mint_hub.geometry.camera import K_to_fov_vh
from mint_hub.labelling.environments import Environment
from mint_hub.labelling.frames import clip_pictures
from mint_hub.labelling.readiness import Lack, path_lacks
from mint_hub.labelling.records import Clip, Intrinsics, Video
from mint_hub.labelling.stage import LOCAL, Resources, StageError, report_of
from mint_hub.labelling.stages.research import ResearchStage

_SURE: Final = 0.02
"""A focal this sure, as a share of itself, has confidence 1/2."""


@dataclass(frozen=True)
class GeoCalibSettings:
    """Settings of `GeoCalibIntrinsics`.

    Attributes:
        checkout: folder of GeoCalib's repository.
        weights: its ``geocalib-pinhole.tar``.
        pictures: how many are looked at, spread evenly (20 is one every 5 %).
        device: "cuda", "cpu", or whichever there is when empty.
        python: an interpreter that has GeoCalib's requirements, instead of one made for it.
        timeout_s: for all pictures.

    """

    checkout: str = field(default="", metadata=LOCAL)
    weights: str = field(default="", metadata=LOCAL)
    pictures: int = 20
    device: str = ""
    python: str = field(default="", metadata=LOCAL)
    timeout_s: float = 1800.0


class GeoCalibIntrinsics(ResearchStage):
    """Stage "intrinsics", backend "geocalib"."""

    stage: str = "intrinsics"
    backend: str = "geocalib"
    version: str = "1"
    needs: tuple[str, ...] = ()
    gives: tuple[str, ...] = ("intrinsics",)
    resources: Resources = Resources(cpus=1.0, gpus=0.25, memory_gib=4.0)
    environment = Environment(
        "geocalib",
        ("torch>=2.0", "torchvision", "opencv-python-headless", "kornia", "matplotlib", "numpy"),
        ("torch", "torchvision", "cv2", "kornia", "matplotlib"),
    )

    def __init__(self, settings: GeoCalibSettings | None = None) -> None:
        self.settings = settings or GeoCalibSettings()

    def files_lack(self) -> tuple[Lack, ...]:
        """Return what is missing of the user's files."""
        settings = self.settings
        clone = "git clone https://github.com/cvg/GeoCalib"
        release = "geocalib-pinhole.tar of github.com/cvg/GeoCalib/releases/tag/v1.0"
        return (
            *path_lacks("checkout", settings.checkout, "GeoCalib", clone, "geocalib"),
            *path_lacks("weights", settings.weights, "GeoCalib's weights", release),
        )

    def run_video(self, video: Video) -> Video:
        """Give every clip the same pinhole; gravity of the pictures goes into the report.

        Raises:
            StageError: GeoCalib fails, or its answer is no focal length.
            NotReadyError: checkout, weights or environment are missing.

        """
        if not video.clips:
            return video
        picked = spread(video.clips, self.settings.pictures)
        images = np.concatenate([clip_pictures(clip, frames) for clip, frames in picked])
        arrays, _ = self.call(
            "geocalib",
            {"images": images},
            checkout=self.settings.checkout,
            weights=self.settings.weights,
            device=self.settings.device,
        )
        size_hw = (int(images.shape[1]), int(images.shape[2]))
        intrinsics = to_intrinsics(arrays["focal"], arrays["focal_uncertainty"], size_hw)
        at = [float(clip.source_timestamps_s[f]) for clip, frames in picked for f in frames]
        report = report_of(
            self,
            focal_px=float(np.median(arrays["focal"][:, 1])),
            focal_uncertainty_px=float(np.median(arrays["focal_uncertainty"])),
            gravity_at_s=at,
            gravity_camera=arrays["gravity"].tolist(),
        )
        clips = tuple(replace(clip, intrinsics=intrinsics) for clip in video.clips)
        return replace(video, clips=clips, reports=(*video.reports, report))


def to_intrinsics(
    focal: NDArray[np.float64], uncertainty: NDArray[np.float64], size_hw: tuple[int, int]
) -> Intrinsics:
    """Make intrinsics of focals (N, 2) = (fx, fy) and their uncertainty (N,), pixels of size_hw.

    Confidence is 1 / (1 + (relative uncertainty / 2 %)^2).

    Raises:
        StageError: a focal that is not positive and finite.

    """
    height, width = size_hw
    fx, fy = (float(x) for x in np.median(focal, axis=0))
    if not (np.isfinite([fx, fy]).all() and min(fx, fy) > 0):
        raise StageError(f"geocalib: expected positive focal lengths, got {fx:g} and {fy:g}")
    K = np.array([[fx, 0, width / 2], [0, fy, height / 2], [0, 0, 1.0]])
    vertical, horizontal = (float(x) for x in K_to_fov_vh(K, size_hw))
    relative = float(np.median(uncertainty)) / fy
    confidence = 1 / (1 + (relative / _SURE) ** 2) if np.isfinite(relative) else 0.0
    return Intrinsics((vertical, horizontal), "geocalib", confidence)


def spread(clips: Sequence[Clip], count: int) -> list[tuple[Clip, list[int]]]:
    """Up to ``count`` frames spread evenly over clips laid end to end, grouped by clip."""
    ends = np.cumsum([clip.num_frames for clip in clips])
    total = int(ends[-1])
    wanted = ((np.arange(min(count, total)) + 0.5) * total / min(count, total)).astype(int)
    begins = np.concatenate([[0], ends[:-1]])
    groups: list[tuple[Clip, list[int]]] = []
    for clip, begin, end in zip(clips, begins, ends, strict=True):
        inside = wanted[(wanted >= begin) & (wanted < end)] - begin
        if len(inside):
            groups.append((clip, [int(f) for f in inside]))
    return groups
