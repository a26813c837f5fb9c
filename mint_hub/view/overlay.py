"""Hands drawn over the video they came from, through the predicted camera.

Left hands are cool colours, right hands warm ones; nearer bones cover farther ones. Pixels are
those of the conventions: the principal point is the image centre, whatever the frame's size.
"""

import warnings
from collections.abc import Callable, Iterator
from fractions import Fraction
from os import PathLike
from pathlib import Path
from typing import Any, Final

import av
import cv2
import numpy as np
from numpy.typing import NDArray

from mint_hub.conventions import KEYPOINT_BONES, SIDES
from mint_hub.geometry.hand_model import HandModel
from mint_hub.geometry.lenses import lens_from
from mint_hub.geometry.rectification import Rectification, rectification
from mint_hub.loaders.atomic import replacing
from mint_hub.loaders.schema import Episode
from mint_hub.loaders.video import OnError, VideoSource, iter_frames
from mint_hub.view import canvas
from mint_hub.view.canvas import MUTED, SIDE_COLORS, WHITE, Color, Image

NEAR_M: Final = 0.02
"""Nothing closer to the camera plane than this is drawn; bones are cut there."""

BONE_RADIUS_M: Final = 0.0024
ASPECT_TOLERANCE: Final = 0.02
OUTLINE: Final = (16, 20, 26)
INKY: Final = (20, 24, 31)

FINGER_COLORS: Final[tuple[tuple[Color, ...], tuple[Color, ...]]] = (
    ((94, 234, 212), (56, 189, 248), (59, 130, 246), (99, 102, 241), (167, 139, 250)),
    ((253, 224, 71), (251, 178, 60), (249, 128, 42), (239, 83, 80), (236, 94, 150)),
)
"""Thumb to pinky of the left hand, then of the right."""

WRIST_COLORS: Final[tuple[Color, Color]] = ((186, 230, 253), (254, 215, 170))

Progress = Callable[[int, int], object]


def draw_overlay(
    image: Image,
    episode: Episode,
    frame_index: int,
    hand_model: HandModel | None = None,
    mesh: bool = False,
) -> Image:
    """Return a copy of ``image`` with frame ``frame_index`` of the episode drawn on it.

    Args:
        image: (H, W, 3) uint8 RGB, any size with the episode's aspect ratio; already rectified when
            the episode's was.
        episode: what was seen.
        frame_index: which of its frames, 0 .. T - 1.
        hand_model: as in ``Episode.joints_camera``.
        mesh: draw the shaded surface under the skeleton.

    Raises:
        ValueError: no such frame, not an RGB image, or another aspect ratio.

    """
    if not 0 <= frame_index < episode.num_frames:
        raise ValueError(f"frame_index: expected 0 .. {episode.num_frames - 1}, got {frame_index}")
    K = frame_intrinsics(episode, image, frame_index)
    drawn = np.array(image)
    model = hand_model or episode.default_hand_model()
    state, there = episode.hand_state[frame_index], episode.presence[frame_index]
    space = episode.meta.get("shape_space") if there.any() else None  # no hand, no shape
    joints = np.asarray(model.keypoints(state, space))
    if mesh:
        for hand in np.argsort(-joints[:, 0, 2]).tolist():
            if there[hand]:
                vertices = np.asarray(model.vertices(state[hand], SIDES[hand], space))
                _draw_mesh(drawn, vertices, model.faces(SIDES[hand]), K, hand)
    _draw_skeletons(drawn, np.where(there[:, None, None], joints, np.nan), K)
    _draw_chips(drawn, episode, frame_index)
    return drawn


def overlay_frames(
    episode: Episode,
    video: VideoSource,
    hand_model: HandModel | None = None,
    mesh: bool = False,
    only: set[int] | None = None,
    on_error: OnError = "raise",
) -> Iterator[tuple[int, Image]]:
    """Yield (frame index, drawn frame) for the frames of ``episode`` that ``video`` has, in order.

    Frames are matched by presentation time, so windows of an episode find theirs. A lens in
    ``episode.meta["lens"]`` is undone first.

    Args:
        episode: what was seen.
        video: the video it was predicted from.
        hand_model: as in ``Episode.joints_camera``.
        mesh: draw the surface as well.
        only: draw and yield these frames only.
        on_error: as in `iter_frames`.

    Raises:
        VideoError: the video cannot be read.
        ValueError: the video has another aspect ratio than the episode.

    """
    t, half = episode.timestamps_s, 0.5 / episode.fps
    model = hand_model or episode.default_hand_model()
    wanted = set(range(episode.num_frames)) if only is None else set(only)
    if not wanted:
        return
    uniform = bool(np.abs(np.diff(t) - 2 * half).max(initial=0.0) < 0.02 * half)
    rate = episode.fps if uniform else None
    start, stop = float(t[min(wanted)]), float(t[max(wanted)]) + half
    undo: Rectification | None = None
    with iter_frames(video, fps=rate, start_s=start, stop_s=stop, on_error=on_error) as frames:
        for frame in frames:
            k = int(np.abs(t - frame.timestamp_s).argmin())
            if k not in wanted or abs(t[k] - frame.timestamp_s) > half:
                continue
            wanted.remove(k)
            image = frame.image
            if "lens" in episode.meta:
                undo = undo or _rectification(episode, image)
                image = undo.apply(image)
            yield k, draw_overlay(image, episode, k, model, mesh)


def write_overlay(
    episode: Episode,
    video: VideoSource,
    path: str | PathLike[str],
    hand_model: HandModel | None = None,
    mesh: bool = False,
    progress: Progress | None = None,
    on_error: OnError = "raise",
) -> Path:
    """Write an mp4 (H.264, else MPEG-4) of the video with hands drawn on it; return its path.

    Frames stream through; the file appears whole or not at all. An odd last row or column is cut.
    Frames of the episode that the video lacks are left out, with one warning.

    Args:
        episode: what was seen.
        video: the video it was predicted from.
        path: where to write; must end in .mp4.
        hand_model: as in ``Episode.joints_camera``.
        mesh: draw the surface as well.
        progress: called with (frames done, frames in all) after every frame.
        on_error: what damage in the video does, as in `iter_frames`.

    Raises:
        VideoError: the video cannot be read.
        ValueError: the path does not end in .mp4, the aspect ratios differ, or the video has none
            of the episode's frames.

    """
    path = Path(path)
    if path.suffix.lower() != ".mp4":
        raise ValueError(f"{path}: expected a name that ends in .mp4")
    done = 0
    with replacing(path) as temporary, av.open(temporary, "w", format="mp4") as container:
        stream: Any = None
        for k, image in overlay_frames(episode, video, hand_model, mesh, on_error=on_error):
            stream = stream or _add_stream(container, image, episode.fps)
            frame = av.VideoFrame.from_ndarray(image[: stream.height, : stream.width], "rgb24")
            elapsed = float(episode.timestamps_s[k] - episode.timestamps_s[0])
            frame.pts, frame.time_base = round(elapsed / stream.time_base), stream.time_base
            container.mux(stream.encode(frame))
            done += 1
            if progress is not None:
                progress(done, episode.num_frames)
        if stream is None:
            raise ValueError(f"{video}: expected frames of episode {episode.key}, found none")
        container.mux(stream.encode(None))
    if done < episode.num_frames:
        lost = episode.num_frames - done
        message = f"{path}: {lost} of {episode.num_frames} frames are not in the video"
        warnings.warn(message, stacklevel=2)
    return path


def frame_intrinsics(episode: Episode, image: Image, frame_index: int) -> NDArray[np.float64]:
    """K (3, 3) of one frame of the episode, in pixels of ``image``.

    Raises:
        ValueError: ``image`` is not (H, W, 3) uint8, or has another aspect ratio.

    """
    if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
        raise ValueError(f"image: expected (H, W, 3) uint8, got {image.shape} {image.dtype}")
    scale_y = image.shape[0] / episode.image_size_hw[0]
    scale_x = image.shape[1] / episode.image_size_hw[1]
    if abs(scale_x / scale_y - 1) > ASPECT_TOLERANCE:
        raise ValueError(
            f"image: expected the aspect ratio of (height, width) {episode.image_size_hw}, got "
            f"{image.shape[:2]} (episode {episode.key})"
        )
    return np.diag([scale_x, scale_y, 1.0]) @ episode.K[frame_index]


def to_pixels(points: NDArray[Any], K: NDArray[np.float64]) -> NDArray[np.float64]:
    """Project camera points (..., 3) to (..., 2) pixels; NaN behind NEAR_M and for NaN points."""
    z = points[..., 2:].astype(float)
    with np.errstate(invalid="ignore"):
        uv = points[..., :2] / np.where(z >= NEAR_M, z, np.nan)
    return uv * K[(0, 1), (0, 1)] + K[:2, 2]


# ----------------------------------------------------------------- drawing


def _draw_skeletons(image: Image, joints: NDArray[Any], K: NDArray[np.float64]) -> None:
    """Draw bones and joints of both hands (2, 21, 3), far ones first."""
    radius = max(1.0, image.shape[0] / 480)
    pieces: list[tuple[float, int, NDArray[np.float64], Color]] = []
    for hand in range(len(SIDES)):
        if np.isnan(joints[hand]).any():
            continue
        points = joints[hand].astype(float)
        for parent, child in KEYPOINT_BONES:
            bone = _cut_behind(points[[parent, child]])
            if bone is not None:
                color = FINGER_COLORS[hand][(child - 1) // 4]
                pieces.append((float(bone[:, 2].mean()), hand, bone, color))
        for i, point in enumerate(points):
            if point[2] >= NEAR_M:
                color = FINGER_COLORS[hand][(i - 1) // 4] if i else WRIST_COLORS[hand]
                # A little nearer than it is: a joint lies on the bones that meet in it.
                pieces.append((float(point[2]) - 0.004, hand, point[None], color))
    for depth, _, shape, color in sorted(pieces, key=lambda piece: -piece[0]):
        width = float(np.clip(K[1, 1] * BONE_RADIUS_M / max(depth, NEAR_M), 0.8, 9)) * radius**0.5
        pixels = to_pixels(shape, K)
        if len(pixels) == 2:
            canvas.line(image, pixels[0], pixels[1], OUTLINE, 2 * width + 2 * radius)
            canvas.line(image, pixels[0], pixels[1], color, 2 * width)
        else:
            canvas.disc(image, pixels[0], 1.45 * width + radius, OUTLINE)
            canvas.disc(image, pixels[0], 1.45 * width, canvas.mix(color, WHITE, 0.45))


def _cut_behind(bone: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Keep the part of a segment (2, 3) in front of NEAR_M, if any."""
    inside = bone[:, 2] >= NEAR_M
    if inside.all():
        return bone
    if not inside.any():
        return None
    a, b = bone if inside[0] else bone[::-1]
    share = (a[2] - NEAR_M) / (a[2] - b[2])
    end = a + share * (b - a)
    end[2] = NEAR_M
    return np.stack([a, end])


def _draw_mesh(
    image: Image, vertices: NDArray[Any], faces: NDArray[Any], K: NDArray[np.float64], hand: int
) -> None:
    """Blend a hand's surface, flat-shaded by a light at the camera, far triangles first."""
    pixels = to_pixels(vertices, K)
    corners = vertices[faces].astype(float)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)
    middle = corners.mean(axis=1)
    sight = middle / np.maximum(np.linalg.norm(middle, axis=-1, keepdims=True), 1e-12)
    facing = -(normal * sight).sum(axis=-1)
    flat = pixels[faces]
    usable = (facing > 0) & np.isfinite(flat).all(axis=(1, 2)) & (np.abs(flat) < 8000).all((1, 2))
    layer = image.copy()
    fixed = np.round((np.nan_to_num(flat) - 0.5) * 16).astype(np.int64)
    base = canvas.mix(SIDE_COLORS[hand], WHITE, 0.45)
    for i in np.argsort(-middle[:, 2]):
        if usable[i]:
            shade = canvas.mix(OUTLINE, base, 0.35 + 0.65 * float(facing[i]))
            cv2.fillConvexPoly(layer, fixed[i].astype(np.int32), shade, cv2.LINE_8, 4)
    cv2.addWeighted(layer, 0.72, image, 0.28, 0, dst=image)


def _draw_chips(image: Image, episode: Episode, k: int) -> None:
    """Write the time at the bottom left, and each hand with its score at its own side on top."""
    height, width = image.shape[:2]
    size = max(11.0, min(height, width) / 30)
    pad = 0.7 * size
    for hand, side in enumerate(SIDES):
        scores = episode.presence_score
        there = bool(episode.presence[k, hand])
        filled = episode.filled is not None and bool(episode.filled[k, hand])
        words = [
            side,
            "filled" if filled else "" if there else "absent",
            "" if scores is None or filled else f"{scores[k, hand]:.2f}",
        ]
        canvas.chip(
            image,
            "  ".join(filter(None, words)),
            (pad if hand == 0 else width - pad, pad),
            size,
            background=SIDE_COLORS[hand] if there else INKY,
            color=WHITE if there else canvas.mix(MUTED, WHITE, 0.35),
            opacity=0.92 if there else 0.6,
            anchor="left" if hand == 0 else "right",
        )
    time = float(episode.timestamps_s[k])
    place = (pad, height - pad - 1.75 * size)
    canvas.chip(image, f"{time:.2f} s   #{k}", place, size, background=INKY, opacity=0.6)


# ------------------------------------------------------------------- video


def _add_stream(container: Any, image: Image, fps: float) -> Any:
    """Add a stream of even size, H.264 where this build of FFmpeg has it."""
    rate = Fraction(fps).limit_denominator(1001)
    height, width = (n // 2 * 2 for n in image.shape[:2])
    if "libx264" in av.codecs_available:
        stream = container.add_stream("libx264", rate=rate, options={"crf": "20", "preset": "fast"})
    else:
        stream = container.add_stream("mpeg4", rate=rate, options={"qscale": "3"})
    stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
    stream.time_base = stream.codec_context.time_base = Fraction(1, 30_000)
    return stream


def _rectification(episode: Episode, image: Image) -> Rectification:
    height, width = image.shape[:2]
    lens = lens_from(episode.meta["lens"], (height, width))
    return rectification(lens)
