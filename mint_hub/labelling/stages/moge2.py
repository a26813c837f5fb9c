"""Metric depth by MoGe-2 (Wang et al. 2025, arXiv 2507.02546), as evidence for the scale.

Depth maps of frames spread over a clip are kept beside its video; `metric_scale` compares them with
the map points of the camera path. Pixels that MoGe masks out are NaN, never 0. This adapter was run
on recorded results only, made to what MoGe's interface documents, and not with the project itself.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mint_hub.labelling.frames import clip_pictures
from mint_hub.labelling.readiness import Lack, path_lacks
from mint_hub.labelling.records import Clip, Video
from mint_hub.labelling.stage import LOCAL, Outcome, Resources, StageError, report_of, reported
from mint_hub.labelling.stages.geocalib import spread
from mint_hub.labelling.stages.research import ResearchStage
from mint_hub.loaders.atomic import replacing


@dataclass(frozen=True)
class MogeSettings:
    """Settings of `MogeDepth`.

    Attributes:
        weights: MoGe-2's ``model.pt``.
        checkout: folder of MoGe's repository; not needed where ``python`` has moge installed.
        frames: how many of a clip, spread evenly.
        height: rows of the maps that are kept.
        device: "cuda", "cpu", or whichever there is when empty.
        python: the interpreter that has MoGe's requirements.
        timeout_s: for all frames of a clip.

    """

    weights: str = field(default="", metadata=LOCAL)
    checkout: str = field(default="", metadata=LOCAL)
    frames: int = 8
    height: int = 192
    device: str = ""
    python: str = field(default="", metadata=LOCAL)
    timeout_s: float = 1800.0


class MogeDepth(ResearchStage):
    """Stage "depth", backend "moge2"."""

    stage: str = "depth"
    backend: str = "moge2"
    version: str = "1"
    needs: tuple[str, ...] = ("intrinsics",)
    gives: tuple[str, ...] = ("reports",)
    resources: Resources = Resources(cpus=1.0, gpus=0.5, memory_gib=6.0)

    def __init__(self, settings: MogeSettings | None = None) -> None:
        self.settings = settings or MogeSettings()

    def files_lack(self) -> tuple[Lack, ...]:
        """Return what is missing of the user's files."""
        settings = self.settings
        hub = "model.pt of huggingface.co/Ruicheng/moge-2-vitl (mind its licence)"
        clone = "git clone https://github.com/microsoft/MoGe"
        checkout: tuple[Lack, ...] = ()
        if settings.checkout:
            checkout = path_lacks("checkout", settings.checkout, "MoGe", clone, "moge")
        return (*path_lacks("weights", settings.weights, "MoGe-2's weights", hub), *checkout)

    def run_clip(self, clip: Clip, video: Video) -> Outcome:
        """Estimate depth of some frames and name the file in ``numbers["depth_maps"]``.

        The file has ``timestamps_s`` (K,), source times, and ``depth_m`` (K, h, w).

        Raises:
            StageError: MoGe fails, or its depth is invalid everywhere.
            NotReadyError: weights, checkout or interpreter are missing.

        """
        settings = self.settings
        ((_, frames),) = spread([clip], settings.frames)
        fov = clip.intrinsics.fov_vh_rad[1] if clip.intrinsics else 0.0
        arrays, _ = self.call(
            "moge2",
            {"images": clip_pictures(clip, frames)},
            checkout=settings.checkout,
            weights=settings.weights,
            fov_x_deg=float(np.degrees(fov)),
            height=settings.height,
            device=settings.device,
        )
        depth = masked(arrays["depth_m"])
        valid = np.isfinite(depth)
        if not valid.any():
            raise StageError("moge2: depth is invalid everywhere")
        path = depth_path(clip)
        times = clip.source_timestamps_s[frames]
        with replacing(path) as temporary, temporary.open("wb") as file:
            np.savez(file, timestamps_s=times, depth_m=depth)
        report = report_of(
            self,
            depth_maps=str(path),
            frames=frames,
            valid=float(valid.mean()),
            median_m=float(np.median(depth[valid])),
        )
        return Outcome((reported(clip, report),))


def masked(depth: NDArray[Any]) -> NDArray[np.float32]:
    """Depth (K, h, w) with everything that is no depth as NaN."""
    depth = depth.astype(np.float32)
    return np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(np.nan))


def depth_path(clip: Clip) -> Path:
    """Where the maps of a clip are: beside its video."""
    return clip.video.parent / f"{clip.key}.depth.npz"
