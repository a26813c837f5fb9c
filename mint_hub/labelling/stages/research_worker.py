"""Other projects' functions, called in a Python that has them; stands alone (see `worker_side`).

Each function imports its project when first called and keeps the loaded model. Images come as
(N, H, W, 3) uint8 RGB. What is assumed of each project is what its README or demo shows.
"""

# pyright: reportMissingImports=false, reportAttributeAccessIssue=false

import os
import sys
import tempfile
from argparse import Namespace
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

models: dict[Any, Any] = {}


def yolo(
    arrays: dict[str, Any], *, weights: str, confidence: float, device: str
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Find boxes with ultralytics.

    Returns:
        Of N boxes: "frame" (N,) int32, "box" (N, 4) float32 x y x y in pixels, "score" (N,)
        float32, "kind" (N,) int32, the number of the class; and the classes' names.

    """
    if ("yolo", weights) not in models:
        from ultralytics import YOLO

        models["yolo", weights] = YOLO(weights)
    model = models["yolo", weights]
    found: list[Any] = []
    for frame, image in enumerate(arrays["images"]):
        bgr = np.ascontiguousarray(image[..., ::-1])  # arrays are taken to be BGR
        (result,) = model.predict(bgr, conf=confidence, verbose=False, device=device or None)
        boxes = result.boxes
        columns = (boxes.xyxy.cpu(), boxes.conf.cpu(), boxes.cls.cpu())
        rows = zip(*(np.asarray(column) for column in columns), strict=True)
        found += [(frame, box, score, kind) for box, score, kind in rows]
    return {
        "frame": np.array([f[0] for f in found], np.int32),
        "box": np.array([f[1] for f in found], np.float32).reshape(-1, 4),
        "score": np.array([f[2] for f in found], np.float32),
        "kind": np.array([f[3] for f in found], np.int32),
    }, {"names": {str(k): str(v) for k, v in model.names.items()}}


def geocalib(
    arrays: dict[str, Any], *, checkout: str, weights: str, device: str
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Calibrate one pinhole for all images, and gravity for each, with GeoCalib.

    Returns:
        "focal" (N, 2) float64 (fx, fy) pixels, "focal_uncertainty" (N,), "gravity" (N, 3) float64.

    """
    import torch

    place = device or ("cuda" if torch.cuda.is_available() else "cpu")
    if ("geocalib", weights, place) not in models:
        add_path(checkout)
        from geocalib import GeoCalib

        # GeoCalib asks torch hub for "geocalib/pinhole.tar" and takes it where it is there.
        with tempfile.TemporaryDirectory() as hub:
            os.makedirs(os.path.join(hub, "geocalib"))
            os.symlink(os.path.abspath(weights), os.path.join(hub, "geocalib", "pinhole.tar"))
            before = torch.hub.get_dir()
            torch.hub.set_dir(hub)
            try:
                models["geocalib", weights, place] = GeoCalib(weights="pinhole").to(place)
            finally:
                torch.hub.set_dir(before)
    images = torch.as_tensor(arrays["images"]).permute(0, 3, 1, 2).float() / 255
    model = models["geocalib", weights, place]
    result = model.calibrate(images.to(place), camera_model="pinhole", shared_intrinsics=True)
    count = len(images)

    def each(value: Any, *shape: int) -> np.ndarray:
        flat = np.asarray(value.detach().cpu(), np.float64).reshape(-1, *shape)
        return np.ascontiguousarray(np.broadcast_to(flat, (count, *shape)))

    return {
        "focal": each(result["camera"].f, 2),
        "focal_uncertainty": each(result["focal_uncertainty"]),
        "gravity": each(result["gravity"].vec3d, 3),
    }, {}


def moge2(
    arrays: dict[str, Any],
    *,
    checkout: str,
    weights: str,
    fov_x_deg: float,
    height: int,
    device: str,
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Estimate metric depth with MoGe-2.

    Returns:
        "depth_m" (N, h, w) float32, metres, of at most ``height`` rows, each value that of the
        pixel in the middle of its cell; NaN where MoGe's mask is not set.

    """
    import torch

    place = device or ("cuda" if torch.cuda.is_available() else "cpu")
    if ("moge2", weights, place) not in models:
        if checkout:
            add_path(checkout)
        from moge.model.v2 import MoGeModel

        models["moge2", weights, place] = MoGeModel.from_pretrained(weights).to(place).eval()
    depths: list[np.ndarray] = []
    for image in arrays["images"]:
        tensor = torch.as_tensor(image).permute(2, 0, 1).float().to(place) / 255
        fov = fov_x_deg or None
        output = models["moge2", weights, place].infer(
            tensor, fov_x=fov, use_fp16=place.startswith("cuda")
        )
        depth = np.array(output["depth"].float().cpu(), np.float32)
        valid = np.asarray(output["mask"].cpu(), bool) & np.isfinite(depth) & (depth > 0)
        depths.append(thinned(np.where(valid, depth, np.float32(np.nan)), height))
    return {"depth_m": np.stack(depths)}, {}


def droid(
    arrays: dict[str, Any], *, checkout: str, weights: str, focal: list[float], settings: Any
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Track a camera with DROID-SLAM.

    Args:
        arrays: "images", whose principal point is their middle.
        checkout, weights: of DROID-SLAM.
        focal: (fx, fy), pixels of the images.
        settings: what its demo calls its options, by name.

    Returns:
        "camera_to_world" (N, 7) float64: translation in units of its own, quaternion xyzw.

    """
    import cv2
    import torch

    add_path(os.path.join(checkout, "droid_slam"))
    from droid import Droid

    images = arrays["images"]
    rows, columns = images.shape[1:3]
    # The size its demo works at: the area of 384 x 512, sides multiples of 8.
    factor = np.sqrt(384 * 512 / (rows * columns))
    height, width = int(rows * factor), int(columns * factor)
    keep_h, keep_w = height - height % 8, width - width % 8
    fx, fy = focal[0] * width / columns, focal[1] * height / rows
    intrinsics = torch.as_tensor([fx, fy, width / 2, height / 2])

    def stream() -> Iterator[tuple[int, Any, Any]]:
        for number, image in enumerate(images):
            small = cv2.resize(image[..., ::-1], (width, height))[:keep_h, :keep_w]
            tensor = torch.as_tensor(np.ascontiguousarray(small)).permute(2, 0, 1)
            yield number, tensor[None], intrinsics.clone()

    options = Namespace(**settings, weights=weights, image_size=[keep_h, keep_w])
    slam = Droid(options)
    for number, image, calibration in stream():
        slam.track(number, image, intrinsics=calibration)
    return {"camera_to_world": np.asarray(slam.terminate(stream()), np.float64)}, {}


def hawor(
    arrays: dict[str, Any], *, checkout: str, checkpoint: str, video: str, focal: float
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Estimate hands with HaWoR; it writes ``cam_space/SIDE/FIRST_LAST.json`` beside the frames.

    Args:
        arrays: none.
        checkout: of HaWoR; it is made the working folder, weights are found from there.
        checkpoint: ``hawor.ckpt``.
        video: path VIDEO.mp4, which need not exist: frames are in ``VIDEO/extracted_images``.
        focal: pixels.

    """
    assert not arrays
    add_path(checkout)
    os.chdir(checkout)
    from scripts.scripts_test_video.detect_track_video import detect_track_video
    from scripts.scripts_test_video.hawor_video import hawor_motion_estimation

    options = Namespace(video_path=video, img_focal=focal, checkpoint=checkpoint, input_type="file")
    first, stop, folder, _ = detect_track_video(options)
    hawor_motion_estimation(options, first, stop, folder)
    return {}, {"frames": int(stop - first)}


def add_path(folder: str) -> None:
    """Let modules of a checkout be imported, before any other of the same name."""
    path = str(Path(folder).resolve())
    if path not in sys.path:
        sys.path.insert(0, path)


def thinned(depth: np.ndarray, height: int) -> np.ndarray:
    """Keep the value in the middle of each cell, so that at most ``height`` rows are left."""
    rows, columns = depth.shape
    height = min(height, rows)
    width = max(1, round(columns * height / rows))
    at_row = ((np.arange(height) + 0.5) * rows / height).astype(int)
    at_column = ((np.arange(width) + 0.5) * columns / width).astype(int)
    return depth[np.ix_(at_row, at_column)]


if __name__ == "__main__":
    from worker_side import serve

    methods = (yolo, geocalib, moge2, droid, hawor)
    serve({method.__name__: method for method in methods})
