"""The clip as an interactive 3-D scene for the rerun viewer (``rerun file.rrd``)."""

from os import PathLike
from pathlib import Path
from types import ModuleType
from typing import Any, Final

import numpy as np

from mint_hub.conventions import KEYPOINT_BONES, SIDES
from mint_hub.geometry.hand_model import HandModel
from mint_hub.loaders.atomic import replacing
from mint_hub.loaders.schema import Episode
from mint_hub.view.canvas import CAMERA, SIDE_COLORS, runs
from mint_hub.view.overlay import FINGER_COLORS

TIMELINE: Final = "video"


class MissingExtraError(ImportError):
    """An optional part of mint-hub is not installed; the message says how to install it."""


def write_rrd(
    episode: Episode,
    path: str | PathLike[str],
    video: str | PathLike[str] | None = None,
    hand_model: HandModel | None = None,
) -> Path:
    """Write a rerun recording of camera, hands, presence and text; return its path.

    The timeline is presentation time. The world has the axes of the first camera (x right, y down,
    z forward). The video file is embedded as it is, and shown in the camera's image plane where the
    episode has no ``meta["lens"]`` (whose video would have to be rectified first).

    Args:
        episode: what to show.
        path: where to write; must end in .rrd.
        video: file of the source video, mp4.
        hand_model: as in ``Episode.joints_camera``.

    Raises:
        MissingExtraError: an ImportError; rerun is not installed.
        FileNotFoundError: there is no such video.
        ValueError: the path does not end in .rrd.

    """
    path = Path(path)
    if path.suffix.lower() != ".rrd":
        raise ValueError(f"{path}: expected a name that ends in .rrd")
    if video is not None and not Path(video).is_file():
        raise FileNotFoundError(f"{video}: expected a video file")
    rr = import_rerun()
    with replacing(path) as temporary:
        recording = rr.RecordingStream("mint-hub", recording_id=episode.key)
        recording.save(str(temporary), default_blueprint=_blueprint())
        recording.log("world", rr.ViewCoordinates.RIGHT_HAND_Y_DOWN, static=True)
        _log_paths(rr, recording, episode)
        _log_camera(rr, recording, episode)
        if video is not None and "lens" not in episode.meta:
            _log_video(rr, recording, episode, Path(video))
        _log_hands(rr, recording, episode, hand_model)
        _log_scores_and_text(rr, recording, episode)
        recording.flush()
        recording.disconnect()
    return path


def import_rerun() -> ModuleType:
    """Import rerun, or say how to install it."""
    try:
        import rerun  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        message = '3-D scenes need rerun-sdk: pip install "mint-hub[viz]"'
        raise MissingExtraError(message, name="rerun") from error
    return rerun


def _blueprint() -> Any:
    import rerun.blueprint as rrb  # pyright: ignore[reportMissingImports]

    series = rrb.TimeSeriesView(origin="presence", name="presence")
    right = rrb.Vertical(
        rrb.Spatial2DView(origin="world/camera", name="camera"),
        series,
        rrb.TextLogView(origin="text", name="text"),
        row_shares=[3, 1.4, 1],
    )
    scene = rrb.Spatial3DView(origin="world", name="world")
    return rrb.Blueprint(rrb.Horizontal(scene, right, column_shares=[3, 2]), collapse_panels=True)


def _log_paths(rr: Any, recording: Any, episode: Episode) -> None:
    """Log whole trajectories, which do not change with time."""
    camera = episode.T_world_from_camera[:, :3, 3]
    line = rr.LineStrips3D([camera], colors=[CAMERA], radii=0.002)
    recording.log("world/paths/camera", line, static=True)
    wrists = episode.wrist_world()[..., :3, 3]
    for hand, side in enumerate(SIDES):
        points = wrists[:, hand]
        strips = [points[run] for run in runs(episode.presence[:, hand])]
        line = rr.LineStrips3D(strips, colors=[SIDE_COLORS[hand]], radii=0.0015)
        recording.log(f"world/paths/{side}_wrist", line, static=True)


def _log_camera(rr: Any, recording: Any, episode: Episode) -> None:
    height, width = episode.image_size_hw
    for k in range(episode.num_frames):
        recording.set_time(TIMELINE, duration=float(episode.timestamps_s[k]))
        T = episode.T_world_from_camera[k]
        pose = rr.Transform3D(translation=T[:3, 3], mat3x3=T[:3, :3])
        pinhole = rr.Pinhole(
            image_from_camera=episode.K[k],
            resolution=[width, height],
            camera_xyz=rr.ViewCoordinates.RDF,
            image_plane_distance=0.25,
        )
        recording.log("world/camera", pose, pinhole)


def _log_video(rr: Any, recording: Any, episode: Episode, video: Path) -> None:
    asset = rr.AssetVideo(path=video)
    recording.log("world/camera/video", asset, static=True)
    times = episode.meta.get("source_timestamps_s") or episode.timestamps_s.tolist()
    for own, source in zip(episode.timestamps_s.tolist(), times, strict=True):
        recording.set_time(TIMELINE, duration=own)
        recording.log("world/camera/video", rr.VideoFrameReference(seconds=float(source)))


def _log_hands(rr: Any, recording: Any, episode: Episode, hand_model: HandModel | None) -> None:
    joints = episode.joints_world(hand_model)
    bones = np.array(KEYPOINT_BONES)
    fingers = (bones[:, 1] - 1) // 4
    for hand, side in enumerate(SIDES):
        entity = f"world/hands/{side}"
        colors = np.array(FINGER_COLORS[hand], np.uint8)[fingers]
        before = True
        for k in range(episode.num_frames):
            recording.set_time(TIMELINE, duration=float(episode.timestamps_s[k]))
            there = bool(episode.presence[k, hand])
            if there:
                points = joints[k, hand]
                recording.log(
                    f"{entity}/bones", rr.LineStrips3D(points[bones], colors=colors, radii=0.004)
                )
                recording.log(
                    f"{entity}/joints", rr.Points3D(points, colors=SIDE_COLORS[hand], radii=0.005)
                )
            elif before:
                recording.log(entity, rr.Clear(recursive=True))
            before = there


def _log_scores_and_text(rr: Any, recording: Any, episode: Episode) -> None:
    for hand, side in enumerate(SIDES):
        entity = f"presence/{side}"
        style = rr.SeriesLines(colors=[SIDE_COLORS[hand]], names=[f"{side} hand"])
        recording.log(entity, style, static=True)
        values = episode.presence if episode.presence_score is None else episode.presence_score
        column = rr.TimeColumn(TIMELINE, duration=episode.timestamps_s)
        scalars = rr.Scalars.columns(scalars=values[:, hand].astype(float))
        recording.send_columns(entity, indexes=[column], columns=scalars)
    for segment in episode.text:
        recording.set_time(TIMELINE, duration=float(episode.timestamps_s[segment.start]))
        words = f"{segment.side}: {segment.text}" if segment.side else segment.text
        recording.log("text", rr.TextLog(words))
