"""One figure a clip: where the camera and both wrists went, and when the hands were there.

Three orthographic views of the world at one common scale (top x-z, side z-y, front x-y; y points
down in the world and in the figure), and time strips of presence and score. OpenCV only.
"""

import itertools
import math
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from mint_hub.conventions import SIDES
from mint_hub.loaders.atomic import replacing
from mint_hub.loaders.schema import Episode
from mint_hub.view import canvas
from mint_hub.view.canvas import (
    CAMERA,
    INK,
    MUTED,
    RULE,
    SIDE_COLORS,
    WHITE,
    Color,
    Image,
    Point,
    plural,
)
from mint_hub.view.strips import Box, draw_strips, nice_step, strips_height, tick_label, ticks

SCALE: Final = 2
"""Everything is drawn this many times larger, then averaged down."""

WIDTH: Final = 1800
MARGIN: Final = 70
PANEL: Final = 510
GUTTER: Final = 65
MAX_SEGMENTS: Final = 1500
NUM_VIEW_TICKS: Final = 14


@dataclass(frozen=True)
class View:
    """An orthographic view: which world axes run right and up, and with which sign."""

    title: str
    note: str
    right: tuple[int, int]
    up: tuple[int, int]

    def flat(self, points: NDArray[np.floating]) -> NDArray[np.float64]:
        """(..., 3) world metres to (..., 2) metres right and up in the figure."""
        axes = (self.right, self.up)
        return np.stack([sign * points[..., axis].astype(float) for axis, sign in axes], axis=-1)


VIEWS: Final = (
    View("Top", "seen from above", right=(0, 1), up=(2, 1)),
    View("Side", "seen from the right", right=(2, 1), up=(1, -1)),
    View("Front", "as the first camera looks", right=(0, 1), up=(1, -1)),
)


@dataclass(frozen=True)
class Axes:
    """A square panel on the canvas that shows ``span`` metres around ``center``."""

    left: float
    top: float
    size: float
    center: NDArray[np.float64]
    span: float

    def pixels(self, flat: NDArray[np.float64]) -> NDArray[np.float64]:
        """Metres (..., 2), right and up, to pixels."""
        unit = (flat - self.center) / self.span * (1, -1) + 0.5
        return unit * self.size + (self.left, self.top)


def trajectory_plot(episode: Episode) -> Image:
    """Draw the figure, (H, 1800, 3) uint8 RGB.

    Absent hands break the lines. Lines darken with time; a ring starts and a disc ends each.
    """
    top, strips_top = 205, 205 + PANEL + 105
    height = strips_top + strips_height(episode)
    image = canvas.blank(height * SCALE, WIDTH * SCALE)
    _title(image, episode)
    paths = _paths(episode)
    for view, axes in zip(VIEWS, _axes(paths, top), strict=True):
        _grid(image, view, axes)
        _view_ticks(image, axes, view, episode)
        for points, color, width in reversed(paths):
            _path(image, axes, view.flat(points), color, width)
        _ends(image, axes, view, paths)
    draw_strips(image, episode, Box(MARGIN, strips_top, WIDTH - MARGIN, height), SCALE)
    return cv2.resize(image, (WIDTH, height), interpolation=cv2.INTER_AREA).astype(np.uint8)


def write_trajectory_plot(episode: Episode, path: str | PathLike[str]) -> Path:
    """Write ``trajectory_plot`` as a PNG, whole or not at all, and return its path.

    Raises:
        ValueError: the path does not end in .png.

    """
    path = Path(path)
    if path.suffix.lower() != ".png":
        raise ValueError(f"{path}: expected a name that ends in .png")
    with replacing(path) as temporary:
        temporary.write_bytes(canvas.png_bytes(trajectory_plot(episode)))
    return path


def facts(episode: Episode) -> str:
    """Say duration, frames, path length and speed in one line."""
    seconds = episode.duration_s
    parts = [f"{seconds:.2f} s", f"{plural(episode.num_frames, 'frame')} at {episode.fps:.4g} fps"]
    parts.append(f"camera path {episode.path_length_m:.2f} m")
    if episode.num_frames > 1:
        elapsed = float(episode.timestamps_s[-1] - episode.timestamps_s[0])
        parts.append(f"mean speed {episode.path_length_m / elapsed:.2f} m/s")
    if scale := episode.meta.get("scale_status"):
        parts.append(f"scale: {scale}")
    return "  ·  ".join(parts)


# ------------------------------------------------------------------ header


def _title(image: Image, episode: Episode) -> None:
    s = SCALE
    title = canvas.fit_text(episode.key, 34 * s, (WIDTH - 2 * MARGIN) * s, 600)
    canvas.put_text(image, title, (MARGIN * s, 72 * s), 34 * s, INK, weight=600)
    line = canvas.fit_text(facts(episode), 19 * s, (WIDTH - 2 * MARGIN) * s)
    canvas.put_text(image, line, (MARGIN * s, 106 * s), 19 * s, MUTED)
    x = MARGIN * s
    for name, color in (("camera", CAMERA), *zip(_wrist_names(), SIDE_COLORS, strict=True)):
        canvas.line(image, (x, 139 * s), (x + 30 * s, 139 * s), color, 3.5 * s)
        x = _legend_text(image, name, x + 40 * s)
    _view_arrow(image, np.array([x + 4 * s, 146.0 * s]), np.array([18.0, -12.0]) * s)
    x = _legend_text(image, "viewing direction", x + 34 * s)
    _ring(image, (x + 6 * s, 139 * s), CAMERA)
    x = _legend_text(image, "start", x + 22 * s)
    canvas.disc(image, (x + 6 * s, 139 * s), 7 * s, CAMERA)
    _legend_text(image, "end", x + 22 * s)


def _wrist_names() -> tuple[str, ...]:
    return tuple(f"{side} wrist" for side in SIDES)


def _legend_text(image: Image, name: str, x: float) -> float:
    canvas.put_text(image, name, (x, 145 * SCALE), 17 * SCALE, INK)
    return x + canvas.text_width(name, 17 * SCALE) + 34 * SCALE


# ------------------------------------------------------------------ panels

Paths = list[tuple[NDArray[np.float64], Color, float]]


def _paths(episode: Episode) -> Paths:
    """Positions (T, 3) in the world, colour and line width of the camera, left and right wrist."""
    wrists = episode.wrist_world()[..., :3, 3]
    camera = episode.T_world_from_camera[:, :3, 3]
    hands = [(wrists[:, i], SIDE_COLORS[i], 2.4) for i in range(len(SIDES))]
    return [(camera, CAMERA, 3.2), *hands]


def _axes(paths: Paths, top: float) -> list[Axes]:
    """One panel a view, all at one scale: the longest side of the box around everything."""
    points = np.concatenate([p for p, _, _ in paths])
    points = points[np.isfinite(points).all(axis=-1)]
    low, high = points.min(axis=0), points.max(axis=0)
    span = max(0.1, 1.16 * float((high - low).max()))
    center = (low + high) / 2
    left = [MARGIN + i * (PANEL + GUTTER) for i in range(len(VIEWS))]
    return [
        Axes(x * SCALE, top * SCALE, PANEL * SCALE, view.flat(center), span)
        for x, view in zip(left, VIEWS, strict=True)
    ]


def _grid(image: Image, view: View, axes: Axes) -> None:
    s, step = SCALE, nice_step(axes.span, 7)
    x0, y0, x1, y1 = axes.left, axes.top, axes.left + axes.size, axes.top + axes.size
    canvas.rectangle(image, (x0, y0), (x1, y1), (251, 252, 253))
    for axis in range(2):
        low = axes.center[axis] - axes.span / 2
        for tick in ticks(low, low + axes.span, step):
            at = np.array(axes.center)
            at[axis] = tick
            x, y = axes.pixels(at)
            color = (200, 206, 214) if abs(tick) < step / 2 else RULE
            label = tick_label((view.right, view.up)[axis][1] * tick, step)
            if axis == 0:
                canvas.line(image, (x, y0), (x, y1), color, s)
                canvas.put_text(image, label, (x, y1 + 24 * s), 15 * s, MUTED, anchor="center")
            else:
                canvas.line(image, (x0, y), (x1, y), color, s)
                canvas.put_text(
                    image, label, (x0 - 10 * s, y + 5 * s), 15 * s, MUTED, anchor="right"
                )
    for a, b in (((x0, y1), (x1, y1)), ((x0, y0), (x0, y1))):
        canvas.line(image, a, b, (176, 183, 192), 1.5 * s)
    canvas.put_text(image, view.title, (x0, y0 - 16 * s), 20 * s, INK, weight=600)
    x = x0 + canvas.text_width(view.title, 20 * s, 600) + 12 * s
    canvas.put_text(image, view.note, (x, y0 - 16 * s), 16 * s, MUTED)
    right, up = ("xyz"[axis] for axis, _ in (view.right, view.up))
    canvas.put_text(image, f"{right} (m)", (x1, y1 + 48 * s), 16 * s, INK, anchor="right")
    canvas.put_text(image, f"{up} (m)", (x0 + 9 * s, y0 + 22 * s), 16 * s, INK)


def _path(image: Image, axes: Axes, flat: NDArray[np.float64], color: Color, width: float) -> None:
    step = max(1, math.ceil(len(flat) / MAX_SEGMENTS))
    kept = [*range(0, len(flat) - 1, step), len(flat) - 1]
    pixels = axes.pixels(flat)
    missing = np.asarray(np.isnan(pixels).any(axis=-1))
    for a, b in itertools.pairwise(kept):
        if not missing[a : b + 1].any():
            shade = canvas.mix(canvas.mix(WHITE, color, 0.38), color, b / max(1, len(flat) - 1))
            canvas.line(image, pixels[a], pixels[b], shade, width * SCALE)


def _ends(image: Image, axes: Axes, view: View, paths: Paths) -> None:
    for points, color, _ in reversed(paths):
        pixels = axes.pixels(view.flat(points))
        there = np.flatnonzero(np.isfinite(pixels).all(axis=-1))
        if there.size:
            _ring(image, pixels[there[0]], color)
            canvas.disc(image, pixels[there[-1]], 8.5 * SCALE, WHITE)
            canvas.disc(image, pixels[there[-1]], 7 * SCALE, color)


def _ring(image: Image, at: Point, color: Color) -> None:
    canvas.disc(image, at, 8.5 * SCALE, WHITE)
    canvas.disc(image, at, 5.8 * SCALE, color, 2.6 * SCALE)


def _view_ticks(image: Image, axes: Axes, view: View, episode: Episode) -> None:
    """Arrows along the optical axis at even times; one seen end-on is short."""
    T = episode.T_world_from_camera
    count = min(NUM_VIEW_TICKS, episode.num_frames)
    for k in np.unique(np.linspace(0, episode.num_frames - 1, count).round().astype(int)):
        start = axes.pixels(view.flat(T[k, :3, 3]))
        direction = view.flat(T[k, :3, 2]) * (1, -1)
        _view_arrow(image, start, direction * 34 * SCALE)


def _view_arrow(image: Image, start: NDArray[np.float64], step: NDArray[np.float64]) -> None:
    end = start + step
    color = canvas.mix(WHITE, CAMERA, 0.45)
    canvas.line(image, start, end, color, 1.4 * SCALE)
    length = float(np.hypot(*step))
    if length > 8 * SCALE:
        along = step / length * 7 * SCALE
        across = np.array([-along[1], along[0]]) * 0.45
        head = np.stack([end + across, end + along, end - across])
        fixed = np.round((head - 0.5) * 16).astype(np.int32)
        cv2.fillPoly(image, [fixed], color, cv2.LINE_AA, 4)
