import doctest

import cv2
import numpy as np
import pytest

from mint_hub.view import canvas, strips


def test_points_count_from_the_edge_of_the_first_pixel():
    image = canvas.blank(16, 16, (0, 0, 0))
    canvas.disc(image, (7.5, 6.25), 4, canvas.WHITE)
    weight = image[..., 0].astype(float)
    rows, columns = np.mgrid[:16, :16] + 0.5
    np.testing.assert_allclose((weight * columns).sum() / weight.sum(), 7.5, atol=0.1)
    np.testing.assert_allclose((weight * rows).sum() / weight.sum(), 6.25, atol=0.1)


def test_nan_breaks_a_line_and_far_points_are_left_out():
    points = np.array([[5.0, 5], [25, 5], [np.nan, 5], [65, 5], [85, 5], [1e9, 5]])
    image = canvas.blank(10, 100, (0, 0, 0))
    canvas.polyline(image, points, canvas.WHITE, 1)
    lit = image[..., 0].max(axis=0) > 100
    assert lit[6:24].all()
    assert not lit[27:63].any()
    assert lit[66:84].all()
    assert not lit[87:].any()
    for end in ((np.nan, 5.0), (1e9, 5.0)):
        untouched = canvas.blank(10, 100)
        canvas.line(untouched, (5.0, 5.0), end, canvas.INK, 2)
        canvas.disc(untouched, end, 3, canvas.INK)
        assert (untouched == 255).all()


@pytest.mark.parametrize("anchor", ["left", "center", "right"])
def test_a_chip_touches_only_the_pixels_it_names(anchor):
    image = canvas.blank(60, 300)
    rows, columns = canvas.chip(
        image, "left 0.97", (150, 12), 20, background=canvas.INK, opacity=0.7, anchor=anchor
    )
    touched = (image != 255).any(axis=-1)
    assert touched[rows, columns].any()
    touched[rows, columns] = False
    assert not touched.any()


@pytest.mark.parametrize("anchor", ["left", "center", "right"])
def test_text_stands_where_it_is_anchored(anchor):
    image = canvas.blank(60, 400)
    canvas.put_text(image, "HHHHHH", (200, 40), 24, anchor=anchor)
    dark = np.flatnonzero((image < 128).any(axis=(0, 2)))
    at = {"left": dark[0], "center": dark[[0, -1]].mean(), "right": dark[-1]}[anchor]
    assert abs(at - 200) < 5


def test_text_that_is_too_long_ends_in_an_ellipsis():
    assert canvas.fit_text("short", 20, 500) == "short"
    cut = canvas.fit_text("a rather long sentence", 20, 120)
    assert cut.endswith("…")
    assert canvas.text_width(cut, 20) <= 120
    assert canvas.fit_text("word", 20, 2) == ""


def test_the_stroke_font_of_older_opencv_will_do(monkeypatch):
    monkeypatch.delattr(cv2, "FontFace", raising=False)
    image = canvas.blank(60, 400)
    canvas.put_text(image, "left · 0.97…", (10, 40), 24)
    assert (image < 128).any()
    assert canvas.text_width("ll", 24) < canvas.text_width("llll", 24)


@pytest.mark.parametrize(("encode", "tolerance"), [(canvas.png_bytes, 0), (canvas.jpeg_bytes, 6)])
def test_files_hold_the_image_in_rgb(encode, tolerance):
    image = canvas.blank(16, 16, (200, 100, 30))
    decoded = cv2.imdecode(np.frombuffer(encode(image), np.uint8), cv2.IMREAD_COLOR)
    back = cv2.cvtColor(decoded, cv2.COLOR_BGR2RGB)
    assert np.abs(back.astype(int) - image).max() <= tolerance


@pytest.mark.parametrize("module", [canvas, strips], ids=["canvas", "strips"])
def test_the_examples_in_the_docs_hold(module):
    result = doctest.testmod(module)
    assert result.attempted > 0
    assert result.failed == 0
