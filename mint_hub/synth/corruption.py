"""What a real camera does to a picture: motion blur, exposure and colour that drift, a lens, noise.

Light is handled linearly (gamma 2.2). Labels belong to the middle of the exposure and stay exact:
only a lens moves them, together with the picture.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, fields, replace
from functools import cache
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from mint_hub.geometry.lenses import Lens
from mint_hub.loaders.clips import encode_clip
from mint_hub.synth.render import Rendered

DRIFT_FRAMES: Final = 40.0
"""Frames over which exposure and colour drift: their time constant."""

LONGEST_STEP_PX: Final = 1.5
"""Motion blur takes a sample at least this often, up to MOST_STEPS."""

MOST_STEPS: Final = 11
_LEVELS: Final = 4096

_LIMITS: Final = {
    "shutter": (0.0, 1.0),
    "vignette": (0.0, 1.0),
    "crf": (0.0, 51.0),
    "exposure": (-6.0, 6.0),
    "contrast": (0.2, 4.0),
}

TONE_MIDDLE: Final = 0.45
"""Code value, of 1, that contrast leaves as it is."""


@dataclass(frozen=True)
class Corruption:
    """How bad a camera is; the default is a perfect one.

    Attributes:
        shutter: share of the time between frames during which light is gathered, 0 to 1.
        exposure_drift: standard deviation of the slow change of exposure, stops.
        white_drift: the same of red against blue, stops.
        vignette: how much darker the corners are, 0 to 1.
        blur_px: standard deviation of the lens's blur, pixels.
        shot_noise: standard deviation of the noise of white, in its share, growing with light.
        read_noise: standard deviation of the noise of black.
        crf: of the H.264 that `encode` makes, 0 (best) to 51.
        exposure: stops by which pictures are brighter (or, below 0, darker) than they were drawn.
        contrast: slope of the tone curve about its middle, in code values; its ends are soft.

    """

    shutter: float = 0.0
    exposure_drift: float = 0.0
    white_drift: float = 0.0
    vignette: float = 0.0
    blur_px: float = 0.0
    shot_noise: float = 0.0
    read_noise: float = 0.0
    crf: int = 18
    exposure: float = 0.0
    contrast: float = 1.0

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            low, high = _LIMITS.get(field.name, (0.0, np.inf))
            if not low <= value <= high:
                raise ValueError(
                    f"corruption, {field.name}: expected {low:g} to {high:g}, got {value}"
                )


def corrupt(
    frames: Iterable[Rendered],
    settings: Corruption,
    seed: int,
    lens: Lens | None = None,
    fov_vh_rad: tuple[float, float] | None = None,
) -> Iterator[Rendered]:
    """Pass frames through a camera; the same seed makes the same pictures.

    Args:
        frames: of one world in order, from any frame on; with "flow" where the shutter is not 0.
        settings: how bad it is.
        seed: of noise and drift.
        lens: what the pictures are resampled to, depth and segments too (``flow`` is dropped): the
            pinhole of ``fov_vh_rad`` should cover it (`covering_fov`); what it does not is black.
        fov_vh_rad: (vertical, horizontal) of the frames; needed with a lens alone.

    Raises:
        ValueError: a shutter without flow, a lens without field of view.

    """
    if lens is not None and fov_vh_rad is None:
        raise ValueError("fov_vh_rad: expected that of the frames beside a lens, got None")
    rng = np.random.default_rng(seed)
    drift = np.zeros(2)
    maps: tuple[NDArray[np.float32], NDArray[np.float32]] | None = None
    for first, frame in enumerate(frames):
        kick = rng.standard_normal(2)
        keep = np.exp(-1 / DRIFT_FRAMES) if first else 0.0
        drift = keep * drift + np.sqrt(1 - keep * keep) * kick
        linear = _to_linear()[frame.rgb]
        if settings.shutter > 0:
            linear = _smeared(linear, frame, settings.shutter)
        if lens is not None:
            assert fov_vh_rad is not None
            maps = maps or lens_maps(lens, fov_vh_rad, frame.rgb.shape[:2])
            linear = cv2.remap(linear, *maps, cv2.INTER_LINEAR)
            frame = _bent(frame, maps)
        if settings.blur_px > 0:
            linear = cv2.GaussianBlur(linear, (0, 0), settings.blur_px)
        linear = linear * _gain(linear.shape[:2], settings, drift)
        if settings.shot_noise > 0 or settings.read_noise > 0:
            noise = rng.standard_normal(linear.shape, np.float32)
            level = settings.shot_noise**2 * linear + settings.read_noise**2
            linear = linear + noise * np.sqrt(level)
        yield replace(frame, rgb=_to_code(linear, settings.contrast))


def encode(frames: Iterable[Rendered], settings: Corruption, fps: float = 30.0) -> bytes:
    """Encode the pictures as an mp4 of that quality; see `mint_hub.loaders.clips.encode_clip`."""
    return encode_clip((frame.rgb for frame in frames), fps=fps, crf=settings.crf)


def covering_fov(lens: Lens) -> tuple[float, float]:
    """Find the (vertical, horizontal) field of view, radians, of a pinhole that sees all of a lens.

    Raises:
        ValueError: the lens sees 170 degrees or more across, which no pinhole does well.

    """
    seen = _border(lens)
    if not np.isfinite(seen).all():  # a circle in the picture: the border is not what ends it
        rays = _rays(lens)
        seen = rays[np.isfinite(rays).all(-1)]
    with np.errstate(divide="ignore", invalid="ignore"):
        tangents = np.abs(seen[:, :2] / seen[:, 2:]).max(0)
    if (seen[:, 2] <= 0).any() or tangents.max() > np.tan(np.deg2rad(85.0)):
        raise ValueError("lens: expected less than 170 degrees across, got more")
    horizontal, vertical = 2 * np.arctan(tangents * 1.01)
    return float(vertical), float(horizontal)


def lens_maps(
    lens: Lens, fov_vh_rad: tuple[float, float], image_size_hw: tuple[int, ...]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Find where each pixel of a lens's image lies in a pinhole's image: columns and rows (H, W).

    Integers are pixel centres, as ``cv2.remap`` has it; -2 where the pinhole does not see.
    """
    height, width = image_size_hw
    rays = _rays(lens)
    with np.errstate(divide="ignore", invalid="ignore"):
        flat = rays[..., :2] / rays[..., 2:]
    vertical, horizontal = (np.tan(a / 2) for a in fov_vh_rad)
    x = (flat[..., 0] / horizontal + 1) * width / 2 - 0.5
    y = (flat[..., 1] / vertical + 1) * height / 2 - 0.5
    with np.errstate(invalid="ignore"):
        seen = (rays[..., 2] > 0) & (np.abs(2 * x - width + 1) <= width)
        seen &= np.abs(2 * y - height + 1) <= height
    return tuple(np.where(seen, m, -2.0).astype(np.float32) for m in (x, y))  # pyright: ignore[reportReturnType]


def _border(lens: Lens) -> NDArray[np.float64]:
    """Rays (N, 3) of the outermost pixels: a lens is one-to-one, so none is further out."""
    height, width = lens.image_size_hw
    rows, columns = np.arange(height), np.arange(width)
    sides = [(columns, 0), (columns, height - 1), (0, rows), (width - 1, rows)]
    uv = [np.stack(np.broadcast_arrays(u, v), -1) for u, v in sides]
    return np.asarray(lens.unproject(np.concatenate(uv).astype(np.float64)))


def _rays(lens: Lens) -> NDArray[np.float64]:
    height, width = lens.image_size_hw
    uv = np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1).astype(np.float64)
    return np.asarray(lens.unproject(uv))


def _bent(frame: Rendered, maps: tuple[NDArray[np.float32], NDArray[np.float32]]) -> Rendered:
    """Resample the labels to the nearest pixel of the pinhole."""
    labels = {
        name: None if image is None else cv2.remap(image, *maps, cv2.INTER_NEAREST)
        for name, image in (("depth", frame.depth), ("segmentation", frame.segmentation))
    }
    return replace(frame, **labels, flow=None)


def _smeared(linear: NDArray[np.float32], frame: Rendered, shutter: float) -> NDArray[np.float32]:
    """Average along each pixel's motion, from half a shutter before to half a shutter after."""
    if frame.flow is None:
        raise ValueError('frames: expected the pass "flow" for motion blur, got none')
    height, width = linear.shape[:2]
    flow = cv2.blur(frame.flow, (5, 5)) * np.float32(shutter)
    longest = float(np.quantile(np.hypot(flow[..., 0], flow[..., 1])[::4, ::4], 0.98))
    steps = min(MOST_STEPS, 1 + 2 * int(np.ceil(longest / LONGEST_STEP_PX / 2)))
    if steps == 1:
        return linear
    columns = np.arange(width, dtype=np.float32)
    rows = np.arange(height, dtype=np.float32)[:, None]
    total = np.zeros_like(linear)
    for share in np.linspace(-0.5, 0.5, steps, dtype=np.float32):
        x, y = columns + share * flow[..., 0], rows + share * flow[..., 1]
        total += cv2.remap(linear, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return total / np.float32(steps)


def _gain(
    image_size_hw: tuple[int, ...], settings: Corruption, drift: NDArray[np.float64]
) -> NDArray[np.float32]:
    """Factor (H, W, 3) or (1, 1, 3) on the light."""
    stops = settings.exposure + settings.exposure_drift * drift[0]
    tint = settings.white_drift * drift[1] / 2
    colour = np.exp2(stops + tint * np.array([1.0, 0.0, -1.0])).astype(np.float32)
    if settings.vignette == 0:
        return colour.reshape(1, 1, 3)
    height, width = image_size_hw
    x, y = np.linspace(-1, 1, width, dtype=np.float32), np.linspace(-1, 1, height, dtype=np.float32)
    darker = 1 - settings.vignette * (0.5 * (x**2 + y[:, None] ** 2)) ** 1.5
    return darker[..., None].astype(np.float32) * colour


@cache
def _to_linear() -> NDArray[np.float32]:
    return ((np.arange(256) / 255) ** 2.2).astype(np.float32)


@cache
def _codes(contrast: float) -> NDArray[np.uint8]:
    """Codes of the square root of linear light in _LEVELS steps: fine in the dark.

    Contrast other than 1 bends them by a smooth curve through TONE_MIDDLE that stays in 0 to 1.
    """
    code = (np.arange(_LEVELS) / (_LEVELS - 1)) ** (2 / 2.2)
    if contrast != 1:
        low = TONE_MIDDLE * (code / TONE_MIDDLE) ** contrast
        rest = 1 - TONE_MIDDLE
        high = 1 - rest * (np.maximum(1 - code, 0) / rest) ** contrast
        code = np.where(code < TONE_MIDDLE, low, high)
    return np.round(255 * code).astype(np.uint8)


def _to_code(linear: NDArray[np.float32], contrast: float) -> NDArray[np.uint8]:
    root = np.sqrt(np.clip(linear, 0, 1)) * (_LEVELS - 1) + 0.5
    return _codes(contrast)[root.astype(np.uint16)]
