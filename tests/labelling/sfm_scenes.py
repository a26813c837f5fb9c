"""A clip of a slanted, textured plane seen by a camera whose path is known exactly."""

from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from mint_hub.labelling.records import CameraPath, Clip, Intrinsics, StageReport, Video
from mint_hub.labelling.stages.sfm_points import MapPoints
from mint_hub.labelling.stages.sfm_tracking import Keyframe

SIZE_HW = (240, 320)
FOCAL = 260.0
K = np.array([[FOCAL, 0, 160.0], [0, FOCAL, 120.0], [0, 0, 1.0]])
NORMAL = np.array([0.25, -0.2, -1.0])
"""The plane is NORMAL . x = -1, about one unit in front of the first camera."""


def path(num_frames: int) -> np.ndarray:
    """Poses (T, 4, 4), camera_from_world; the first is the identity."""
    T = np.tile(np.eye(4), (num_frames, 1, 1))
    for t in range(num_frames):
        angle = [0.02 * np.sin(0.5 * t), 0.004 * t, 0.003 * t]
        T[t, :3, :3] = Rotation.from_rotvec(angle).as_matrix()
        T[t, :3, 3] = [-0.012 * t, 0.02 * np.sin(0.3 * t), 0.004 * t]
    return T


def on_plane(uv: np.ndarray, T: np.ndarray) -> np.ndarray:
    """World points (N, 3) of the plane at pixels (N, 2) of a camera."""
    R, t = T[:3, :3], T[:3, 3]
    rays = (np.column_stack([uv, np.ones(len(uv))]) @ np.linalg.inv(K).T) @ R
    centre = -R.T @ t
    along = (-1 - NORMAL @ centre) / (rays @ NORMAL)
    return centre + rays * along[:, None]


def pixels(points: np.ndarray, T: np.ndarray) -> np.ndarray:
    camera = points @ T[:3, :3].T + T[:3, 3]
    return camera[:, :2] / camera[:, 2:] * FOCAL + K[:2, 2]


def render(T: np.ndarray, seed: int = 0) -> list[np.ndarray]:
    """Gray images of the plane; pixel (u, v) has its centre half a pixel further."""
    rng = np.random.default_rng(seed)
    noise = rng.uniform(0, 255, (480, 640)).astype(np.float32)
    texture = cv2.GaussianBlur(noise, (0, 0), 2.0)
    texture = cv2.normalize(texture, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
    corners = np.array([[0, 0], [320, 0], [320, 240], [0, 240]], np.float64)
    world = on_plane((corners - 160) * 1.6 + 160, np.eye(4))
    from_texture = np.array([[0, 0], [640, 0], [640, 480], [0, 480]], np.float32) - 0.5
    images = []
    for pose in T:
        seen = (pixels(world, pose) - 0.5).astype(np.float32)
        H = cv2.getPerspectiveTransform(from_texture, seen)
        images.append(cv2.warpPerspective(texture, H, SIZE_HW[::-1], borderMode=cv2.BORDER_REFLECT))
    return images


def grid(step: int = 20) -> np.ndarray:
    u, v = np.meshgrid(np.arange(20, 301, step), np.arange(20, 221, step))
    return np.column_stack([u.ravel(), v.ravel()]).astype(np.float64)


def keyframes(T: np.ndarray, numbers: list[int]) -> tuple[list[Keyframe], np.ndarray]:
    """Keyframes that see one grid of points, and the points."""
    points = on_plane(grid(), T[numbers[0]])
    found = []
    for number in numbers:
        uv = pixels(points, T[number])
        inside = ((uv > 4) & (uv < np.array(SIZE_HW[::-1]) - 4)).all(axis=1)
        found.append(Keyframe(number, T[number].copy(), np.flatnonzero(inside), uv[inside]))
    return found, points


def clip_with_map(folder: Path, num_frames: int = 31, unit: float = 1.0) -> Clip:
    """A clip whose camera path counts in ``unit``s of the map that is kept beside it."""
    T = path(num_frames)
    times = 5.0 + np.arange(num_frames) / 30.0
    found, points = keyframes(T, list(range(0, num_frames, 5)))
    MapPoints(
        timestamps_s=times,
        T_camera_from_world=T,
        image_size_hw=SIZE_HW,
        points=points,
        obs_frame=np.repeat([k.frame for k in found], [len(k.point) for k in found]),
        obs_point=np.concatenate([k.point for k in found]),
        obs_uv=np.concatenate([k.uv for k in found]),
    ).save(folder / "v-0.points.npz")
    scaled = T.copy()
    scaled[:, :3, 3] *= unit
    counts = np.full(num_frames, 100, np.float32)
    fov = (2 * np.arctan(120 / FOCAL), 2 * np.arctan(160 / FOCAL))
    report = StageReport("camera", "sfm", "1", numbers={"map_points": "/moved/v-0.points.npz"})
    return Clip(
        key="v-0",
        video=folder / "v.mp4",
        first_frame=0,
        image_size_hw=SIZE_HW,
        fps=30.0,
        source_timestamps_s=times,
        intrinsics=Intrinsics(fov, "given", 1.0),
        camera=CameraPath(scaled, np.ones(num_frames, bool), counts, 0.5, "sfm"),
        reports=(report,),
    )


def video_of(clip: Clip, enlarged: float = 1.0) -> Video:
    """Its video; the source is larger than the clip's frames by a factor."""
    size = (round(SIZE_HW[0] * enlarged), round(SIZE_HW[1] * enlarged))
    return Video("v", "v", "user", clip.video, 10.0, 30.0, size, clips=(clip,))
