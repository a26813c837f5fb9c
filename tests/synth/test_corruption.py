"""Corruption does what its numbers say, to the picture alone."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from mint_hub.geometry.camera import fov_vh_to_K
from mint_hub.geometry.lenses import KannalaBrandtLens, PinholeLens
from mint_hub.loaders.clips import decode_window
from mint_hub.synth.corruption import (
    TONE_MIDDLE,
    Corruption,
    corrupt,
    covering_fov,
    encode,
    lens_maps,
)
from mint_hub.synth.render import Rendered

HW = (60, 80)
FOV = (0.9, 1.1)


def frames(count: int = 4, flow: tuple[float, float] = (0.0, 0.0)) -> list[Rendered]:
    rng = np.random.default_rng(1)
    picture = cv2.resize(rng.integers(30, 220, (15, 20, 3), np.uint8), HW[::-1])
    depth = np.full(HW, 2.0, np.float32)
    segments = np.full(HW, 4, np.uint8)
    segments[20:40, 30:50] = 1
    moved = np.broadcast_to(np.array(flow, np.float32), (*HW, 2)).copy()
    return [Rendered(k, picture, depth, segments, moved) for k in range(count)]


def pinhole() -> PinholeLens:
    K = fov_vh_to_K(np.array(FOV), HW)
    return PinholeLens(HW, K[0, 0], K[1, 1], (HW[1] - 1) / 2, (HW[0] - 1) / 2)


def test_a_perfect_camera_changes_nothing():
    for a, b in zip(frames(), corrupt(frames(), Corruption(), 0), strict=True):
        np.testing.assert_array_equal(a.rgb, b.rgb)


def test_the_seed_decides():
    settings = Corruption(exposure_drift=0.3, white_drift=0.1, shot_noise=0.05, read_noise=0.01)
    runs = [[f.rgb for f in corrupt(frames(), settings, seed)] for seed in (1, 1, 2)]
    np.testing.assert_array_equal(runs[0], runs[1])
    assert (np.array(runs[0]) != np.array(runs[2])).any()


def test_noise_has_its_deviation():
    grey = [replace(f, rgb=np.full((*HW, 3), 128, np.uint8)) for f in frames(1)]
    (noisy,) = corrupt(grey, Corruption(read_noise=0.02), 3)
    linear = (noisy.rgb / 255.0) ** 2.2
    assert linear.std() == pytest.approx(0.02, rel=0.1)
    assert linear.mean() == pytest.approx((128 / 255) ** 2.2, abs=0.002)


def test_drift_is_slow_and_has_its_deviation():
    grey = [replace(f, rgb=np.full((*HW, 3), 90, np.uint8)) for f in frames(1)] * 400
    means = [f.rgb.mean() for f in corrupt(grey, Corruption(exposure_drift=0.3), 5)]
    stops = np.log2((np.array(means) / 90) ** 2.2)
    assert np.abs(np.diff(stops)).max() < 0.35
    assert 0.1 < stops.std() < 0.6


def test_motion_blur_is_along_the_motion():
    (sharp, *_), (blurred, *_) = (
        frames(1),
        list(corrupt(frames(1, (8.0, 0.0)), Corruption(shutter=1.0), 0)),
    )
    across = [np.abs(np.diff(f.rgb.astype(float), axis=1)).mean() for f in (sharp, blurred)]
    along = [np.abs(np.diff(f.rgb.astype(float), axis=0)).mean() for f in (sharp, blurred)]
    assert across[1] < 0.6 * across[0]
    assert across[1] / across[0] < 0.8 * along[1] / along[0]
    light = [((f.rgb / 255.0) ** 2.2).mean() for f in (sharp, blurred)]
    assert light[1] == pytest.approx(light[0], rel=0.02)
    np.testing.assert_array_equal(blurred.segmentation, sharp.segmentation)


def test_a_vignette_darkens_corners_alone():
    white = [replace(f, rgb=np.full((*HW, 3), 200, np.uint8)) for f in frames(1)]
    (seen,) = corrupt(white, Corruption(vignette=0.5), 0)
    assert seen.rgb[30, 40, 0] == 200
    assert (seen.rgb[0, 0] / 200) ** 2.2 == pytest.approx(0.5, abs=0.03)


def test_the_pinhole_itself_as_a_lens_changes_nothing():
    for a, b in zip(frames(), corrupt(frames(), Corruption(), 0, pinhole(), FOV), strict=True):
        np.testing.assert_allclose(a.rgb, b.rgb, atol=1)
        np.testing.assert_array_equal(a.segmentation, b.segmentation)
        np.testing.assert_array_equal(a.depth, b.depth)
        assert b.flow is None


def test_a_lens_puts_rays_where_it_says():
    """Paint each pixel of the pinhole with its ray: every pixel of the lens then shows its own."""
    lens = KannalaBrandtLens((90, 120), 70.0, 71.0, 58.0, 46.0, (0.03, -0.01, 0.0, 0.0))
    fov, size = covering_fov(lens), (800, 1000)
    K = fov_vh_to_K(np.array(fov), size)
    columns, rows = np.meshgrid(np.arange(size[1]) + 0.5, np.arange(size[0]) + 0.5)
    rays = np.stack([(columns - K[0, 2]) / K[0, 0], (rows - K[1, 2]) / K[1, 1]], -1)
    maps = lens_maps(lens, fov, size)
    assert all((m >= 0).all() for m in maps)
    seen = cv2.remap(rays.astype(np.float32), *maps, cv2.INTER_LINEAR)
    uv = lens.project(np.concatenate([seen, np.ones((90, 120, 1))], -1).astype(np.float64))
    expected = np.stack(np.meshgrid(np.arange(120), np.arange(90)), -1)
    assert np.abs(uv - expected)[3:-3, 3:-3].max() < 0.05


def test_what_the_pinhole_does_not_see_is_black():
    lens = KannalaBrandtLens(HW, 40.0, 40.0, 39.5, 29.5, (0.0, 0.0, 0.0, 0.0))
    (seen,) = corrupt(frames(1), Corruption(), 0, lens, FOV)
    assert (seen.rgb[0, 0] == 0).all()
    assert seen.segmentation is not None
    assert seen.segmentation[0, 0] == 0
    assert (seen.rgb[30, 40] > 0).all()


def test_exposure_is_in_stops():
    grey = [replace(f, rgb=np.full((*HW, 3), 150, np.uint8)) for f in frames(1)]
    for stops in (-1.5, 0.5):
        (seen,) = corrupt(grey, Corruption(exposure=stops), 0)
        assert np.log2((seen.rgb.mean() / 150) ** 2.2) == pytest.approx(stops, abs=0.03)


def test_contrast_spreads_codes_about_the_middle_and_keeps_their_order():
    ramp = np.repeat(np.arange(256, dtype=np.uint8)[None, :, None], 3, -1)
    frame = Rendered(0, ramp)
    (hard,) = corrupt([frame], Corruption(contrast=1.8), 0)
    (soft,) = corrupt([frame], Corruption(contrast=0.6), 0)
    codes = hard.rgb[0, :, 0].astype(int)
    assert (np.diff(codes) >= 0).all()
    assert (codes[0], codes[255]) == (0, 255)
    middle = round(255 * TONE_MIDDLE)
    assert abs(codes[middle] - middle) <= 1
    slope = (codes[middle + 20] - codes[middle - 20]) / 40
    assert slope == pytest.approx(1.8, rel=0.1)  # 20 codes from the middle it is a little less
    gentle = soft.rgb[0, :, 0].astype(int)
    assert (gentle[middle + 20] - gentle[middle - 20]) / 40 == pytest.approx(0.6, rel=0.1)


def test_pictures_become_a_clip():
    clip = encode(frames(4), Corruption(crf=10))
    shown = decode_window(clip, 0, 4)[2].astype(float)
    assert np.abs(shown - frames(1)[0].rgb).mean() < 8  # colours have half the resolution


def test_bad_settings_are_named():
    with pytest.raises(ValueError, match="shutter"):
        Corruption(shutter=1.5)
    with pytest.raises(ValueError, match="read_noise"):
        Corruption(read_noise=-0.1)
    with pytest.raises(ValueError, match=r"contrast: expected 0\.2 to 4, got 9"):
        Corruption(contrast=9)
    with pytest.raises(ValueError, match="exposure: expected -6 to 6, got 7"):
        Corruption(exposure=7)
    with pytest.raises(ValueError, match="flow"):
        next(corrupt([replace(frames(1)[0], flow=None)], Corruption(shutter=0.5), 0))
    with pytest.raises(ValueError, match="fov_vh_rad"):
        next(corrupt(frames(1), Corruption(), 0, pinhole()))
    wide = KannalaBrandtLens(HW, 20.0, 20.0, 39.5, 29.5, (0.0, 0.0, 0.0, 0.0))
    with pytest.raises(ValueError, match="170 degrees"):
        covering_fov(wide)
