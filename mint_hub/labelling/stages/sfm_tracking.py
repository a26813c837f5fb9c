"""The part of the SfM camera that needs no mapper: hand masks, tracks, poses between keyframes.

Also read by `sfm_worker`, which runs in an environment of its own: nothing of mint_hub is imported
here. Pixels span 0 <= u < W (OpenCV's trackers count from pixel centres: half a pixel is added);
poses are camera_from_world (4, 4), OpenCV axes; K (3, 3) in pixels.
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

Float = NDArray[np.float64]
Int = NDArray[np.int64]
UInt8 = NDArray[np.uint8]
Bool = NDArray[np.bool_]

HAND_MARGIN: Final = 0.25
"""How far a hand's mask reaches beyond its landmarks, as a share of the hand's extent."""

FOREARM_SPREAD_RAD: Final = 0.35
"""Half opening of the wedge that hides the forearm: a wrist may bend."""

MASK_REACH: Final = 2
"""A frame is also masked by what was seen this many frames before and after it."""

ROUND_TRIP_PX: Final = 0.7
"""A track is kept when following it back misses its start by less."""

INLIER_PX: Final = 2.0
MIN_INLIERS: Final = 12
MIN_INLIER_SHARE: Final = 0.4


def usable_mask(shape_hw: tuple[int, int], hands_uv: Float) -> UInt8:
    """Return (H, W) uint8: 255 where the world is seen, 0 on hands (N, 21, 2) and forearms.

    A hand is the dilated hull of its landmarks; its forearm is a wedge from the wrist, away from
    the knuckles, that ends at the border of the image. Landmarks that are not finite are left out.
    """
    mask = np.full(shape_hw, 255, dtype=np.uint8)
    far = float(np.hypot(*shape_hw))
    for uv in np.asarray(hands_uv, dtype=np.float64):
        seen = uv[np.isfinite(uv).all(axis=1)]
        if len(seen) < 3:
            continue
        extent = float(np.ptp(seen, axis=0).max())
        margin = max(round(2 * HAND_MARGIN * extent), 4)
        hull: Any = cv2.convexHull(np.rint(seen).astype(np.int32).reshape(-1, 1, 2))
        cv2.fillConvexPoly(mask, hull, 0)
        cv2.polylines(mask, [hull], isClosed=True, color=0, thickness=margin)
        if np.isfinite(uv[[0, 5, 9, 17]]).all():
            cv2.fillConvexPoly(mask, np.rint(_forearm(uv, far)).astype(np.int32), 0)
    return mask


def _forearm(uv: Float, length: float) -> Float:
    """Corners (4, 2) of the wedge behind the wrist (landmark 0; knuckles 5, 9, 17)."""
    wrist, palm = uv[0], uv[[5, 9, 17]].mean(axis=0)
    away = wrist - palm
    reach = float(np.linalg.norm(away))
    away = away / reach if reach > 1e-6 else np.array([0.0, 1.0])
    across = np.array([-away[1], away[0]])
    width = 0.6 * max(float(np.linalg.norm(uv[5] - uv[17])), reach)
    spread = width + length * np.tan(FOREARM_SPREAD_RAD)
    return np.stack(
        [
            wrist + across * width,
            wrist - across * width,
            wrist + away * length - across * spread,
            wrist + away * length + across * spread,
        ]
    )


def masks_of(
    shape_hw: tuple[int, int], frames: Int, hand_frame: Int, hand_uv: Float
) -> list[UInt8]:
    """Masks of ``frames`` of hands seen in frames ``hand_frame`` (N,), landmarks (N, 21, 2)."""
    return [
        usable_mask(shape_hw, hand_uv[np.abs(hand_frame - frame) <= MASK_REACH]) for frame in frames
    ]


def follow(images: list[UInt8], uv: Float) -> tuple[list[Float], list[Bool]]:
    """Follow points (N, 2) of the first image through the others, Lucas-Kanade both ways.

    Returns:
        Per image after the first: positions (N, 2) and which are still followed (N,).

    """
    height, width = images[0].shape
    at = (np.asarray(uv) - 0.5).astype(np.float32).reshape(-1, 1, 2)
    alive = np.ones(len(at), dtype=bool)
    positions: list[Float] = []
    followed: list[Bool] = []
    options: dict[str, Any] = {"winSize": (15, 15), "maxLevel": 3}
    for before, after in pairwise(images):
        if len(at):
            there, ok, _ = cv2.calcOpticalFlowPyrLK(before, after, at, None, **options)  # type: ignore[call-overload]
            back, ok_back, _ = cv2.calcOpticalFlowPyrLK(after, before, there, None, **options)  # type: ignore[call-overload]
            miss = np.linalg.norm((back - at).reshape(-1, 2), axis=1)
            flat = there.reshape(-1, 2)
            inside = ((flat >= 0) & (flat < (width, height))).all(axis=1)
            alive = alive & (ok.ravel() > 0) & (ok_back.ravel() > 0) & inside
            alive &= miss < ROUND_TRIP_PX
            at = there
        positions.append(at.reshape(-1, 2).astype(np.float64) + 0.5)
        followed.append(alive.copy())
    return positions, followed


@dataclass(frozen=True, eq=False)
class Pose:
    """A camera found from points.

    Attributes:
        T_camera_from_world: (4, 4).
        inlier: (N,) bool.
        residual_px: (N,), distance from each projection; inf behind the camera.
        good: enough points agree.

    """

    T_camera_from_world: Float
    inlier: Bool
    residual_px: Float
    good: bool


def find_pose(points: Float, uv: Float, K: Float, start: Float) -> Pose:
    """Camera that sees points (N, 3) at (N, 2): refined from ``start``; RANSAC if that fails."""
    pose = _judged(points, uv, K, _refined(points, uv, K, start))
    if pose.good or len(points) < MIN_INLIERS:
        return pose
    cv2.setRNGSeed(0)
    solved, rotvec, translation, _ = cv2.solvePnPRansac(
        points, uv, K, np.zeros(4), iterationsCount=300, reprojectionError=2 * INLIER_PX
    )
    if not solved:
        return pose
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(rotvec.ravel()).as_matrix()
    T[:3, 3] = translation.ravel()
    again = _judged(points, uv, K, _refined(points, uv, K, T))
    return again if again.inlier.sum() > pose.inlier.sum() else pose


def reproject(points: Float, K: Float, T: Float) -> tuple[Float, Float]:
    """Pixels (N, 2) and depth (N,) of world points (N, 3); pixels are inf behind the camera."""
    camera = points @ T[:3, :3].T + T[:3, 3]
    depth = camera[:, 2]
    front = depth > 1e-9
    uv = np.full((len(points), 2), np.inf)
    uv[front] = camera[front, :2] / depth[front, None] * (K[0, 0], K[1, 1]) + K[:2, 2]
    return uv, depth


def _judged(points: Float, uv: Float, K: Float, T: Float) -> Pose:
    with np.errstate(invalid="ignore"):
        residual = np.linalg.norm(reproject(points, K, T)[0] - uv, axis=1)
    inlier = residual < INLIER_PX
    count = int(inlier.sum())
    good = count >= MIN_INLIERS and count >= MIN_INLIER_SHARE * len(points)
    return Pose(T, inlier, residual, good)


def _refined(points: Float, uv: Float, K: Float, start: Float) -> Float:
    """Gauss-Newton on SE(3) under a Cauchy loss whose scale shrinks from 8 to 1 pixels."""
    focal = np.array([K[0, 0], K[1, 1]])
    pose = start
    for scale in (8.0, 8.0, 4.0, 4.0, 2.0, 2.0, 1.0, 1.0, 1.0, 1.0):
        camera = points @ pose[:3, :3].T + pose[:3, 3]
        use = camera[:, 2] > 1e-9
        if use.sum() < 4:
            return pose
        x, y, z = camera[use].T
        error = np.stack([x / z, y / z], axis=1) * focal + K[:2, 2] - uv[use]
        weight = 1.0 / (1.0 + (error**2).sum(axis=1) / scale**2)
        zero = np.zeros_like(x)
        du = np.stack([1 / z, zero, -x / z**2, -x * y / z**2, 1 + x**2 / z**2, -y / z], axis=1)
        dv = np.stack([zero, 1 / z, -y / z**2, -1 - y**2 / z**2, x * y / z**2, x / z], axis=1)
        J = np.stack([du * focal[0], dv * focal[1]], axis=1)
        weighted = J * weight[:, None, None]
        H = np.einsum("nij,nik->jk", weighted, J)
        g = np.einsum("nij,ni->j", weighted, error)
        step = -np.linalg.solve(H + 1e-9 * np.trace(H) * np.eye(6), g)
        update = np.eye(4)
        update[:3, :3] = Rotation.from_rotvec(step[3:]).as_matrix()
        update[:3, 3] = step[:3]
        pose = update @ pose
    return pose


def between(T0: Float, T1: Float, alpha: float) -> Float:
    """Pose between two: centre on the line, rotation by slerp."""
    turns = Slerp([0.0, 1.0], Rotation.from_matrix(np.stack([T0[:3, :3], T1[:3, :3]])))
    R = turns(alpha).as_matrix()
    centres = [-T[:3, :3].T @ T[:3, 3] for T in (T0, T1)]
    T = np.eye(4)
    T[:3, :3] = R
    T[:3, 3] = -R @ ((1 - alpha) * centres[0] + alpha * centres[1])
    return T


@dataclass(frozen=True, eq=False)
class Keyframe:
    """A mapped frame: its number, pose (4, 4), the map points it sees and where it sees them."""

    frame: int
    T_camera_from_world: Float
    point: Int
    uv: Float


@dataclass(frozen=True, eq=False)
class Densified:
    """Every frame from the first to the last keyframe.

    Attributes:
        first: number of the first of them.
        T_camera_from_world: (F, 4, 4).
        solved: (F,) bool; the others are interpolated.
        residual_px: (F,) mean over inliers; NaN at keyframes and where interpolated.

    """

    first: int
    T_camera_from_world: Float
    solved: Bool
    residual_px: Float


def densify(
    images: list[UInt8], masks: list[UInt8], keyframes: list[Keyframe], points: Float, K: Float
) -> Densified:
    """Poses between keyframes from map points (P, 3) followed from both sides.

    Args:
        images, masks: of all frames of the clip; a mask is 0 on what moves by itself.
        keyframes: in order, at least one.
        points: the map.
        K: the camera.

    """
    first, last = keyframes[0].frame, keyframes[-1].frame
    T = np.tile(np.eye(4), (last - first + 1, 1, 1))
    solved = np.zeros(len(T), dtype=bool)
    residual = np.full(len(T), np.nan)
    for keyframe in keyframes:
        T[keyframe.frame - first] = keyframe.T_camera_from_world
        solved[keyframe.frame - first] = True
    for left, right in pairwise(keyframes):
        numbers = range(left.frame + 1, right.frame)
        tracks = _tracks_between(images, left, right)
        for i, frame in enumerate(numbers):
            alpha = (frame - left.frame) / (right.frame - left.frame)
            start = between(left.T_camera_from_world, right.T_camera_from_world, alpha)
            point, uv = tracks[i]
            inside = uv.astype(np.int64).clip(0, np.array(masks[frame].shape[::-1]) - 1)
            free = masks[frame][inside[:, 1], inside[:, 0]] > 0
            pose = find_pose(points[point[free]], uv[free], K, start)
            at = frame - first
            T[at] = pose.T_camera_from_world if pose.good else start
            solved[at] = pose.good
            if pose.good:
                residual[at] = pose.residual_px[pose.inlier].mean()
    return Densified(first, T, solved, residual)


def _tracks_between(
    images: list[UInt8], left: Keyframe, right: Keyframe
) -> list[tuple[Int, Float]]:
    """Per frame strictly between: map points and pixels, followed from the left and the right."""
    forward = follow(images[left.frame : right.frame], left.uv)
    backward = follow(images[right.frame : left.frame : -1], right.uv)
    count = right.frame - left.frame - 1
    merged: list[tuple[Int, Float]] = []
    for i in range(count):
        ahead, behind = forward[1][i], backward[1][count - 1 - i]
        point = np.concatenate([left.point[ahead], right.point[behind]])
        uv = np.concatenate([forward[0][i][ahead], backward[0][count - 1 - i][behind]])
        merged.append((point, uv))
    return merged
