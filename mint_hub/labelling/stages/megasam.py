"""Camera path by MegaSaM (Li et al. 2025, arXiv 2412.04463), with its scale handed back.

MegaSaM divides depth by a factor of the scene before tracking, so that its path is in units that
differ from clip to clip. The factor is found again by comparing the depth it tracked with against
the metric depth that went in, pixel by pixel, wherever both are valid; the path comes out in metres
of that metric depth. This adapter was run on recorded files only, made to what MegaSaM's scripts
read and write, and not with the project itself, which needs an NVIDIA GPU.
"""

import os
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mint_hub.labelling.external import run_command, write_frames
from mint_hub.labelling.readiness import Lack, check, path_lacks, python_for, python_lacks
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
from mint_hub.labelling.stages.research import camera_path
from mint_hub.loaders.atomic import replacing

NEAREST: Final = 1e-2
"""Depth, in units of the path, that MegaSaM takes for none and turns into 0."""

_TRACK: Final = "camera_tracking_scripts/test_demo.py"
_MONO: Final = "Depth-Anything/run_videos.py"
_METRIC: Final = "UniDepth/scripts/demo_mega-sam.py"


@dataclass(frozen=True)
class MegaSamSettings:
    """Settings of `MegaSamCamera`.

    Attributes:
        checkout: folder of MegaSaM's repository, with its submodules.
        weights: its ``checkpoints/megasam_final.pth``; that of the checkout when empty.
        mono_weights: ``depth_anything_vitl14.pth``; that of the checkout when empty.
        python: the interpreter it was installed for.
        timeout_s: for each of its three steps.

    """

    checkout: str = field(default="", metadata=LOCAL)
    weights: str = field(default="", metadata=LOCAL)
    mono_weights: str = field(default="", metadata=LOCAL)
    python: str = field(default="", metadata=LOCAL)
    timeout_s: float = 7200.0


class MegaSamCamera:
    """Stage "camera", backend "megasam"."""

    stage: str = "camera"
    backend: str = "megasam"
    version: str = "1"
    needs: tuple[str, ...] = ("intrinsics",)
    gives: tuple[str, ...] = ("camera",)
    resources: Resources = Resources(cpus=2.0, gpus=1.0, memory_gib=16.0)

    def __init__(self, settings: MegaSamSettings | None = None) -> None:
        self.settings = settings or MegaSamSettings()

    def lacks(self) -> tuple[Lack, ...]:
        """Return what is missing for it to run."""
        settings = self.settings
        clone = "git clone --recursive https://github.com/mega-sam/mega-sam, and install it"
        have = path_lacks("checkout", settings.checkout, "MegaSaM", clone, _TRACK, _MONO, _METRIC)
        weights = path_lacks("weights", self._weights(), "MegaSaM's weights", clone)
        where = "depth_anything_vitl14.pth of huggingface.co/spaces/LiheYoung/Depth-Anything"
        mono = path_lacks("mono_weights", self._mono_weights(), "Depth-Anything's weights", where)
        return (*python_lacks(settings.python), *have, *weights, *mono)

    def close(self) -> None:
        """Nothing to end."""

    def run_clip(self, clip: Clip, video: Video) -> Outcome:
        """Track the camera through every frame, in metres.

        Raises:
            StageError: intrinsics are missing, a step fails, or its files are not as expected.
            NotReadyError: checkout, weights or interpreter are missing.

        """
        require(self, clip)
        check(self.lacks())
        with tempfile.TemporaryDirectory(prefix="mint-hub-megasam-") as folder:
            work = Path(folder)
            write_frames(clip, work / "frames" / clip.key)
            self._run(clip, work)
            output = work / "outputs" / f"{clip.key}_droid.npz"
            metric = read_metric_depth(work / "metric" / clip.key)
            path, numbers = read_output(output, metric, clip)
        return Outcome((reported(clip, report_of(self, **numbers), camera=path),))

    def _run(self, clip: Clip, work: Path) -> None:
        """Relative depth, metric depth, then tracking, as MegaSaM's README runs them."""
        settings = self.settings
        checkout = Path(settings.checkout).resolve()
        python = str(python_for(settings.python))
        frames = work / "frames" / clip.key
        mono, metric = work / "mono", work / "metric"
        limit = settings.timeout_s
        weights: list[str] = ["--load-from", self._mono_weights()]
        out = ["--img-path", str(frames), "--outdir", str(mono / clip.key)]
        command = [python, str(checkout / _MONO), "--encoder", "vitl", *weights, *out]
        run_command("megasam, Depth-Anything", command, checkout, timeout_s=limit)
        out = ["--img-path", str(frames), "--outdir", str(metric), "--scene-name", clip.key]
        command = [python, str(checkout / _METRIC), *out]
        modules = {"PYTHONPATH": str(checkout / "UniDepth")}
        run_command("megasam, UniDepth", command, checkout, environment=modules, timeout_s=limit)
        assert clip.intrinsics is not None
        give_fov(metric / clip.key, float(np.degrees(clip.intrinsics.fov_vh_rad[1])))
        command = [python, str(checkout / _TRACK), "--datapath", str(frames)]
        command += ["--weights", self._weights(), "--scene_name", clip.key, "--disable_vis"]
        command += ["--mono_depth_path", str(mono), "--metric_depth_path", str(metric)]
        modules = {"PYTHONPATH": str(checkout / "base" / "droid_slam")}
        run_command("megasam, tracking", command, work, environment=modules, timeout_s=limit)

    def _weights(self) -> str:
        return self.settings.weights or self._inside("checkpoints/megasam_final.pth")

    def _mono_weights(self) -> str:
        inside = "Depth-Anything/checkpoints/depth_anything_vitl14.pth"
        return self.settings.mono_weights or self._inside(inside)

    def _inside(self, name: str) -> str:
        checkout = self.settings.checkout
        return os.path.join(os.path.abspath(checkout), name) if checkout else ""


def read_metric_depth(folder: Path) -> NDArray[np.float32]:
    """Read the depth that UniDepth wrote, (T, h, w) metres: ``depth`` of an npz a frame.

    Raises:
        StageError: there is none, or a file is not as expected.

    """
    files = sorted(folder.glob("*.npz"))
    if not files:
        raise StageError(f"megasam: expected UniDepth's npz files, got none in {folder.name}")
    return np.stack([np.asarray(_load(file, "depth")["depth"], np.float32) for file in files])


def give_fov(folder: Path, fov_x_deg: float) -> None:
    """Put the known horizontal field of view, degrees, where MegaSaM reads UniDepth's guess."""
    for file in sorted(folder.glob("*.npz")):
        stored = _load(file, "depth", "fov")
        with replacing(file) as temporary, temporary.open("wb") as out:
            np.savez(out, depth=stored["depth"], fov=np.float64(fov_x_deg))


def read_output(
    file: Path, metric_depth: NDArray[np.float32], clip: Clip
) -> tuple[CameraPath, dict[str, Any]]:
    """Read what MegaSaM wrote and hand the scale back.

    Args:
        file: npz with ``cam_c2w`` (T, 4, 4) and ``depths`` (T, h, w), both in units of its own, and
            ``intrinsic`` (3, 3).
        metric_depth: (T, h', w') metres, what it tracked with before it was divided.
        clip: whose path it is.

    Returns:
        The path in metres, and numbers for the report.

    Raises:
        StageError: the file is not as expected, or no pixel tells the scale.

    """
    stored = _load(file, "cam_c2w", "depths", "intrinsic")
    metres, spread, pixels = metres_per_unit(stored["depths"], metric_depth)
    poses = np.array(stored["cam_c2w"], np.float64)
    if poses.ndim == 3:
        poses[:, :3, 3] *= metres
    path = camera_path(poses, clip, "megasam", metric=True)
    numbers = {
        "metres_per_unit": metres,
        "log_spread": spread,
        "pixels": pixels,
        "focal_px": [float(stored["intrinsic"][0, 0]), float(stored["intrinsic"][1, 1])],
    }
    return path, numbers


def metres_per_unit(depths: NDArray[Any], metric_depth: NDArray[Any]) -> tuple[float, float, int]:
    """Factor from units of the path to metres: median log ratio over pixels where both are valid.

    Args:
        depths: (T, h, w) in units of the path; its sides were cut to multiples of 8. Values at or
            below `NEAREST` are holes, not depth.
        metric_depth: (T', h', w') metres; not finite or not positive is a hole.

    Returns:
        The factor, 1.4826 MAD of the log ratios, and how many pixels told.

    Raises:
        StageError: none did.

    """
    count = min(len(depths), len(metric_depth))
    own = np.asarray(depths[:count], np.float64)
    rows = ((np.arange(own.shape[1]) + 0.5) * metric_depth.shape[1] / own.shape[1]).astype(int)
    columns = ((np.arange(own.shape[2]) + 0.5) * metric_depth.shape[2] / own.shape[2]).astype(int)
    metric = np.asarray(metric_depth[:count], np.float64)[:, rows][:, :, columns]
    valid = np.isfinite(own) & (own > NEAREST) & np.isfinite(metric) & (metric > 0)
    if not valid.any():
        raise StageError("megasam: expected valid depth somewhere, got holes only")
    logs = np.log(metric[valid] / own[valid])
    middle = float(np.median(logs))
    spread = 1.4826 * float(np.median(np.abs(logs - middle)))
    return float(np.exp(middle)), spread, int(valid.sum())


def _load(file: Path, *names: str) -> dict[str, NDArray[Any]]:
    try:
        with np.load(file, allow_pickle=False) as stored:
            return {name: stored[name] for name in names}
    except (OSError, ValueError, KeyError, EOFError) as error:
        raise StageError(
            f"megasam: expected {', '.join(names)} in {file.name}, got {error}"
        ) from error
