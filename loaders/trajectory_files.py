"""Files in which devices keep camera trajectories and calibrations: TUM, EgoDex, Aria MPS.

Poses come back world-to-camera with OpenCV's axes, on the device's own clock. Errors name file and
line. ``device_trajectories`` takes them to a video's times.
"""

import csv
import json
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from types import ModuleType
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mint_hub.conventions import MODEL_FPS
from mint_hub.geometry import rigid
from mint_hub.geometry.rotations import quat_xyzw_to_matrix

Float = NDArray[np.float64]

QUATERNION_TOLERANCE: Final = 0.01
"""How far from 1 the length of a quaternion of a text file may be; published files are rounded."""

RIGID_TOLERANCE: Final = 1e-3
"""Largest entry of R Rᵀ - I in a stored matrix."""


class DeviceTrajectory(NamedTuple):
    """Poses of a camera on the device's clock.

    Attributes:
        timestamps_s: (M,) float64, strictly increasing.
        T_camera_from_world: (M, 4, 4) float64, metres, in the device's world.

    """

    timestamps_s: Float
    T_camera_from_world: Float


@dataclass(frozen=True, eq=False)
class AriaCalibration:
    """One camera of an Aria device, from MPS's online calibration.

    Attributes:
        T_device_from_camera: (4, 4) robust mean over the recording.
        params: the lens's numbers as published (Fisheye624: f, cx, cy, 6 radial, 2 tangential, 4
            thin prism), median over the recording.
        largest_change: farthest pose from the mean (rotation rad, translation m).

    """

    T_device_from_camera: Float
    params: tuple[float, ...]
    largest_change: tuple[float, float]


def read_tum(
    path: str | PathLike[str], *, T_device_from_camera: NDArray[Any] | None = None
) -> DeviceTrajectory:
    """Read TUM text: lines of ``time tx ty tz qx qy qz qw``, world from device; ``#`` comments.

    Of lines with the same time the first is kept.

    Args:
        path: the file.
        T_device_from_camera: (4, 4) where the camera sits on what the file tracks; the same when
            None.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: names file, line, expected and got.

    """
    path = Path(path)
    with path.open(encoding="utf-8") as file:
        lines = ((n, line.split()) for n, line in enumerate(file, 1) if not line.startswith("#"))
        rows = [
            (n, _floats(path, n, words, "8 numbers: time tx ty tz qx qy qz qw", 8))
            for n, words in lines
            if words
        ]
    return _from_rows(path, rows, T_device_from_camera)


def read_aria_mps_csv(
    path: str | PathLike[str], *, T_device_from_camera: NDArray[Any] | None = None
) -> DeviceTrajectory:
    """Read MPS's ``closed_loop_trajectory.csv`` or ``open_loop_trajectory.csv``.

    Times are ``tracking_timestamp_us``, poses ``{tx..qw}_world_device`` or ``_odometry_device``.

    Args:
        path: the file.
        T_device_from_camera: (4, 4), as ``read_aria_calibration`` gives it; without it the poses
            are the device's, which are those of no camera of known axes.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: names file, line, expected and got; also where the file changes its world.

    """
    path = Path(path)
    with path.open(encoding="utf-8", newline="") as file:
        table = csv.reader(file)
        header = [name.strip() for name in next(table, [])]
        frame = "odometry" if "tx_odometry_device" in header else "world"
        names = [f"{q}_{frame}_device" for q in ("tx", "ty", "tz", "qx", "qy", "qz", "qw")]
        columns = columns_of(path, header, ["tracking_timestamp_us", *names])
        world = next((i for i, n in enumerate(header) if n in ("graph_uid", "session_uid")), None)
        rows: list[tuple[int, list[float]]] = []
        first = None
        for line, cells in enumerate(table, 2):
            picked = [cells[i] for i in columns if i < len(cells)]
            values = _floats(path, line, picked, f"numbers in {', '.join(names)}", 8)
            rows.append((line, [values[0] * 1e-6, *values[1:]]))
            uid = cells[world] if world is not None else None
            first = first or uid
            if uid != first:
                raise ValueError(
                    f"{path}, line {line}: expected poses in one world ({first}), got {uid}"
                )
    return _from_rows(path, rows, T_device_from_camera)


def read_egodex_hdf5(path: str | PathLike[str], *, fps: float = MODEL_FPS) -> DeviceTrajectory:
    """Read the camera of an EgoDex ``.hdf5``: ``transforms/camera``, world from camera.

    The camera's axes are OpenCV's. There is one pose a video frame and no times: frame k is at
    k / fps. Needs ``h5py``.

    Raises:
        ImportError: h5py is not installed.
        FileNotFoundError: there is no such file.
        ValueError: names file, field, expected and got.

    """
    poses = _hdf5_array(Path(path), "transforms/camera")
    if poses.ndim != 3 or poses.shape[1:] != (4, 4) or not len(poses):
        raise ValueError(f"{path}: transforms/camera: expected (T, 4, 4), got {poses.shape}")
    _check_rigid(f"{path}: transforms/camera", poses)
    return DeviceTrajectory(np.arange(len(poses)) / fps, rigid.inverse(poses))


def read_egodex_intrinsics(path: str | PathLike[str]) -> Float:
    """Read K (3, 3) of an EgoDex ``.hdf5``, pixels of its 1920 x 1080 video. Needs ``h5py``.

    Raises:
        ImportError: h5py is not installed.
        FileNotFoundError: there is no such file.
        ValueError: names file, field, expected and got.

    """
    K = _hdf5_array(Path(path), "camera/intrinsic")
    if K.shape != (3, 3):
        raise ValueError(f"{path}: camera/intrinsic: expected (3, 3), got {K.shape}")
    return K


def read_aria_calibration(path: str | PathLike[str], label: str = "camera-rgb") -> AriaCalibration:
    """Read one camera of MPS's ``online_calibration.jsonl``, averaged over the recording.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: names file, line, expected and got.

    """
    path = Path(path)
    poses: list[Float] = []
    params: list[list[float]] = []
    for line, record in json_lines(path):
        try:
            (camera,) = (c for c in record["CameraCalibrations"] if c["Label"] == label)
            w, xyz = camera["T_Device_Camera"]["UnitQuaternion"]
            numbers = [*camera["T_Device_Camera"]["Translation"], *xyz, w]
            params.append([float(p) for p in camera["Projection"]["Params"]])
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(
                f"{path}, line {line}: expected one calibration of {label!r} with "
                f"T_Device_Camera and Projection.Params, got {type(error).__name__}: {error}"
            ) from None
        poses.append(pose_from_numbers(f"{path}, line {line}", numbers))
    if not poses or len({len(p) for p in params}) != 1:
        lengths = sorted({len(p) for p in params})
        raise ValueError(f"{path}: expected lines with equally many lens numbers, got {lengths}")
    mean = rigid.robust_mean_rigid(np.stack(poses))
    change = (float(mean.residuals.rotation_rad.max()), float(mean.residuals.translation_m.max()))
    return AriaCalibration(mean.mean, tuple(np.median(params, axis=0).tolist()), change)


def pose_from_numbers(place: str, numbers: Sequence[float]) -> Float:
    """Return the pose (4, 4) of [tx ty tz qx qy qz qw].

    Raises:
        ValueError: not finite, or no unit quaternion; ``place`` says where.

    """
    values = np.asarray(numbers, np.float64)
    length = float(np.linalg.norm(values[3:]))
    if not np.isfinite(values).all() or abs(length - 1) > QUATERNION_TOLERANCE:
        raise ValueError(
            f"{place}: expected finite numbers and a unit quaternion, got t {values[:3].tolist()}, "
            f"xyzw {values[3:].tolist()} of length {length:.4g}"
        )
    return rigid.rigid(quat_xyzw_to_matrix(values[3:]), values[:3])


def json_lines(path: Path) -> Iterator[tuple[int, Any]]:
    """Yield (line number, value) of a file with one JSON value a line.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: names file and line.

    """
    with path.open(encoding="utf-8") as file:
        for number, line in enumerate(file, 1):
            if line.strip():
                try:
                    yield number, json.loads(line)
                except ValueError as error:
                    raise ValueError(f"{path}, line {number}: expected JSON, got {error}") from None


def columns_of(path: Path, header: Sequence[str], names: Iterable[str]) -> list[int]:
    """Positions of named columns.

    Raises:
        ValueError: one is missing.

    """
    missing = [name for name in names if name not in header]
    if missing:
        raise ValueError(
            f"{path}, line 1: expected the column {missing[0]}, got {', '.join(header)}"
        )
    return [header.index(name) for name in names]


def csv_cells(path: Path, names: list[str]) -> list[tuple[int, list[str]]]:
    """Line numbers and the cells of the named columns, of every row of a csv file.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: a column is missing, or a row is cut short.

    """
    with path.open(encoding="utf-8", newline="") as file:
        table = csv.reader(file)
        columns = columns_of(path, next(table, []), names)
        rows = [(line, cells) for line, cells in enumerate(table, 2) if cells]
    for line, cells in rows:
        if len(cells) <= max(columns):
            raise ValueError(
                f"{path}, line {line}: expected {max(columns) + 1} cells, got {len(cells)}"
            )
    return [(line, [cells[i] for i in columns]) for line, cells in rows]


def _floats(path: Path, line: int, words: Sequence[str], expected: str, count: int) -> list[float]:
    try:
        values = [float(word) for word in words]
    except ValueError:
        values = []
    if len(values) != count:
        raise ValueError(f"{path}, line {line}: expected {expected}, got {' '.join(words)!r}")
    return values


def _from_rows(
    path: Path, rows: Sequence[tuple[int, list[float]]], T_device_from_camera: NDArray[Any] | None
) -> DeviceTrajectory:
    """Trajectory of numbered rows [time, tx ty tz qx qy qz qw], world from device."""
    kept: list[tuple[int, list[float]]] = []
    for line, values in rows:
        step = values[0] - kept[-1][1][0] if kept else 1.0
        if not step >= 0:
            raise ValueError(
                f"{path}, line {line}: expected a time after {kept[-1][1][0]:.6f}, "
                f"got {values[0]:.6f}"
            )
        if step > 0:
            kept.append((line, values))
    if not kept:
        raise ValueError(f"{path}: expected at least one pose, got none")
    numbers = np.array([values for _, values in kept])
    lengths = np.linalg.norm(numbers[:, 4:], axis=1)
    bad = ~np.isfinite(numbers).all(axis=1) | ~(abs(lengths - 1) <= QUATERNION_TOLERANCE)
    if bad.any():
        line, values = kept[int(np.argmax(bad))]
        pose_from_numbers(f"{path}, line {line}", values[1:])
    T_world_from_device = rigid.rigid(quat_xyzw_to_matrix(numbers[:, 4:]), numbers[:, 1:4])
    if T_device_from_camera is not None:
        mount = np.asarray(T_device_from_camera, np.float64)
        _check_rigid("T_device_from_camera", mount[None])
        T_world_from_device = T_world_from_device @ mount
    return DeviceTrajectory(numbers[:, 0], rigid.inverse(T_world_from_device))


def _check_rigid(name: str, T: Float) -> None:
    R = T[:, :3, :3]
    error = abs(R @ R.swapaxes(1, 2) - np.eye(3)).max((1, 2)) + (np.linalg.det(R) < 0)
    error = error + abs(T[:, 3] - [0, 0, 0, 1]).max(1) + ~np.isfinite(T).all((1, 2))
    if (bad := np.flatnonzero(~(error < RIGID_TOLERANCE))).size:
        k = int(bad[0])
        raise ValueError(
            f"{name}: expected rigid transforms, got {T[k].round(4).tolist()} at frame {k}"
        )


def _hdf5_array(path: Path, name: str) -> Float:
    h5py = _h5py()
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    try:
        file = h5py.File(path, "r")
    except OSError as error:
        raise ValueError(f"{path}: expected an HDF5 file, got {error}") from None
    with file:
        if name not in file:
            raise ValueError(f"{path}: {name}: expected this data set, got {sorted(file)}")
        return np.asarray(file[name][()], np.float64)


def _h5py() -> ModuleType:
    try:
        import h5py  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise ImportError("EgoDex files are HDF5: install h5py (pip install h5py)") from None
    return h5py
