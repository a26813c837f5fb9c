"""Lenses for synthetic clips: drawn per clip, put before a world's pinhole, answered for in labels.

A lens has the focal lengths of the world's pinhole and bends what lies off its axis. The camera of
the labels stays that pinhole, which is what ``geometry.lenses.rectification(lens)`` resamples the
pictures to; where things are *seen*, the pictures themselves decide.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from mint_hub.geometry.camera import K_to_fov_vh, fov_vh_to_K, on_screen, project
from mint_hub.geometry.lenses import KannalaBrandtLens, Lens, OpenCVLens, rectification
from mint_hub.synth.corruption import covering_fov, lens_maps
from mint_hub.synth.presets import preset_named, rng_of
from mint_hub.synth.world import World

__all__ = ["Bend", "draw_lens", "in_picture", "pinhole_of", "require_share", "seen_through"]

LENS_STREAM: Final = 8
FISHEYES: Final = 0.25
"""Share of lenses that are fisheyes of Kannala and Brandt."""

TALLEST_RAD: Final = float(np.deg2rad(92.0))
"""No lens sees more than this vertically: beyond it one would look at one's own body."""

TANGENT: Final = (1 / 3, 2 / 15, 17 / 315, 62 / 2835)
"""tan(t) / t in powers of t^2: a fisheye with these numbers is nearly a pinhole."""


def require_share(share: float, preset: str) -> float:
    """Check the share of clips that get a lens.

    Raises:
        ValueError: not within 0 to 1; above 0 for a bench, whose clips are pinholes.

    """
    if not 0 <= share <= 1:
        raise ValueError(f"lens: expected a share of clips from 0 to 1, got {share}")
    if share > 0 and preset_named(preset).clips is not None:
        raise ValueError(f"lens: expected 0 for {preset}, whose clips have none, got {share}")
    return share


def draw_lens(world: World, share: float) -> Lens | None:
    """Draw the lens of a world without one, or None: a lens falls to ``share`` of all seeds.

    It comes from a stream of its own, so that everything else of the clip is as without it, and a
    seed that has a lens at one share has the same lens at every larger one. Three in four are
    radial-tangential (OpenCV's k1 k2 p1 p2), of up to an eighth of the corner's distance; the
    others are fisheyes between a pinhole and an equidistant one.

    Raises:
        ValueError: as `require_share`; a world that has a lens.

    """
    if world.lens is not None:
        raise ValueError("world, lens: expected none yet, got one")
    rng = rng_of(world.preset, world.seed, LENS_STREAM)
    if rng.random() >= require_share(share, world.preset):
        return None
    fisheye = bool(rng.random() < FISHEYES)
    numbers = rng.uniform(-1, 1, 4)
    strength = 1.0
    while True:
        lens = _lens(world, fisheye, strength * numbers, strength)
        if covering_fov(lens)[0] <= TALLEST_RAD or strength < 0.05:
            return lens
        strength *= 0.7


def _lens(world: World, fisheye: bool, numbers: NDArray[np.float64], strength: float) -> Lens:
    """Make a lens over the world's pinhole from four numbers, -1 to 1."""
    height, width = size = world.image_size_hw
    K = np.asarray(fov_vh_to_K(np.asarray(world.fov_vh_rad, np.float64), size))
    pinhole = float(K[0, 0]), float(K[1, 1]), (width - 1) / 2, (height - 1) / 2
    if fisheye:
        share = 1 - strength * 0.35 + 0.25 * numbers[0]
        return KannalaBrandtLens(size, *pinhole, tuple(share * t for t in TANGENT))
    corner = float(np.hypot(width / pinhole[0], height / pinhole[1])) / 2
    k1 = (0.09 * numbers[0] - 0.04 * strength) / corner**2  # barrels rather than pincushions
    k2 = 0.02 * numbers[1] / corner**4
    p1, p2 = 0.008 * numbers[2:] / corner
    return OpenCVLens(size, *pinhole, (k1, k2, float(p1), float(p2)))


def seen_through(world: World, lens: Lens) -> World:
    """Put a lens before a world: what is drawn covers it, no coarser than before in the middle.

    Raises:
        ValueError: a lens of another image size, or one that sees 170 degrees or more across.

    """
    if lens.image_size_hw != tuple(world.image_size_hw):
        raise ValueError(
            f"lens, image_size_hw: expected the world's {tuple(world.image_size_hw)}, "
            f"got {lens.image_size_hw}"
        )
    fov = covering_fov(lens)
    size = [
        int(np.ceil(pixels * np.tan(new / 2) / np.tan(old / 2)))
        for pixels, new, old in zip(world.image_size_hw, fov, world.fov_vh_rad, strict=True)
    ]
    return replace(world, lens=lens, fov_vh_rad=fov, image_size_hw=(size[0], size[1]))


def pinhole_of(world: World) -> tuple[NDArray[np.float64], tuple[int, int]]:
    """Camera of the labels: (vertical, horizontal) field of view (2,), radians, and image size.

    With a lens it is the pinhole of ``rectification(lens)``: the lens's focal lengths, the middle
    of the picture for principal point, the same size.
    """
    if world.lens is None:
        return np.asarray(world.fov_vh_rad, np.float64), world.image_size_hw
    size = world.lens.image_size_hw
    return np.asarray(K_to_fov_vh(rectification(world.lens).K, size)), size


def in_picture(world: World, points_camera: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Whether points (..., 3), metres, are inside what a world's camera shows: (...).

    The rule is that of ``geometry.camera.on_screen``, with the lens in the pinhole's place.
    """
    if world.lens is not None:
        uv = np.asarray(world.lens.project(points_camera)) + 0.5  # its integers are pixels' middles
        return np.asarray(on_screen(uv, points_camera[..., 2], world.lens.image_size_hw))
    K = np.asarray(fov_vh_to_K(np.asarray(world.fov_vh_rad), world.image_size_hw))
    with np.errstate(divide="ignore", invalid="ignore"):
        uv, z = project(points_camera, K)
    return np.asarray(on_screen(uv, z, world.image_size_hw))


class Bend:
    """Bends what is drawn of a world as its lens does; nothing for a world without one."""

    def __init__(self, world: World) -> None:
        size = world.image_size_hw
        self._maps = None if world.lens is None else lens_maps(world.lens, world.fov_vh_rad, size)

    def masks(self, masks: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Resample masks (N, H, W) to the nearest pixel; False where nothing was drawn."""
        if self._maps is None:
            return masks
        bent = [cv2.remap(m.astype(np.uint8), *self._maps, cv2.INTER_NEAREST) for m in masks]
        return np.stack(bent).astype(np.bool_)
