"""Stage "stitch": clips that share frames are brought into one world and become one longer clip."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from mint_hub.geometry.camera import fov_vh_to_K
from mint_hub.labelling.records import Clip, Video
from mint_hub.labelling.stage import Resources, report_of, reported, require
from mint_hub.labelling.stages.sfm_points import MapPoints, points_of
from mint_hub.labelling.stages.stitch_join import joined
from mint_hub.labelling.stages.stitch_poses import (
    EXACT,
    Alignment,
    ScaleRatio,
    alignment,
    pooled,
    scale_from_depths,
    scale_from_travel,
)
from mint_hub.labelling.stages.timeline import place

NOTHING: Final = "they share no frames"
FEW: Final = "too few shared frames with a solved camera"
SCALE: Final = "the scale between them is uncertain"
APART: Final = "their paths disagree over the frames they share"
METRIC: Final = "one path is metric, the other is not"
MODELS: Final = "their hands are of different models"
LONG: Final = "long enough"

_SAME_PX: Final = 2.0
_MAP_FRAMES: Final = 6

Float64 = NDArray[np.float64]


class Stitch:
    """Joins clips from left to right, each by all the frames it shares with what came before.

    The later world is turned, moved and, unless both are metric, scaled into the earlier one (the
    scale from the cameras' travel and from the depths of map points that both know); over the
    shared frames cameras and hands are blended with a ramp, hands by their scores too. Clips whose
    paths disagree, or whose scale cannot be told, stay two worlds, both with the frames they
    share; the report of the later one says why.

    The ``video`` and ``first_frame`` of a joined clip are those of its first piece, whose file ends
    before the clip does. Its report lists all pieces; whoever needs pixels of the whole clip reads
    the source video at ``source_timestamps_s``.
    """

    stage, backend, version = "stitch", "default", "1"
    needs, gives = ("camera",), ("camera", "hands", "detections")
    resources = Resources(cpus=1)

    @dataclass(frozen=True)
    class Settings:
        """When two clips may be joined.

        Attributes:
            min_frames: shared frames, solved in both, at least.
            max_rotation_deg: median angle between their cameras once aligned, at most.
            max_offset: median distance between them, at most: metres, or units of the path, one of
                which is about as long as the scene is deep.
            max_log_sigma: uncertainty of the scale between them, at most.
            apart_m: hands of one frame that are further apart are not averaged: one is taken.
            max_s: a joined clip of this length is not continued, seconds.

        """

        min_frames: int = 5
        max_rotation_deg: float = 1.0
        max_offset: float = 0.03
        max_log_sigma: float = 0.05
        apart_m: float = 0.15
        max_s: float = 300.0

    def __init__(self, settings: Settings | None = None) -> None:
        self.settings = settings or self.Settings()

    def run_video(self, video: Video) -> Video:
        """Join what can be joined.

        Raises:
            StageError: a clip has no camera path.

        """
        for clip in video.clips:
            require(self, clip)
        worlds: list[_World] = []
        for clip in sorted(video.clips, key=lambda clip: (clip.start_s, clip.key)):
            why = worlds[-1].add(clip) if worlds else ""
            if why is not None:
                worlds.append(_World(clip, self.settings, why))
        clips = tuple(reported(world.clip, report_of(self, **world.numbers())) for world in worlds)
        apart = Counter(world.apart for world in worlds[1:])
        report = report_of(self, clips=len(clips), apart=dict(apart))
        return replace(video, clips=clips, reports=(*video.reports, report))

    def close(self) -> None:
        """Nothing to end."""


class _World:
    """Clips joined so far.

    Attributes:
        clip: all of them as one.
        apart: why it was not joined to the world before.

    """

    def __init__(self, first: Clip, settings: Stitch.Settings, apart: str) -> None:
        self.clip = first
        self.apart = apart
        self._settings = settings
        self._seams: list[dict[str, Any]] = []
        self._pieces = [_piece(first, 0)]

    def add(self, later: Clip) -> str | None:
        """Join a clip that begins later; return why not, None when it was."""
        s = self._settings
        offset = place(later, self.clip.start_s) - place(self.clip, self.clip.start_s)
        shared = self.clip.num_frames - offset
        if shared <= 0 or offset < 0:
            return NOTHING
        if shared >= later.num_frames:
            return FEW  # it adds no frame
        if self.clip.num_frames >= s.max_s * self.clip.fps:
            return LONG
        found = self._alignment(later, offset, shared)
        if isinstance(found, str):
            return found
        self._seams.append(
            {
                "frame": offset,
                "shared": shared,
                "scale": found.scale,
                "log_sigma": round(found.log_sigma, 5),
                "rotation_deg": round(found.rotation_deg, 4),
                "translation": round(found.translation, 5),
            }
        )
        self._pieces.append(_piece(later, offset))
        self.clip = joined(self.clip, later, offset, found, s.apart_m)
        return None

    def numbers(self) -> dict[str, Any]:
        """For the report of the joined clip."""
        return {"pieces": self._pieces, "seams": self._seams, "apart": self.apart}

    def _alignment(self, later: Clip, offset: int, shared: int) -> Alignment | str:
        """How the later clip lies in this world, or why nobody can tell."""
        s = self._settings
        a, b = self.clip.camera, later.camera
        assert a is not None
        assert b is not None
        if a.metric != b.metric:
            return METRIC
        if _hand_kind(self.clip) != _hand_kind(later):
            return MODELS
        solved = a.solved[offset:] & b.solved[:shared]
        if solved.sum() < s.min_frames:
            return FEW
        poses = a.T_camera_from_world[offset:][solved], b.T_camera_from_world[:shared][solved]
        if a.metric:
            ratio = EXACT
        else:
            by_depth = scale_from_maps(self.clip, later, np.flatnonzero(solved))
            known = [scale_from_travel(*poses), *([by_depth] if by_depth else [])]
            ratio = pooled(known)
            if ratio.log_sigma > s.max_log_sigma:
                return SCALE
        found = alignment(*poses, ratio)
        if found.rotation_deg > s.max_rotation_deg or found.translation > s.max_offset:
            return APART
        return found


def _piece(clip: Clip, frame: int) -> dict[str, Any]:
    return {
        "key": clip.key,
        "file": clip.video.name,
        "first_frame": clip.first_frame,
        "frame": frame,
        "frames": clip.num_frames,
    }


def _hand_kind(clip: Clip) -> tuple[str, str] | None:
    return None if clip.hands is None else (clip.hands.shape_space, clip.hands.hand_model)


def scale_from_maps(earlier: Clip, later: Clip, frames: NDArray[np.intp]) -> ScaleRatio | None:
    """Units of the earlier path per unit of the later one, by the depths of common map points.

    Points of both maps that are seen within two pixels of each other in one frame are taken for the
    same.

    Args:
        earlier: a clip whose reports name map points.
        later: one that begins within it.
        frames: frames of ``later`` that both clips show; a handful of them is looked at.

    Returns:
        None where maps are missing or share too little.

    """
    maps = points_of(earlier), points_of(later)
    if earlier.intrinsics is None or later.intrinsics is None or not all(maps):
        return None
    picked = frames[np.linspace(0, len(frames) - 1, min(len(frames), _MAP_FRAMES)).astype(int)]
    depths: tuple[list[Float64], list[Float64]] = ([], [])
    for time_s in later.source_timestamps_s[picked]:
        seen = [_seen(c, m, float(time_s)) for c, m in zip((earlier, later), maps, strict=True)]
        if seen[0] is None or seen[1] is None:
            continue
        (uv_a, depth_a), (uv_b, depth_b) = seen[0], seen[1]
        distance, nearest = KDTree(uv_a).query(uv_b)
        same = np.asarray(distance) <= _SAME_PX
        depths[0].append(depth_a[np.asarray(nearest)[same]])
        depths[1].append(depth_b[same])
    if not depths[0]:
        return None
    return scale_from_depths(np.concatenate(depths[0]), np.concatenate(depths[1]))


def _seen(clip: Clip, maps: Sequence[MapPoints], time_s: float) -> tuple[Float64, Float64] | None:
    """Pixels (N, 2) and depths (N,), in units of the clip's path, of points seen at a time."""
    assert clip.intrinsics is not None
    K = fov_vh_to_K(np.array(clip.intrinsics.fov_vh_rad, np.float64), clip.image_size_hw)
    for points in maps:
        frame = points.frame_at(time_s, 0.5 / clip.fps)
        units = points.units_of(clip) if frame is not None else None
        if frame is not None and units is not None:
            uv, depth = points.seen_near(frame, round(clip.fps / 2), K)
            if len(uv):
                return uv, depth * units
    return None
