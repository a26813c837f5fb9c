"""Procedural pictures of surfaces: the same `Texture` gives the same image, which tiles.

Images are uint8 (512, 512, 3), the square root of linear reflectance (gamma 2), row 0 at v = 0.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from mint_hub.synth.world import TEXTURE_KINDS, Texture

SIZE: Final = 512
PAPER: Final = (0.72, 0.69, 0.60)
"""Linear colour of the last sixteenth (u > 15 / 16) of a label: pages of a book."""

Field = NDArray[np.float32]
Share = tuple[Field, Field]
"""Of every pixel: how much of ``colour_b`` (0 to 1), and a factor on the mixed colour."""


@lru_cache(maxsize=256)
def texture_image(texture: Texture) -> NDArray[np.uint8]:
    """Draw a texture.

    Raises:
        ValueError: an unknown kind.

    """
    if texture.kind not in TEXTURE_KINDS:
        raise ValueError(f"texture, kind: expected one of {TEXTURE_KINDS}, got {texture.kind!r}")
    rng = np.random.default_rng([TEXTURE_KINDS.index(texture.kind), texture.seed])
    share, tone = _KINDS[texture.kind](rng, max(1, round(texture.frequency)))
    a, b = (np.array(c, np.float32) for c in (texture.colour_a, texture.colour_b))
    linear = (a + np.clip(share, 0, 1)[..., None] * (b - a)) * tone[..., None]
    if texture.kind == "label":
        linear[:, SIZE * 15 // 16 :] = np.array(PAPER) * tone[:, SIZE * 15 // 16 :, None]
    return encoded(linear)


def encoded(linear: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Code linear reflectance as the shaders expect it; what is outside 0 to 1 is clipped."""
    return np.round(255 * np.sqrt(np.clip(linear, 0, 1))).astype(np.uint8)


def periodic_noise(rng: np.random.Generator, across: float, along: float | None = None) -> Field:
    """Smooth noise (512, 512) that tiles, mean 0, deviation 1.

    Args:
        rng: its source.
        across: blobs over the width, about.
        along: blobs over the height; as many as over the width without it.

    """
    white = np.fft.rfft2(rng.standard_normal((SIZE, SIZE), np.float32))
    fy, fx = np.fft.fftfreq(SIZE, 1 / SIZE)[:, None], np.fft.rfftfreq(SIZE, 1 / SIZE)
    white *= np.exp(-0.5 * ((fx / across) ** 2 + (fy / (along or across)) ** 2))
    white[0, 0] = 0
    noise = np.fft.irfft2(white, (SIZE, SIZE))
    return (noise / noise.std()).astype(np.float32)


def skin_image() -> NDArray[np.uint8]:
    """Variation of skin (512, 512, 4): blotches, fine cells, and two slopes of its relief.

    uint8, 128 is none; one repeat is meant for 64 mm.
    """
    rng = np.random.default_rng(7)
    blotches = 0.7 * periodic_noise(rng, 3) + 0.5 * periodic_noise(rng, 9)
    cells = 0.6 * periodic_noise(rng, 70, 45) + 0.5 * periodic_noise(rng, 28, 40)
    relief = cells + 0.8 * periodic_noise(rng, 18)
    fields = [b / b.std() for b in (blotches, cells, _slope(relief, 1), _slope(relief, 0))]
    return np.clip(128 + 40 * np.stack(fields, -1), 0, 255).round().astype(np.uint8)


def _slope(field: NDArray[np.floating], axis: int) -> NDArray[np.floating]:
    """Central differences of what tiles."""
    return np.roll(field, -1, axis) - np.roll(field, 1, axis)


def _grain(rng: np.random.Generator, strength: float = 0.06) -> Field:
    """Light and dark at several scales: no surface is of one colour."""
    fields = [periodic_noise(rng, n) for n in (5, 40, 150)]
    return (1 + 0.6 * strength * np.sum(fields, 0)).astype(np.float32)


def _rows_columns() -> tuple[NDArray[np.integer], NDArray[np.integer]]:
    rows, columns = np.mgrid[:SIZE, :SIZE]
    return rows, columns


def _wood(rng: np.random.Generator, planks: int) -> Share:
    rows, columns = _rows_columns()
    plank = rows * planks // SIZE
    warp = 0.9 * periodic_noise(rng, 2, 5) + 0.14 * periodic_noise(rng, 6, 40)
    start = rng.uniform(0, 7, planks)[plank]
    rings = 0.5 + 0.5 * np.sin(2 * np.pi * rows * max(9, 2 * planks) / SIZE + 2.6 * warp + start)
    pores = periodic_noise(rng, 9, 160)
    tone = 1 + 0.16 * rng.uniform(-1, 1, planks)[plank] + 0.05 * pores
    seam = np.abs((rows * planks % SIZE) - SIZE / 2) > SIZE / 2 - 1.2 * planks
    joint = (rng.integers(0, SIZE, planks)[plank] - columns) % SIZE < 2
    return (0.65 * rings + 0.2 * pores + 0.1).astype(np.float32), np.where(
        seam | (joint & (planks > 1)), 0.45, tone * _grain(rng, 0.03)
    ).astype(np.float32)


def _checker(rng: np.random.Generator, squares: int) -> Share:
    rows, columns = _rows_columns()
    n = max(2, squares + squares % 2)
    odd = (rows * n // SIZE + columns * n // SIZE) % 2
    return odd.astype(np.float32), _grain(rng)


def _stripes(rng: np.random.Generator, stripes: int) -> Share:
    columns = np.arange(SIZE)
    phase = (columns * stripes / SIZE) % 1
    wide, thin = rng.uniform(0.25, 0.6), rng.uniform(0.03, 0.1)
    line = (phase < wide) | ((phase > wide + 0.15) & (phase < wide + 0.15 + thin))
    return np.broadcast_to(line.astype(np.float32), (SIZE, SIZE)), _grain(rng)


def _noise(rng: np.random.Generator, blobs: int) -> Share:
    fields = [periodic_noise(rng, blobs * 2**k) * 0.6**k for k in range(4)]
    return (0.5 + 0.3 * np.sum(fields, 0)).astype(np.float32), _grain(rng, 0.04)


def _speckle(rng: np.random.Generator, chips: int) -> Share:
    share = np.zeros((SIZE, SIZE), np.float32)
    for scale, level in ((2.0, 1.5), (4.0, 1.7), (9.0, 2.0)):
        noise = periodic_noise(rng, scale * chips)
        share = np.maximum(share, np.clip((noise - level) * 6, 0, 1))
    return share, _grain(rng, 0.05)


def _plaster(rng: np.random.Generator, blobs: int) -> Share:
    relief = periodic_noise(rng, 8 * blobs)
    slope = _slope(relief, 0)
    share = 0.35 + 0.2 * periodic_noise(rng, blobs) + 0.12 * relief
    tone = 1 + 0.05 * slope / slope.std()
    return share.astype(np.float32), (tone * _grain(rng, 0.03)).astype(np.float32)


def _tiles(rng: np.random.Generator, tiles: int) -> Share:
    rows, columns = _rows_columns()
    row, column = rows * tiles // SIZE, columns * tiles // SIZE
    y, x = (rows * tiles / SIZE) % 1, (columns * tiles / SIZE) % 1
    gap = np.minimum(np.minimum(x, 1 - x), np.minimum(y, 1 - y))
    share = np.clip(1.5 - gap * SIZE / tiles / 2.0, 0, 1)
    tone = 1 + 0.13 * rng.uniform(-1, 1, (tiles, tiles))[row, column]
    tone = tone * (1 + 0.05 * (periodic_noise(rng, 12) + periodic_noise(rng, 60)))
    return share.astype(np.float32), (tone * _grain(rng, 0.03)).astype(np.float32)


def _fabric(rng: np.random.Generator, bands: int) -> Share:
    rows, columns = _rows_columns()
    threads = 2 * np.pi * 64 / SIZE
    weave = np.sin(rows * threads) * np.sin(columns * threads)
    widths = rng.uniform(0.2, 0.8, 2)
    plaid = ((rows * bands / SIZE) % 1 < widths[0]) * 0.5 + (
        (columns * bands / SIZE) % 1 < widths[1]
    ) * 0.5
    tone = 1 + 0.16 * weave + 0.05 * periodic_noise(rng, 90)
    return plaid.astype(np.float32), (tone * _grain(rng, 0.05)).astype(np.float32)


def _label(rng: np.random.Generator, lines: int) -> Share:
    """Fill with colour a, a panel of colour b with lines of letters, a picture and a band."""
    art = np.zeros((SIZE, SIZE), np.float32)
    left, right = 40, 440
    top, bottom = (int(n) for n in (rng.integers(90, 150), rng.integers(360, 430)))
    cv2.rectangle(art, (left, top), (right, bottom), 1.0, -1)
    y = top + 30
    step = (bottom - top - 40) // (lines + 2)
    for line in range(lines + 2):
        x, height = left + 20, max(4, int(step * (0.75 if line == 0 else 0.42)))
        while x < right - 40:
            width = int(rng.integers(height // 2 + 2, 3 * height + 6))
            if line % 3 != 2 or x < (left + right) // 2:
                end = (min(x + width, right - 20), y + height)
                cv2.rectangle(art, (x, y), end, 0.0, -1)
            x += width + max(4, height // 3)
        y += step
    centre = (int(rng.integers(300, 400)), int(rng.integers(bottom - 70, bottom - 30)))
    cv2.circle(art, centre, int(rng.integers(25, 60)), 0.5, -1)
    band = int(rng.integers(20, 50))
    art[band : band + int(rng.integers(8, 24))] = 1.0
    art[SIZE - band - 12 : SIZE - band] = 0.6
    return art[::-1], _grain(rng, 0.04)


_KINDS: Final[dict[str, Callable[[np.random.Generator, int], Share]]] = {
    "wood": _wood,
    "checker": _checker,
    "stripes": _stripes,
    "noise": _noise,
    "speckle": _speckle,
    "plaster": _plaster,
    "tiles": _tiles,
    "fabric": _fabric,
    "label": _label,
}
