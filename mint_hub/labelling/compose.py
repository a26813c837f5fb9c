"""From the last clip record to the record of the project: `Episode`."""

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from mint_hub._version import __version__
from mint_hub.geometry import hand_state
from mint_hub.labelling.records import Clip, Scale, StageReport, Video
from mint_hub.labelling.stage import StageError
from mint_hub.loaders.schema import Episode

_SCALE_WORDS: Final = {
    "given": "pseudo-label; metres from a factor that the user gave",
    "length": "pseudo-label; metres from a length that the user knew",
    "depth": "pseudo-label; metres from monocular depth",
    "hands": "pseudo-label; metres only as far as the size of the hands tells",
    "camera": "pseudo-label; metres as the camera backend has them",
    "none": "pseudo-label; not metric, scale unknown",
}


def episode_of(clip: Clip, video: Video) -> Episode:
    """Compose a clip that went through the whole cascade.

    Times are constant-rate from the clip's first source time on; the exact source times are kept
    in ``meta["source_timestamps_s"]``. Provenance holds every stage's report.

    Raises:
        StageError: names what the clip lacks.
        EpisodeError: what the stages found is not a valid episode.

    """
    for name in ("intrinsics", "camera", "hands"):
        if getattr(clip, name) is None:
            raise StageError(f"compose: expected {name} of clip {clip.key}, got none")
    assert clip.intrinsics is not None
    assert clip.camera is not None
    assert clip.hands is not None
    hands, frames = clip.hands, clip.num_frames
    absent = np.asarray(hand_state.absent((frames, 2)), np.float32)
    start_s = clip.start_s
    meta: dict[str, Any] = {
        "source": video.source,
        "uid": video.uid,
        "fps": clip.fps,
        "native_fps": video.fps,
        "source_timestamps_s": clip.source_timestamps_s.tolist(),
        "conventions": "camera: world-to-camera, OpenCV axes; hands: camera frame",
        "scale_status": scale_words(clip.scale),
        "shape_space": hands.shape_space,
        "hand_model": hands.hand_model,
        "pipeline": f"EgoPipeline of mint-hub {__version__}",
        "quality": quality(clip),
        "provenance": {
            "file": video.path.name,
            "stages": [_told(report) for report in (*video.reports, *clip.reports)],
            "scale": None if clip.scale is None else asdict(clip.scale),
        },
    }
    if clip.intrinsics.lens is not None:
        meta["lens"] = clip.intrinsics.lens
    fov = np.asarray(clip.intrinsics.fov_vh_rad, np.float32)
    return Episode(
        key=clip.key,
        timestamps_s=start_s + np.arange(frames) / clip.fps,
        T_camera_from_world=clip.camera.T_camera_from_world,
        fov_vh_rad=np.tile(fov, (frames, 1)),
        hand_state=np.where(hands.presence[..., None], hands.hand_state, absent),
        presence=hands.presence,
        presence_score=hands.score.astype(np.float32),
        filled=hands.filled & hands.presence,
        image_size_hw=clip.image_size_hw,
        text=clip.text,
        meta=meta,
    )


def _told(report: StageReport) -> dict[str, Any]:
    """A report without the places of this machine that later stages needed."""
    here = {k for k, v in report.numbers.items() if isinstance(v, str) and Path(v).is_absolute()}
    kept = {k: v for k, v in report.numbers.items() if k not in here}
    return asdict(replace(report, numbers=kept))


def scale_words(scale: Scale | None) -> str:
    """Say whose metres the lengths are, for ``meta["scale_status"]``."""
    if scale is None:
        return _SCALE_WORDS["none"]
    words = _SCALE_WORDS[scale.source]
    if scale.source == "none":
        return words
    return f"{words} (confidence {scale.confidence:.2f})"


def quality(clip: Clip) -> dict[str, Any]:
    """What the checks of the stages say, in plain numbers."""
    assert clip.camera is not None
    assert clip.hands is not None
    observed = clip.hands.presence & ~clip.hands.filled
    residual = clip.hands.residual_px[observed & np.isfinite(clip.hands.residual_px)]
    return {
        "camera_solved": round(float(clip.camera.solved.mean()), 4),
        "camera_residual_px": _number(clip.camera.residual_px, 4),
        "covisible_min": _number(clip.camera.covisible.min(), 1),
        "hands_observed": [round(float(v), 4) for v in observed.mean(axis=0)],
        "hands_filled": [round(float(v), 4) for v in clip.hands.filled.mean(axis=0)],
        "hands_residual_px": _number(np.median(residual), 3) if residual.size else None,
    }


def _number(value: Any, digits: int) -> float | None:
    """A number as JSON has it: None where the backend does not tell (NaN)."""
    return round(float(value), digits) if np.isfinite(value) else None
