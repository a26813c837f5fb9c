"""Textures are what their numbers say, and tile."""

from dataclasses import replace

import numpy as np
import pytest

from mint_hub.synth.textures import PAPER, encoded, skin_image, texture_image
from mint_hub.synth.world import TEXTURE_KINDS, Texture

A, B = (0.6, 0.4, 0.2), (0.1, 0.1, 0.3)
TILING = [kind for kind in TEXTURE_KINDS if kind != "label"]


@pytest.mark.parametrize("kind", TEXTURE_KINDS)
def test_the_same_numbers_give_the_same_picture(kind):
    texture = Texture(kind, A, B, 5, 3)
    image = texture_image(texture)
    assert image.shape == (512, 512, 3)
    assert image.dtype == np.uint8
    texture_image.cache_clear()
    np.testing.assert_array_equal(texture_image(texture), image)
    assert (texture_image(replace(texture, seed=4)) != image).any()
    assert (texture_image(replace(texture, colour_a=B)) != image).any()


@pytest.mark.parametrize("kind", TEXTURE_KINDS)
def test_colours_lie_around_the_two(kind):
    linear = (texture_image(Texture(kind, A, B, 5, 3)) / 255.0) ** 2
    part = linear[:, : 512 * 15 // 16] if kind == "label" else linear
    low, high = np.minimum(A, B), np.maximum(A, B)
    mean = part.mean((0, 1))
    assert (mean > 0.7 * low).all()
    assert (mean < 1.2 * high).all()
    assert part.std((0, 1)).max() > 0.01


@pytest.mark.parametrize("kind", TILING)
def test_repeats_join(kind):
    """Across the border neighbours differ no more than they do somewhere inside."""
    image = texture_image(Texture(kind, A, B, 6, 1)).astype(float)
    for axis in (0, 1):
        inside = np.abs(np.diff(image, axis=axis)).mean((1 - axis, 2))
        first, last = image.take(0, axis), image.take(-1, axis)
        assert np.abs(first - last).mean() <= 1.05 * inside.max()


def test_a_label_ends_in_paper():
    image = texture_image(Texture("label", A, B, 4, 2))
    np.testing.assert_allclose(
        (image[:, -10:] / 255.0) ** 2, np.tile(PAPER, (512, 10, 1)), atol=0.2
    )


def test_codes_are_roots():
    np.testing.assert_array_equal(
        encoded(np.array([0.0, 0.25, 1.0, 7.0, -1.0])), [0, 128, 255, 255, 0]
    )


def test_skin_varies_around_nothing():
    mean = skin_image().astype(float).mean((0, 1))
    np.testing.assert_allclose(mean, 128, atol=1.0)


def test_an_unknown_kind_is_named():
    with pytest.raises(ValueError, match=r"kind.*marble"):
        texture_image(Texture("marble", A, B))  # type: ignore[arg-type]
