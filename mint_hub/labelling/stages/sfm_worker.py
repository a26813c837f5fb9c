"""Stand-alone script: structure from motion by pycolmap's global mapper, for `sfm_camera`.

Runs in an environment of its own and imports nothing of mint_hub: pycolmap, OpenCV, numpy, scipy
and the two files beside it. Poses are camera_from_world, OpenCV axes, in units of their own: one
unit is the median depth of the map points where they are seen. Pixels span 0 <= u < W.

Seeds are fixed, and everything but feature matching runs in one thread, so that the same frames
give the same answer on the same machine.
"""

# pyright: reportMissingImports=false

import sys
import tempfile
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray

sys.path.append(str(Path(__file__).parent))  # behind all packages: only for the file beside this

from sfm_tracking import Keyframe, UInt8, densify, masks_of, reproject

Float = NDArray[np.float64]
Arrays = dict[str, NDArray[Any]]

SEED: Final = 1
NEIGHBOURS: Final = 8
"""Keyframes are matched with this many that follow ..."""

LOOPS: Final = (12, 16, 24, 32, 48, 64, 96, 128)
"""... and with ones this much later, so that a camera that returns closes its loop."""

MAX_FEATURES: Final = 4096
MIN_MATCHES: Final = 20
"""Verified matches that the middle one of adjacent pairs needs before mapping is tried."""

_KIND: Final = pycolmap.TwoViewGeometryConfiguration
TURNING: Final = tuple(
    int(kind) for kind in (_KIND.PLANAR, _KIND.PANORAMIC, _KIND.PLANAR_OR_PANORAMIC)
)

MIN_MODEL: Final = 5
"""Images a model needs to be reported."""


@dataclass(frozen=True, eq=False)
class Model:
    """One connected map.

    Attributes:
        keyframes: in order of frame.
        points: (P, 3).
        focal_px: (fx, fy).
        residual_px: mean reprojection error.
        angle_deg: median over points of the widest angle under which two keyframes see them.

    """

    keyframes: list[Keyframe]
    points: Float
    focal_px: tuple[float, float]
    residual_px: float
    angle_deg: float


@dataclass(frozen=True)
class Evidence:
    """What was seen before mapping: medians over keyframes, or over adjacent pairs of them.

    Attributes:
        features: keypoints outside the masks.
        matches: verified matches.
        flow_px: length of the verified matches' motion.
        turning: share of all matched pairs that a homography explains, as it does where a camera
            only turns.

    """

    features: float
    matches: float
    flow_px: float
    turning: float


def build_map(
    images: list[UInt8],
    masks: list[UInt8],
    frames: list[int],
    focal_px: tuple[float, float] | None,
    start_fov_rad: float,
    threads: int,
) -> tuple[list[Model], Evidence]:
    """Map keyframes; the focal is free, from a start, when none is given.

    Args:
        images, masks: of the keyframes; features on 0 of a mask are left out.
        frames: their numbers.
        focal_px: (fx, fy), kept as it is; None to solve for one.
        start_fov_rad: angle along the longer side, where the focal is free.
        threads: for matching.

    Returns:
        Models, the largest first, and what there was to see.

    """
    with tempfile.TemporaryDirectory(prefix="mint-hub-sfm-") as name:
        folder = Path(name)
        names = [f"{i:05d}.png" for i in range(len(images))]
        (folder / "images").mkdir()
        (folder / "masks").mkdir()
        (folder / "models").mkdir()
        for image, mask, file in zip(images, masks, names, strict=True):
            cv2.imwrite(str(folder / "images" / file), image, [cv2.IMWRITE_PNG_COMPRESSION, 1])
            cv2.imwrite(str(folder / "masks" / f"{file}.png"), mask)
        database = folder / "database.db"
        _extract(folder, names, focal_px, start_fov_rad, images[0].shape)
        _match(folder, names, threads)
        evidence = _evidence(database, names)
        if evidence.matches < MIN_MATCHES:
            return [], evidence
        if focal_px is None:
            options = pycolmap.ViewGraphCalibrationOptions()
            options.random_seed = SEED
            pycolmap.calibrate_view_graph(database, options)
        found = pycolmap.global_mapping(
            database, folder / "images", folder / "models", _mapping(focal_px is None)
        )
        models = [_model(r, frames) for r in found.values() if r.num_reg_images() >= MIN_MODEL]
    models.sort(key=lambda m: (-len(m.keyframes), m.keyframes[0].frame))
    return models, evidence


def _extract(
    folder: Path,
    names: list[str],
    focal_px: tuple[float, float] | None,
    start_fov_rad: float,
    shape_hw: tuple[int, ...],
) -> None:
    height, width = shape_hw[:2]
    reader = pycolmap.ImageReaderOptions()
    reader.mask_path = folder / "masks"
    if focal_px is None:
        reader.camera_model = "SIMPLE_PINHOLE"
        reader.default_focal_length_factor = 0.5 / np.tan(start_fov_rad / 2)
    else:
        reader.camera_model = "PINHOLE"
        reader.camera_params = ",".join(str(x) for x in (*focal_px, width / 2, height / 2))
    options = pycolmap.FeatureExtractionOptions()
    options.num_threads = 1  # more would number the images in the order they are done
    options.use_gpu = False
    options.sift.max_num_features = MAX_FEATURES
    pycolmap.extract_features(
        folder / "database.db",
        folder / "images",
        names,
        pycolmap.CameraMode.SINGLE,
        reader,
        options,
        pycolmap.Device.cpu,
    )


def _match(folder: Path, names: list[str], threads: int) -> None:
    count = len(names)
    gaps = (*range(1, NEIGHBOURS + 1), *LOOPS)
    pairs = [(i, i + gap) for i in range(count) for gap in gaps if i + gap < count]
    listed = folder / "pairs.txt"
    listed.write_text("".join(f"{names[i]} {names[j]}\n" for i, j in pairs), encoding="utf-8")
    matching = pycolmap.FeatureMatchingOptions()
    matching.num_threads = threads
    matching.use_gpu = False
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = listed
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = SEED
    verification.detect_watermark = False
    pycolmap.match_image_pairs(
        folder / "database.db", matching, pairing, verification, pycolmap.Device.cpu
    )


def _mapping(free_focal: bool) -> Any:
    options = pycolmap.GlobalPipelineOptions()
    options.random_seed = SEED
    options.num_threads = 1
    mapper = options.mapper
    mapper.random_seed = SEED
    mapper.num_threads = 1
    mapper.rotation_averaging.random_seed = SEED
    mapper.global_positioning.random_seed = SEED
    mapper.global_positioning.use_gpu = False
    mapper.retriangulation.random_seed = SEED
    mapper.bundle_adjustment.refine_focal_length = free_focal
    mapper.bundle_adjustment.refine_extra_params = False
    mapper.bundle_adjustment.ceres.use_gpu = False
    mapper.bundle_adjustment.ceres.solver_options.num_threads = 1
    return options


def _evidence(database: Path, names: list[str]) -> Evidence:
    with pycolmap.Database.open(database) as data:
        ids = {image.name: image.image_id for image in data.read_all_images()}
        keypoints = [data.read_keypoints(ids[name])[:, :2] for name in names]
        matches: list[int] = []
        flows: list[float] = []
        for i in range(len(names) - 1):
            pair = data.read_two_view_geometry(ids[names[i]], ids[names[i + 1]])
            inliers = pair.inlier_matches
            matches.append(len(inliers))
            if len(inliers):
                moved = keypoints[i][inliers[:, 0]] - keypoints[i + 1][inliers[:, 1]]
                flows.append(float(np.median(np.linalg.norm(moved, axis=1))))
        _, pairs = data.read_two_view_geometries()
        kinds = [int(pair.config) for pair in pairs if len(pair.inlier_matches)]
    return Evidence(
        float(np.median([len(k) for k in keypoints])),
        float(np.median(matches)) if matches else 0.0,
        float(np.median(flows)) if flows else 0.0,
        sum(kind in TURNING for kind in kinds) / max(len(kinds), 1),
    )


def _model(reconstruction: Any, frames: list[int]) -> Model:
    """Read a reconstruction out, in units of its median depth."""
    ids = sorted(reconstruction.point3D_ids())
    number = {identity: i for i, identity in enumerate(ids)}
    points = np.array([reconstruction.point3D(i).xyz for i in ids]).reshape(-1, 3)
    keyframes: list[Keyframe] = []
    for image_id in reconstruction.reg_image_ids():
        image = reconstruction.image(image_id)
        T = np.eye(4)
        T[:3] = image.cam_from_world().matrix()
        seen = image.get_observation_points2D()
        point = np.array([number[p.point3D_id] for p in seen], dtype=np.int64)
        uv = np.array([p.xy for p in seen], dtype=np.float64).reshape(-1, 2)
        keyframes.append(Keyframe(frames[int(Path(image.name).stem)], T, point, uv))
    keyframes.sort(key=lambda k: k.frame)
    camera = next(iter(reconstruction.cameras.values()))
    focal = (float(camera.focal_length_x), float(camera.focal_length_y))
    K = np.array([[focal[0], 0, camera.width / 2], [0, focal[1], camera.height / 2], [0, 0, 1]])
    depths, errors = [np.zeros(0)], [np.zeros(0)]
    for keyframe in keyframes:
        uv, depth = reproject(points[keyframe.point], K, keyframe.T_camera_from_world)
        depths.append(depth)
        errors.append(np.linalg.norm(uv - keyframe.uv, axis=1))
    unit = float(np.median(np.concatenate(depths))) if len(points) else 1.0
    for keyframe in keyframes:
        keyframe.T_camera_from_world[:3, 3] /= unit
    residual = float(np.concatenate(errors).mean()) if len(points) else float("nan")
    points /= unit
    return Model(keyframes, points, focal, residual, _angle_deg(keyframes, points))


def _angle_deg(keyframes: list[Keyframe], points: Float) -> float:
    """Median over points of the angle between the first and the last ray, or the widest of a few.

    Every observation is compared with the first one of its point and with the last one.
    """
    if not len(points):
        return 0.0
    widest = np.ones(len(points))
    for order in (keyframes, keyframes[::-1]):
        reference = np.full((len(points), 3), np.nan)
        for keyframe in order:
            T = keyframe.T_camera_from_world
            ray = points[keyframe.point] + T[:3, :3].T @ T[:3, 3]
            ray = ray / np.linalg.norm(ray, axis=1, keepdims=True)
            new = np.isnan(reference[keyframe.point, 0])
            reference[keyframe.point[new]] = ray[new]
            cosine = (reference[keyframe.point] * ray).sum(axis=1)
            widest[keyframe.point] = np.minimum(widest[keyframe.point], cosine)
    return float(np.degrees(np.median(np.arccos(widest.clip(-1, 1)))))


def intrinsics(arrays: Arrays, **values: Any) -> tuple[Arrays, dict[str, Any]]:
    """Solve for one focal.

    Args:
        arrays: ``images`` (K, H, W) uint8 and ``frames`` (K,), ``hand_frame`` (N,) and ``hand_uv``
            (N, 21, 2).
        values: ``start_fov_rad``, ``threads``.

    Returns:
        No arrays, and "models" and "evidence" as plain values.

    """
    images, masks, frames = _keyframes(arrays)
    start = float(values["start_fov_rad"])
    models, seen = build_map(images, masks, frames, None, start, int(values["threads"]))
    return {}, {"models": [_summary(model) for model in models], "evidence": vars(seen)}


def camera(arrays: Arrays, **values: Any) -> tuple[Arrays, dict[str, Any]]:
    """Solve for the pose of every frame.

    Args:
        arrays: ``images`` (T, H, W) uint8, all frames of the clip; ``frames`` (K,), those that
            are mapped; ``hand_frame`` (N,) and ``hand_uv`` (N, 21, 2).
        values: ``focal_px`` (fx, fy), ``threads``.

    Returns:
        For the i-th model arrays named "i/...": ``keyframe`` (k,), ``shared`` (k - 1,) map points
        seen by two keyframes in a row, ``T`` (F, 4, 4) from the first keyframe on, ``solved`` (F,),
        ``residual`` (F,), ``points`` (P, 3), and observations ``obs_frame``, ``obs_point`` (O,),
        ``obs_uv`` (O, 2). "models" and "evidence" as plain values.

    """
    every, frames = list(arrays["images"]), [int(f) for f in arrays["frames"]]
    height, width = every[0].shape
    masks = masks_of(
        (height, width), np.arange(len(every)), arrays["hand_frame"], arrays["hand_uv"]
    )
    fx, fy = (float(f) for f in values["focal_px"])
    K = np.array([[fx, 0, width / 2], [0, fy, height / 2], [0, 0, 1]])
    models, seen = build_map(
        [every[f] for f in frames],
        [masks[f] for f in frames],
        frames,
        (fx, fy),
        0.0,
        int(values["threads"]),
    )
    out: Arrays = {}
    for i, model in enumerate(models):
        dense = densify(every, masks, model.keyframes, model.points, K)
        arrays_of_model = {
            **_map_arrays(model),
            "T": dense.T_camera_from_world,
            "solved": dense.solved,
            "residual": dense.residual_px,
        }
        out.update({f"{i}/{name}": array for name, array in arrays_of_model.items()})
    return out, {"models": [_summary(model) for model in models], "evidence": vars(seen)}


def _keyframes(arrays: Arrays) -> tuple[list[UInt8], list[UInt8], list[int]]:
    images = list(arrays["images"])
    height, width = images[0].shape
    masks = masks_of((height, width), arrays["frames"], arrays["hand_frame"], arrays["hand_uv"])
    return images, masks, [int(f) for f in arrays["frames"]]


def _shared(keyframes: list[Keyframe]) -> list[int]:
    return [len(np.intersect1d(a.point, b.point)) for a, b in pairwise(keyframes)]


def _map_arrays(model: Model) -> Arrays:
    seen = [len(k.point) for k in model.keyframes]
    numbers = np.array([k.frame for k in model.keyframes], dtype=np.int64)
    return {
        "keyframe": numbers,
        "shared": np.array(_shared(model.keyframes), dtype=np.int64),
        "points": model.points,
        "obs_frame": np.repeat(numbers, seen),
        "obs_point": np.concatenate([k.point for k in model.keyframes]),
        "obs_uv": np.concatenate([k.uv for k in model.keyframes]),
    }


def _summary(model: Model) -> dict[str, Any]:
    centres = np.array(
        [-T[:3, :3].T @ T[:3, 3] for T in (k.T_camera_from_world for k in model.keyframes)]
    )
    return {
        "images": len(model.keyframes),
        "points": len(model.points),
        "focal_px": list(model.focal_px),
        "residual_px": model.residual_px,
        "angle_deg": model.angle_deg,
        "extent": float(np.linalg.norm(np.ptp(centres, axis=0))),
        "shared": _shared(model.keyframes),
    }


if __name__ == "__main__":
    from worker_side import serve

    pycolmap.logging.minloglevel = 2
    serve({"intrinsics": intrinsics, "camera": camera})
