"""Stage "undistort": what a lens bent is straightened; later stages and labels see a pinhole."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mint_hub.geometry.camera import K_to_fov_vh, fov_vh_to_K, project
from mint_hub.geometry.lenses import Lens, Rectification, lens_from, rectification
from mint_hub.labelling.frames import clip_frames
from mint_hub.labelling.records import Clip, Detections, Intrinsics, Video
from mint_hub.labelling.stage import Outcome, Resources, report_of, reported
from mint_hub.loaders.atomic import replacing
from mint_hub.loaders.clips import encode_clip

Float64 = NDArray[np.float64]

_EDGE_POINTS = 8


class Undistort:
    """Re-encodes a clip as a pinhole would have taken it, and moves its detections along.

    The lens is the one of the settings, else the one that the intrinsics stage recorded; without
    either the clip stays as it is. So do its pictures where the lens moves no pixel by more than
    ``material_px``; the focal length is then the lens's all the same. The pinhole has the lens's
    focal lengths, its principal point in the middle, and the clip's size: what a very wide lens
    sees beyond that is cut off. The new file lies beside the old one.
    """

    stage, backend, version = "undistort", "default", "1"
    needs, gives = (), ("intrinsics", "detections")
    resources = Resources(cpus=1)

    @dataclass(frozen=True)
    class Settings:
        """Which lens, and when it matters.

        Attributes:
            lens: what `geometry.lenses.lens_from` takes, as plain JSON, for the source video's own
                size unless it says another; None is the lens that the intrinsics stage recorded.
            material_px: displacement, in pixels of the clip, up to which nothing is done.
            crf: x264's quality, 0 (best) to 51.

        """

        lens: dict[str, Any] | None = None
        material_px: float = 1.0
        crf: int = 18

    def __init__(self, settings: Settings | None = None) -> None:
        self.settings = settings or self.Settings()

    def run_clip(self, clip: Clip, video: Video) -> Outcome:
        """Straighten one clip.

        Raises:
            ValueError: a lens that cannot be read, or of another aspect ratio than the video.
            StageError, VideoError: the clip's file cannot be read.

        """
        lens = self._lens(clip, video)
        if lens is None:
            return Outcome((reported(clip, report_of(self, changed=False)),))
        own = lens_from(lens, clip.image_size_hw)
        to_pinhole = _rectification(own)
        moved_px = displacement_px(to_pinhole)
        changed = moved_px > self.settings.material_px
        vertical, horizontal = (
            float(x) for x in K_to_fov_vh(to_pinhole.K, to_pinhole.image_size_hw)
        )
        record = lens.to_dict() if changed else None  # nothing was taken out unless changed
        pinhole = Intrinsics((vertical, horizontal), "lens", 1.0, record)
        changes: dict[str, Any] = {"intrinsics": pinhole}
        if changed:
            path = clip.video.with_name(f"{clip.key}.undistorted.mp4")
            mp4 = encode_clip(_straight(clip, to_pinhole), fps=clip.fps, crf=self.settings.crf)
            with replacing(path) as temporary:
                temporary.write_bytes(mp4)
            changes |= {"video": path, "first_frame": 0}
            if clip.detections is not None:
                changes["detections"] = straightened(clip.detections, own)
        report = report_of(
            self,
            changed=changed,
            displacement_px=round(moved_px, 3),
            seen=round(float(to_pinhole.valid.mean()), 4),
        )
        return Outcome((reported(clip, report, **changes),))

    def close(self) -> None:
        """Nothing to end."""

    def _lens(self, clip: Clip, video: Video) -> Lens | None:
        """Return the lens at the size of the source video."""
        if self.settings.lens is not None:
            return lens_from(self.settings.lens, video.image_size_hw)
        if clip.intrinsics is None or clip.intrinsics.lens is None:
            return None
        return lens_from(Lens.from_dict(clip.intrinsics.lens), video.image_size_hw)


@lru_cache(maxsize=2)
def _rectification(lens: Lens) -> Rectification:
    return rectification(lens)


def displacement_px(to_pinhole: Rectification) -> float:
    """How far the pixel that is moved farthest moves; infinite where the lens sees nothing."""
    if not to_pinhole.valid.any():
        return float("inf")
    rows, columns = np.nonzero(to_pinhole.valid)
    dx = to_pinhole.map_x[rows, columns] - columns
    dy = to_pinhole.map_y[rows, columns] - rows
    return float(np.hypot(dx, dy).max())


def straightened(found: Detections, lens: Lens) -> Detections:
    """Move detections from pictures of a lens into those of its pinhole.

    Landmarks that the pinhole cannot see are NaN. Boxes bound what their border became; detections
    whose box is not in the picture any more are dropped. Points in metres are about their own
    centre and stay.
    """
    height, width = lens.image_size_hw
    share = np.linspace(0, 1, _EDGE_POINTS)[:, None]
    x0, y0, x1, y1 = found.box_xyxy.astype(np.float64).T
    corners = np.stack([[x0, y0], [x1, y0], [x1, y1], [x0, y1]]).transpose(2, 0, 1)
    sides = corners[:, :, None] * (1 - share) + np.roll(corners, -1, 1)[:, :, None] * share
    border = straight_uv(sides.reshape(len(corners), 4 * _EDGE_POINTS, 2), lens)
    low = np.where(np.isfinite(border), border, np.inf).min(1, initial=np.inf)
    high = np.where(np.isfinite(border), border, -np.inf).max(1, initial=-np.inf)
    inside = ((low < (width, height)) & (high > 0)).all(1)
    return Detections(
        frame=found.frame[inside],
        box_xyxy=np.concatenate([low, high], 1)[inside].astype(np.float32),
        score=found.score[inside],
        right_score=found.right_score[inside],
        landmarks_uv=straight_uv(found.landmarks_uv[inside].astype(np.float64), lens).astype(
            np.float32
        ),
        landmarks_m=found.landmarks_m[inside],
    )


def straight_uv(uv: Float64, lens: Lens) -> Float64:
    """Where pixels (..., 2) of a lens are in its pinhole's picture; NaN where nowhere.

    Pixels count from the picture's upper left corner, lenses from the middle of its first pixel.
    """
    rays = np.asarray(lens.unproject(uv - 0.5), np.float64)
    to_pinhole = _rectification(lens)
    fov = K_to_fov_vh(to_pinhole.K, to_pinhole.image_size_hw)
    return np.asarray(project(rays, fov_vh_to_K(fov, to_pinhole.image_size_hw))[0])


def _straight(clip: Clip, to_pinhole: Rectification) -> Iterator[NDArray[np.uint8]]:
    for image in clip_frames(clip):
        yield np.asarray(to_pinhole.apply(image), np.uint8)
