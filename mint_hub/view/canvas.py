"""Drawing on numpy images with OpenCV: anti-aliased lines, text, chips, and the house colours.

Images are (H, W, 3) uint8 RGB and are drawn on in place. Points are (u, v) pixels with fractions.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from mint_hub.geometry import arrays

Image = NDArray[np.uint8]
Point = Sequence[float] | NDArray[np.floating]
Color = tuple[int, int, int]
Anchor = Literal["left", "center", "right"]

INK: Final = (31, 36, 43)
MUTED: Final = (107, 116, 128)
RULE: Final = (229, 232, 236)
FAINT: Final = (243, 245, 247)
WHITE: Final = (255, 255, 255)
CAMERA: Final = (62, 70, 82)
SIDE_COLORS: Final[tuple[Color, Color]] = ((0, 110, 190), (213, 94, 0))
"""Left is blue, right is vermilion: told apart with every common colour blindness."""

_FRACTION_BITS: Final = 4
_FAR: Final = 16_000.0


@dataclass(frozen=True)
class _Font:
    """OpenCV 5 draws with a real typeface, OpenCV 4 only with its stroke font."""

    face: Any

    def width(self, text: str, size: float, weight: int) -> int:
        cv: Any = cv2
        if self.face is not None:
            box = cv.getTextSize((8192, 8192), text, (0, 4096), self.face, round(size), weight)
            return int(box[2])
        return int(cv.getTextSize(_ascii(text), cv2.FONT_HERSHEY_SIMPLEX, size / 30, 1)[0][0])

    def draw(
        self, image: Image, text: str, xy: tuple[int, int], color: Color, size: float, weight: int
    ) -> None:
        cv: Any = cv2
        if self.face is not None:
            cv.putText(image, text, xy, color, self.face, round(size), weight)
            return
        thickness = max(1, round(size / 18 * (1 + (weight > 500))))
        font = cv2.FONT_HERSHEY_SIMPLEX
        cv2.putText(image, _ascii(text), xy, font, size / 30, color, thickness, cv2.LINE_AA)


def _font() -> _Font:
    cv: Any = cv2
    return _Font(cv.FontFace("sans") if hasattr(cv, "FontFace") else None)


def _ascii(text: str) -> str:
    table = {"·": "-", "…": "..."}
    return "".join(table.get(c, c) for c in text)


def blank(height: int, width: int, color: Color = WHITE) -> Image:
    """Make an image of one colour."""
    return np.full((height, width, 3), color, np.uint8)


def text_width(text: str, size: float, weight: int = 400) -> int:
    """Return the pixels that ``text`` takes from left to right."""
    return _font().width(text, size, weight)


def put_text(
    image: Image,
    text: str,
    xy: tuple[float, float],
    size: float,
    color: Color = INK,
    *,
    weight: int = 400,
    anchor: Anchor = "left",
) -> None:
    """Write one line with its baseline at ``xy``; ``anchor`` says which end of it ``xy`` is."""
    font = _font()
    shift = {"left": 0.0, "center": 0.5, "right": 1.0}[anchor]
    offset = shift * font.width(text, size, weight) if shift else 0.0
    font.draw(image, text, (round(xy[0] - offset), round(xy[1])), color, size, weight)


def fit_text(text: str, size: float, max_width: float, weight: int = 400) -> str:
    """Shorten ``text`` with an ellipsis until it fits."""
    if text_width(text, size, weight) <= max_width:
        return text
    while text and text_width(text + "…", size, weight) > max_width:
        text = text[:-1]
    return text.rstrip() + "…" if text else ""


def line(image: Image, a: Point, b: Point, color: Color, width: float = 1) -> None:
    """Draw one anti-aliased segment with sub-pixel ends; what is absurdly far away is not drawn."""
    ends = np.asarray([a, b], float)
    if not (np.abs(ends) < _FAR).all():  # NaN is not near either
        return
    first, last = _fixed(ends).tolist()
    cv2.line(image, first, last, color, max(1, round(width)), cv2.LINE_AA, _FRACTION_BITS)


def polyline(image: Image, points: NDArray[np.floating], color: Color, width: float = 1) -> None:
    """Draw anti-aliased connected segments through ``points`` (N, 2); NaN breaks the line."""
    near = np.isfinite(points) & (np.abs(np.nan_to_num(points)) < _FAR)
    usable = np.asarray(near.all(axis=-1))
    fixed = _fixed(np.where(usable[:, None], points, 0))
    for run in runs(usable):
        part = [fixed[run.start : run.stop].reshape(-1, 1, 2)]
        thickness = max(1, round(width))
        cv2.polylines(image, part, False, color, thickness, cv2.LINE_AA, _FRACTION_BITS)


def disc(image: Image, center: Point, radius: float, color: Color, width: float = -1) -> None:
    """Draw a filled disc, or a ring of ``width`` pixels."""
    point = np.asarray(center, float)
    if not np.isfinite(point).all() or (np.abs(point) >= _FAR).any():
        return
    x, y = (int(v) for v in _fixed(point))
    size = max(1, round(radius * (1 << _FRACTION_BITS)))
    thickness = -1 if width < 0 else max(1, round(width))
    cv2.circle(image, (x, y), size, color, thickness, cv2.LINE_AA, _FRACTION_BITS)


def rectangle(image: Image, a: Point, b: Point, color: Color, radius: float = 0) -> None:
    """Fill the rectangle between two corners, its corners rounded when ``radius`` > 0."""
    (x0, y0), (x1, y1) = a, b
    radius = min(radius, abs(x1 - x0) / 2, abs(y1 - y0) / 2)
    if radius < 1:
        corners = np.asarray([(x0, y0), (x1, y0), (x1, y1), (x0, y1)], float)
        cv2.fillPoly(image, [_fixed(corners)], color, cv2.LINE_AA, _FRACTION_BITS)
        return
    turn = np.linspace(0, np.pi / 2, 9)
    arc = np.stack([np.cos(turn), np.sin(turn)], axis=-1) * radius
    quarters = (
        np.array([x1 - radius, y1 - radius]) + arc,
        np.array([x0 + radius, y1 - radius]) + arc[:, ::-1] * (-1, 1),
        np.array([x0 + radius, y0 + radius]) - arc,
        np.array([x1 - radius, y0 + radius]) + arc[:, ::-1] * (1, -1),
    )
    corners = np.concatenate(quarters)
    cv2.fillPoly(image, [_fixed(corners)], color, cv2.LINE_AA, _FRACTION_BITS)


def chip(
    image: Image,
    text: str,
    xy: tuple[float, float],
    size: float,
    *,
    background: Color,
    color: Color = WHITE,
    opacity: float = 1.0,
    anchor: Anchor = "left",
) -> tuple[slice, slice]:
    """Draw a pill of text with its top corner at ``xy``; return the pixels it may touch."""
    width = text_width(text, size, 600) + 1.3 * size
    height = 1.75 * size
    x0 = xy[0] - {"left": 0.0, "center": width / 2, "right": width}[anchor]
    y0 = xy[1]
    rows = slice(max(0, int(y0) - 1), max(0, int(y0 + height) + 2))
    columns = slice(max(0, int(x0) - 1), max(0, int(x0 + width) + 2))
    before = image[rows, columns].copy()
    rectangle(image, (x0, y0), (x0 + width, y0 + height), background, radius=height / 2)
    if opacity < 1 and before.size:
        mixed = cv2.addWeighted(image[rows, columns], opacity, before, 1 - opacity, 0)
        image[rows, columns] = mixed
    put_text(image, text, (x0 + 0.65 * size, y0 + 1.23 * size), size, color, weight=600)
    return rows, columns


def mix(a: Color, b: Color, alpha: float) -> Color:
    """Return the colour ``alpha`` of the way from ``a`` to ``b``."""
    red, green, blue = (round(p + (q - p) * alpha) for p, q in zip(a, b, strict=True))
    return red, green, blue


def runs(mask: NDArray[np.bool_]) -> list[slice]:
    """Return the stretches of True in ``mask`` (N,), in order.

    >>> runs(np.array([True, True, False, True]))
    [slice(0, 2, None), slice(3, 4, None)]
    """
    return [slice(start, stop) for start, stop in arrays.runs(mask)]


def plural(count: int, noun: str) -> str:
    """Count things in words.

    >>> plural(1, "frame"), plural(450, "frame")
    ('1 frame', '450 frames')
    """
    return f"{count} {noun}{'' if count == 1 else 's'}"


def png_bytes(image: Image) -> bytes:
    """Return the image as a PNG file."""
    return _encoded(image, ".png", [cv2.IMWRITE_PNG_COMPRESSION, 9])


def jpeg_bytes(image: Image, quality: int = 88) -> bytes:
    """Return the image as a JPEG file."""
    return _encoded(image, ".jpg", [cv2.IMWRITE_JPEG_QUALITY, quality])


def _encoded(image: Image, suffix: str, options: list[int]) -> bytes:
    done, data = cv2.imencode(suffix, cv2.cvtColor(image, cv2.COLOR_RGB2BGR), options)
    assert done, suffix
    return data.tobytes()


def _fixed(points: NDArray[np.floating]) -> NDArray[np.int32]:
    """Fixed-point; OpenCV counts from the centre of the first pixel, we from its edge."""
    return np.round((points - 0.5) * (1 << _FRACTION_BITS)).astype(np.int32)
