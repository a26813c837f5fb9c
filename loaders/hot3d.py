"""HOT3D's raw ground truth as episodes: one sequence folder, one camera stream.

Read from the folder (https://github.com/facebookresearch/hot3d): ``headset_trajectory.csv`` (world
from device), the stream's times and masks under ``masks/``, MANO hands in the world in
``mano_hand_pose_trajectory.jsonl``, and the cameras in ``online_calibration.jsonl`` (Aria) or
``camera_models.json`` (Quest 3). All times are the recording's own; frames of a stream are found by
their exact nanoseconds.

A hand is 15 coefficients of MANO's PCA basis, which lives in MANO's files, as does the rest wrist
J0 that leads from the stored MANO ``transl`` to the wrist. With the user's MANO files the episode
has the full hand states. Without them no joint can be known, not even the wrist, and a presence
without a hand state would be a lie: every hand is absent and ``meta["quality"]["hands"]`` is
HANDS_UNAVAILABLE. What was annotated stays in the sequence, to be read by ``hot3d_hands`` in the
episode's frames and saved as a file of its own.

The images are fisheye, Aria's lie on their side. The episode is that of the rectified picture
(``geometry.lenses.rectification(lens)`` with the lens of ``meta["lens"]``) turned upright by
``meta["image_turn_clockwise_deg"]``.
"""

import json
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from mint_hub.geometry import hand_state as hands
from mint_hub.geometry import rigid
from mint_hub.geometry.camera import K_to_fov_vh
from mint_hub.geometry.lenses import Fisheye624Lens, Lens
from mint_hub.loaders.fields import slug
from mint_hub.loaders.hot3d_hands import Hot3DHands
from mint_hub.loaders.participants import participant_of
from mint_hub.loaders.schema import Episode
from mint_hub.loaders.trajectory_files import (
    csv_cells,
    pose_from_numbers,
    read_aria_calibration,
)

Float = NDArray[np.float64]

SOURCE: Final = "hot3d"

ARIA_STREAMS: Final = {
    "214-1": ("camera-rgb", (1408, 1408)),
    "1201-1": ("camera-slam-left", (480, 640)),
    "1201-2": ("camera-slam-right", (480, 640)),
}
"""Label in the calibration, and (height, width) of the raw images, of HOT3D's Aria streams."""

HANDS_UNAVAILABLE: Final = "unavailable: needs MANO"
"""``meta["quality"]["hands"]`` where hands are annotated that only MANO's files can read."""

HEADSET: Final = "headset_trajectory.csv"
HANDS: Final = "mano_hand_pose_trajectory.jsonl"
HEADSET_MASK: Final = "mask_headset_pose_available"
HANDS_MASK: Final = "mask_hand_pose_available"
FRAME_MASKS: Final = ("mask_hand_visible", "mask_good_exposure")
UPRIGHT_FROM_ARIA: Final = ((0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
"""A quarter turn clockwise of the picture: right is what was up, down is what was right."""


def from_hot3d(
    folder: str | PathLike[str],
    stream: str = "214-1",
    *,
    mano_dir: str | PathLike[str] | None = None,
    upright: bool = True,
    key: str | None = None,
) -> Episode:
    """Read one camera stream of a HOT3D sequence.

    Args:
        folder: the sequence, e.g. ``P0003_c701bd11``.
        stream: its camera: "214-1" (Aria's RGB), "1201-1", "1201-2".
        mano_dir: folder with the user's MANO files.
        upright: turn an Aria camera so that its picture stands upright.
        key: of the episode; made of the recording's name and the stream when None.

    Returns:
        The frames whose headset pose is available, at times from the first of them. World and
        lengths are the motion capture's. With ``mano_dir``, a hand is present where its pose is
        annotated; without it see the module.

    Raises:
        FileNotFoundError: a file of the sequence, or MANO_RIGHT.pkl, is missing.
        ValueError: names file, line, expected and got.

    """
    folder = Path(folder)
    every, stamps = _stamps(folder, stream)
    camera = _camera(folder, stream, upright)
    T_world_from_device = _headset_poses(folder / HEADSET, stamps)
    T_camera_from_world = rigid.inverse(T_world_from_device @ camera.T_device_from_camera)
    annotated = _annotated(folder, stream, stamps)
    state = np.asarray(hands.absent((len(stamps), 2)), np.float64)
    presence = np.zeros((len(stamps), 2), bool)
    if mano_dir is not None:
        state, presence = annotated.states(T_camera_from_world, Path(mano_dir)), annotated.there
    about = _about(folder)
    meta: dict[str, Any] = {
        "source": SOURCE,
        "uid": about["recording_name"],
        "stream": stream,
        "scale_status": "metric, motion capture",
        "shape_space": "mano",
        "source_timestamps_s": (stamps / 1e9).tolist(),
        "video_start_sec": int(every[0] - stamps[0]) / 1e9,
        "undistorted": True,
        **camera.facts,
        "provenance": {"annotation": "hot3d", "first_timestamp_ns": int(stamps[0])},
        "warnings": [],
    }
    if "participant_id" in about:
        meta["participant"] = about["participant_id"]
    if mano_dir is None:
        meta["quality"] = {"hands": HANDS_UNAVAILABLE}
        meta["warnings"] = [_unavailable(annotated.there)]
    for name, times in (("fps", stamps), ("native_fps", every)):
        if len(times) > 1:
            meta[name] = round(1e9 / float(np.median(np.diff(times))), 2)
    return Episode(
        key=key or hot3d_key(folder, stream),
        timestamps_s=(stamps - stamps[0]) * 1e-9,
        T_camera_from_world=T_camera_from_world,
        fov_vh_rad=np.tile(camera.fov_vh_rad, (len(stamps), 1)).astype(np.float32),
        hand_state=state.astype(np.float32),
        presence=presence,
        image_size_hw=camera.image_size_hw,
        meta=meta,
    )


def hot3d_hands(folder: str | PathLike[str], stream: str = "214-1") -> Hot3DHands:
    """Read what a sequence says of both hands, in the frames of ``from_hot3d(folder, stream)``.

    Nothing is made of the numbers, so no MANO files are needed. Of an episode that was cut,
    ``.window(episode.meta.get("window_start", 0), episode.num_frames)`` are the same frames.

    Raises:
        FileNotFoundError: a file of the sequence is missing.
        ValueError: names file, line, expected and got.

    """
    _, stamps = _stamps(Path(folder), stream)
    uid = _about(Path(folder))["recording_name"]
    return replace(_annotated(Path(folder), stream, stamps), uid=uid)


def hot3d_key(folder: str | PathLike[str], stream: str = "214-1") -> str:
    """Return the key of an episode that is given none: of headset, recording and stream."""
    about = _about(Path(folder))
    return slug(f"hot3d-{about['headset']}-{about['recording_name']}-{stream}")


def _stamps(folder: Path, stream: str) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Times (ns) of all frames of a stream, and of those whose headset pose is available."""
    if not (folder / HEADSET).is_file():
        raise FileNotFoundError(f"{folder}: expected a HOT3D sequence with {HEADSET}, found none")
    every, has_pose = _mask(folder / "masks" / f"{HEADSET_MASK}.csv", stream)
    if not has_pose.any():
        raise ValueError(f"{folder}: stream {stream}: expected headset poses, got none available")
    return every, every[has_pose]


def _annotated(folder: Path, stream: str, stamps: NDArray[np.int64]) -> Hot3DHands:
    annotated, masks = Hot3DHands.read(folder / HANDS, stamps), folder / "masks"
    if (masks / f"{HANDS_MASK}.csv").is_file():
        annotated = annotated.where(_at(masks / f"{HANDS_MASK}.csv", stream, stamps))
    paths = {name: masks / f"{name}.csv" for name in FRAME_MASKS}
    said = {name: _at(path, stream, stamps) for name, path in paths.items() if path.is_file()}
    return replace(annotated, masks=said)


@dataclass(frozen=True, eq=False)
class _Camera:
    """The rectified camera of a stream, upright where asked."""

    T_device_from_camera: Float
    fov_vh_rad: Float
    image_size_hw: tuple[int, int]
    facts: dict[str, Any]

    @classmethod
    def of(cls, lens: Lens, T_device_from_raw: Float, turn_deg: int, source: Any) -> "_Camera":
        """``turn_deg`` is 0, or 90 for a picture that is turned clockwise to stand upright."""
        height, width = lens.image_size_hw
        fx, fy, pose = lens.fx, lens.fy, T_device_from_raw
        if turn_deg:
            T_upright_from_raw = rigid.rigid(np.array(UPRIGHT_FROM_ARIA), np.zeros(3))
            pose = T_device_from_raw @ rigid.inverse(T_upright_from_raw)
            (fx, fy), (height, width) = (fy, fx), (width, height)
        K = np.array([[fx, 0, width / 2], [0, fy, height / 2], [0, 0, 1]])
        size = (height, width)
        facts = {
            "lens": lens.to_dict(),
            "image_turn_clockwise_deg": turn_deg,
            "calibration": source,
        }
        return cls(pose, np.asarray(K_to_fov_vh(K, size)), size, facts)


def _camera(folder: Path, stream: str, upright: bool) -> _Camera:
    for name in ("online_calibration.jsonl", "mps/slam/online_calibration.jsonl"):
        if (folder / name).is_file():
            if stream not in ARIA_STREAMS:
                raise ValueError(f"stream: expected {', '.join(ARIA_STREAMS)}, got {stream!r}")
            label, size = ARIA_STREAMS[stream]
            calibration = read_aria_calibration(folder / name, label)
            lens = Fisheye624Lens.from_params(calibration.params, size)
            turn, move = calibration.largest_change
            source = {"file": name, "largest_change_rad": turn, "largest_change_m": move}
            return _Camera.of(lens, calibration.T_device_from_camera, 90 if upright else 0, source)
    path = folder / "camera_models.json"
    if not path.is_file():
        raise FileNotFoundError(
            f"{folder}: expected online_calibration.jsonl (Aria) or {path.name} (Quest 3), found "
            "neither"
        )
    try:
        models = {model["stream_id"]: model for model in json.loads(path.read_text("utf-8"))}
        if stream not in models:
            raise ValueError(f"stream {', '.join(models)}, got {stream!r}")
        model = models[stream]
        w, *xyz = model["T_Device_Camera"]["quaternion_wxyz"]
        pose = pose_from_numbers(stream, [*model["T_Device_Camera"]["translation_xyz"], *xyz, w])
        size = (int(model["imageHeight"]), int(model["imageWidth"]))
        lens = Fisheye624Lens.from_params(model["projectionParams"], size)
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(
            f"{path}: expected camera models, got {type(error).__name__}: {error}"
        ) from None
    return _Camera.of(lens, pose, 0, {"file": path.name})


def _headset_poses(path: Path, stamps: NDArray[np.int64]) -> Float:
    """T_world_from_device (T, 4, 4) at exactly these times."""
    frame_of = {int(stamp): k for k, stamp in enumerate(stamps)}
    poses = np.full((len(stamps), 4, 4), np.nan)
    names = ["t_wo_x[m]", "t_wo_y[m]", "t_wo_z[m]", "q_wo_x", "q_wo_y", "q_wo_z", "q_wo_w"]
    for line, cells in csv_cells(path, ["timestamp[ns]", *names]):
        place = f"{path}, line {line}"
        try:
            frame = frame_of.get(int(cells[0]))
            numbers = [float(cell) for cell in cells[1:]]
        except ValueError as error:
            raise ValueError(f"{place}: expected numbers, got {error}") from None
        if frame is not None:
            poses[frame] = pose_from_numbers(place, numbers)
    if (lost := np.flatnonzero(np.isnan(poses).any((1, 2)))).size:
        raise ValueError(
            f"{path}: expected a pose at {stamps[lost[0]]} ns, which {HEADSET_MASK}.csv says is "
            f"available, got none ({len(lost)} such frames)"
        )
    return poses


def _mask(path: Path, stream: str) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Times (M,) ns of a stream's frames, in order, and what the mask says of them."""
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file; it lists the frames of each stream")
    found: dict[int, bool] = {}
    streams: set[str] = set()
    for line, (stamp, of_stream, value) in csv_cells(path, ["timestamp[ns]", "stream_id", "mask"]):
        streams.add(of_stream)
        if not stamp.isdigit() or value not in ("True", "False"):
            raise ValueError(
                f"{path}, line {line}: expected nanoseconds and True or False, got {stamp!r} and "
                f"{value!r}"
            )
        if of_stream == stream:
            found[int(stamp)] = value == "True"
    if not found:
        known = ", ".join(sorted(streams))
        raise ValueError(f"{path}: stream: expected one of {known}, got {stream!r}")
    stamps = np.array(sorted(found), np.int64)
    return stamps, np.array([found[int(stamp)] for stamp in stamps])


def _at(path: Path, stream: str, stamps: NDArray[np.int64]) -> NDArray[np.bool_]:
    """What a mask says at these times (T,): false where it says nothing."""
    times, values = _mask(path, stream)
    return np.isin(stamps, times[values])


def _about(folder: Path) -> dict[str, str]:
    """Headset, participant and recording: from metadata.json, else from the folder's name.

    Of a folder called otherwise than HOT3D's are, nobody knows the participant: there is none.
    """
    path = folder / "metadata.json"
    if not path.is_file():
        person = participant_of(SOURCE, folder.name)
        said = {} if person is None else {"participant_id": person}
        return {"headset": "unknown", "recording_name": folder.name, **said}
    names = ("headset", "participant_id", "recording_name")
    try:
        return {name: str(json.loads(path.read_text("utf-8"))[name]) for name in names}
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(
            f"{path}: expected {', '.join(names)}, got {type(error).__name__}: {error}"
        ) from None


def _unavailable(annotated: NDArray[np.bool_]) -> str:
    left, right = (int(n) for n in annotated.sum(axis=0))
    return (
        f"joints unavailable: hands ({left} left, {right} right frames) are coefficients of MANO's "
        "PCA basis, and the wrist needs MANO's rest wrist; give mano_dir, or read them as they are "
        "with hot3d_hands"
    )
