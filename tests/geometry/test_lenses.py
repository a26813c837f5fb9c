import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from mint_hub.geometry.lenses import (
    Fisheye624Lens,
    KannalaBrandtLens,
    Lens,
    OpenCVLens,
    PinholeLens,
    lens_from,
    rectification,
)

SIZE = (480, 640)
CENTRAL = (500.0, 510.0, 322.0, 236.0)
OPENCV = [
    (0.1, -0.05, 0.001, -0.002),
    (-0.28, 0.07, 0.001, -0.0005, 0.01),
    (0.1, 0.02, 0.001, 0.001, 0.003, 0.2, 0.03, 0.001),
]
ARIA_LIKE = [
    *(609.0, 706.0, 704.0, 0.38, -0.38, -0.12, 1.55, -1.99, 0.725),
    *(-0.001, 0.0002, 0.0022, -0.0004, -0.0015, 0.00025),
]
SLAM_LIKE = [
    *(241.5, 318.4, 237.4, -0.028, 0.105, -0.076, 0.016, -0.0003),
    *(-0.00014, 0.0003, -0.0018, 0.0014, -0.00016, 0.0018, -0.00006),
]
LENSES: list[Lens] = [
    PinholeLens(SIZE, *CENTRAL),
    *(OpenCVLens(SIZE, *CENTRAL, numbers) for numbers in OPENCV),
    KannalaBrandtLens(SIZE, 300, 310, 320, 250, (0.05, -0.01, 0.003, -0.0005)),
    Fisheye624Lens.from_params(ARIA_LIKE, (1408, 1408)),
    Fisheye624Lens.from_params(SLAM_LIKE, SIZE),
]
each = pytest.mark.parametrize("lens", LENSES, ids=lambda x: f"{x.model}{len(x.distortion)}")
each_opencv = pytest.mark.parametrize("numbers", OPENCV, ids=len)


def grid(lens: Lens, step: int = 16) -> NDArray[np.float64]:
    height, width = lens.image_size_hw
    uv = np.meshgrid(np.arange(0, width, step), np.arange(0, height, step))
    return np.stack(uv, axis=-1).astype(np.float64)


def rays_within(angle: float, count: int = 2000) -> NDArray[np.float64]:
    rng = np.random.default_rng(0)
    t, a = rng.uniform(0, angle, count), rng.uniform(0, 2 * np.pi, count)
    return np.stack([np.sin(t) * np.cos(a), np.sin(t) * np.sin(a), np.cos(t)], axis=-1)


@each
def test_project_undoes_unproject_over_the_image(lens: Lens) -> None:
    uv = grid(lens)
    rays = lens.unproject(uv)
    np.testing.assert_allclose(np.linalg.norm(rays, axis=-1), 1, rtol=1e-14)
    np.testing.assert_allclose(lens.project(rays), uv, atol=1e-9)
    np.testing.assert_allclose(lens.project(0.37 * rays), uv, atol=1e-9)
    assert lens.valid(rays).all()


@each
def test_unproject_undoes_project_in_the_valid_region(lens: Lens) -> None:
    rays = rays_within(min(0.98 * lens.max_angle_rad, 1.2))
    np.testing.assert_allclose(lens.unproject(lens.project(rays)), rays, atol=1e-9)


@each
def test_torch_and_float32_agree(lens: Lens) -> None:
    uv = grid(lens, 64)
    rays = lens.unproject(uv)
    np.testing.assert_allclose(lens.unproject(torch.as_tensor(uv)).numpy(), rays, atol=1e-13)
    np.testing.assert_allclose(lens.project(torch.as_tensor(rays)).numpy(), uv, atol=1e-9)
    single = lens.unproject(uv.astype(np.float32))
    assert single.dtype == lens.project(single).dtype == np.float32
    np.testing.assert_allclose(single, rays, atol=1e-6)
    np.testing.assert_allclose(lens.project(single), uv, atol=5e-3)


@each
def test_projection_has_gradients_even_on_the_axis(lens: Lens) -> None:
    points = torch.tensor([[0.0, 0, 2], [0.3, -0.2, 1]], dtype=torch.float64, requires_grad=True)
    lens.project(points).sum().backward()
    assert torch.isfinite(points.grad).all()
    np.testing.assert_allclose(points.grad[0], [lens.fx / 2, lens.fy / 2, 0], atol=1e-9)
    assert torch.autograd.gradcheck(lens.project, (points[1:].detach().requires_grad_(),))


@each
def test_outside_the_valid_region_both_ways_are_nan(lens: Lens) -> None:
    behind = np.array([[0.0, 0, 0], [0.1, 0, -1e9], [np.nan, 0, 1], [np.inf, 0, np.inf]])
    if lens.max_angle_rad == np.pi:
        behind = np.delete(behind, 1, axis=0)
    assert np.isnan(lens.project(behind)).all()
    assert not lens.valid(behind).any()
    assert np.isnan(lens.unproject(np.array([[np.nan, 0.0], [np.inf, 1.0]]))).all()


def test_folded_polynomials_are_cut_where_they_turn_back() -> None:
    lens = OpenCVLens(SIZE, *CENTRAL, (-0.3, 0.0, 0.0, 0.0))
    turn = 1 / np.sqrt(0.9)  # d/dr (r - 0.3 r^3) = 0
    assert np.tan(lens.max_angle_rad) == pytest.approx(turn, rel=1e-12)
    x = np.array([0.999 * turn, 1.001 * turn])
    uv = lens.project(np.stack([x, 0 * x, 0 * x + 1], axis=-1))
    np.testing.assert_array_equal(np.isnan(uv[:, 0]), [False, True])
    reach = lens.cx + lens.fx * turn * (1 - 0.3 * turn**2)
    rays = lens.unproject(np.array([[reach - 0.1, lens.cy], [reach + 0.1, lens.cy]]))
    np.testing.assert_array_equal(np.isnan(rays[:, 0]), [False, True])

    fish = KannalaBrandtLens(SIZE, *CENTRAL, (-0.1, 0.0, 0.0, 0.0))
    assert fish.max_angle_rad == pytest.approx(np.sqrt(1 / 0.3), rel=1e-12)
    beyond_right_angle = np.array([1.0, 0, -0.1])
    assert np.isfinite(fish.project(beyond_right_angle)).all()
    np.testing.assert_allclose(
        fish.unproject(fish.project(beyond_right_angle)),
        beyond_right_angle / np.linalg.norm(beyond_right_angle),
        atol=1e-12,
    )


# ---------------------------------------------------------------- against OpenCV


@each_opencv
def test_opencv_lens_is_opencvs(numbers: tuple[float, ...]) -> None:
    lens, zero = OpenCVLens(SIZE, *CENTRAL, numbers), np.zeros(3)
    points = rays_within(0.55) * np.linspace(0.1, 3, 2000)[:, None]
    expected = cv2.projectPoints(points, zero, zero, lens.K, np.array(numbers))[0][:, 0]
    np.testing.assert_allclose(lens.project(points), expected, atol=1e-9)
    uv = grid(lens).reshape(-1, 1, 2)
    stop = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 500, 1e-14)
    plane = _undistort(uv, lens.K, np.array(numbers), stop)[:, 0]
    rays = lens.unproject(uv[:, 0])
    np.testing.assert_allclose(rays[:, :2] / rays[:, 2:], plane, atol=1e-11)


def _undistort(uv: Any, K: Any, numbers: Any, stop: Any) -> Any:
    """OpenCV 4 has a function of its own for the variant with a stopping rule."""
    if hasattr(cv2, "undistortPointsIter"):
        return cv2.undistortPointsIter(uv, K, numbers, None, None, stop)
    return cv2.undistortPoints(uv, K, numbers, criteria=stop)


def test_kannala_brandt_lens_is_opencvs_fisheye() -> None:
    lens = LENSES[4]
    points, zero, k = rays_within(1.3), np.zeros(3), np.array(lens.distortion)
    expected = cv2.fisheye.projectPoints(points[:, None], zero, zero, lens.K, k)[0][:, 0]
    np.testing.assert_allclose(lens.project(points), expected, atol=1e-9)
    uv = grid(lens).reshape(-1, 1, 2)
    plane = cv2.fisheye.undistortPoints(uv, lens.K, k)[:, 0]
    rays = lens.unproject(uv[:, 0])
    np.testing.assert_allclose(rays[:, :2] / rays[:, 2:], plane, atol=1e-6)


def test_fisheye624_without_its_extras_is_kannala_brandt() -> None:
    k = (0.05, -0.01, 0.003, -0.0005)
    plain = KannalaBrandtLens(SIZE, *CENTRAL, k)
    lens = Fisheye624Lens(SIZE, *CENTRAL, (*k, *[0.0] * 8))
    points = rays_within(1.3)
    np.testing.assert_allclose(lens.project(points), plain.project(points), atol=1e-10)


def test_fisheye624_by_hand() -> None:
    """One point through the formula, each group of numbers with a place of its own."""
    params = [100.0, 50, 60, *[0.1, 0.01, 0, 0, 0, 0], 0.002, 0.003, 0.004, 0.005, 0.006, 0.007]
    lens = Fisheye624Lens.from_params(params, (120, 100))
    t = np.arctan(0.5)
    landing = t * (1 + 0.1 * t**2 + 0.01 * t**4)
    x, y, q = 0.6 * landing, 0.8 * landing, landing**2
    u = x + 0.002 * (q + 2 * x * x) + 2 * 0.003 * x * y + 0.004 * q + 0.005 * q * q
    v = y + 0.003 * (q + 2 * y * y) + 2 * 0.002 * x * y + 0.006 * q + 0.007 * q * q
    got = lens.project(np.array([0.3, 0.4, 1.0]))
    np.testing.assert_allclose(got, [50 + 100 * u, 60 + 100 * v], rtol=1e-14)


# ---------------------------------------------------------------- a real calibration


@pytest.mark.real
def test_real_aria_calibrations_invert_over_their_images(real_dir: Path) -> None:
    sizes = {"camera-slam-left": SIZE, "camera-slam-right": SIZE, "camera-rgb": (1408, 1408)}
    path = real_dir / "hot3d_gt" / "Aria_P0003_c701bd11" / "online_calibration.jsonl"
    with path.open() as file:
        cameras = json.loads(file.readline())["CameraCalibrations"]
    assert {camera["Label"] for camera in cameras} == set(sizes)
    for camera in cameras:
        assert camera["Projection"]["Name"] == "FisheyeRadTanThinPrism"
        lens = Fisheye624Lens.from_params(camera["Projection"]["Params"], sizes[camera["Label"]])
        uv = grid(lens, 8)
        again = lens.project(lens.unproject(uv))
        lost = np.isnan(again).any(axis=-1)
        np.testing.assert_allclose(again[~lost], uv[~lost], atol=1e-9)
        # corners of a 150 degree camera may lie beyond the calibrated image circle, nothing else
        assert lost.mean() < 0.01
        radius = np.linalg.norm(uv - [lens.cx, lens.cy], axis=-1)
        assert not lost.any() or radius[lost].min() > 1.5 * lens.image_size_hw[0] / 2


# ---------------------------------------------------------------- rectification


def test_rectifying_a_centred_pinhole_changes_nothing() -> None:
    image = np.random.default_rng(0).integers(0, 256, (40, 60, 3), np.uint8)
    made = rectification(PinholeLens((40, 60), 50, 55, 29.5, 19.5))
    np.testing.assert_array_equal(made.apply(image), image)
    np.testing.assert_array_equal(made.apply(image[..., 0]), image[..., 0])
    assert made.valid.all()
    assert made.image_size_hw == made.source_size_hw == (40, 60)


@each_opencv
def test_rectification_equals_opencvs_maps(numbers: tuple[float, ...]) -> None:
    lens = OpenCVLens(SIZE, *CENTRAL, numbers)
    made = rectification(lens)
    np.testing.assert_array_equal(made.K, [[500, 0, 319.5], [0, 510, 239.5], [0, 0, 1]])
    expected = cv2.initUndistortRectifyMap(
        lens.K, np.array(numbers), np.eye(3), made.K, SIZE[::-1], cv2.CV_32FC1
    )
    assert made.map_x.dtype == made.map_y.dtype == np.float32
    for got, want in zip((made.map_x, made.map_y), expected, strict=True):
        np.testing.assert_allclose(got[made.valid], want[made.valid], atol=1e-3)


@each
def test_rectified_pixels_show_what_their_ray_shows(lens: Lens) -> None:
    """Paint each source pixel with its ray: the rectified image must hold K's own rays."""
    size = (30, 40)
    small = lens.resized((120, 160) if lens.image_size_hw == SIZE else (120, 120))
    painted = small.unproject(grid(small, 1)).astype(np.float32)
    made = rectification(small, size)
    got = made.apply(np.nan_to_num(painted))[made.valid]
    u, v = np.meshgrid(np.arange(size[1]), np.arange(size[0]))
    rays = np.stack([u, v, np.ones(size)], axis=-1) @ np.linalg.inv(made.K).T
    rays = (rays / np.linalg.norm(rays, axis=-1, keepdims=True))[made.valid]
    assert made.valid.mean() > 0.5
    np.testing.assert_allclose(got, rays, atol=2e-3)


def test_rectification_marks_what_was_not_seen() -> None:
    lens = PinholeLens((40, 60), 50, 50, 29.5, 19.5)
    wide = rectification(lens, (80, 120))
    np.testing.assert_array_equal(wide.K, [[50, 0, 59.5], [0, 50, 39.5], [0, 0, 1]])
    white = wide.apply(np.full((40, 60), 255, np.uint8))
    assert wide.valid.sum() == 40 * 60
    assert (white[wide.valid] == 255).all()
    assert white[0, 0] == 0
    exact = np.array([[207.8, 0, 239.8], [0, 207.8, 239.8], [0, 0, 1]])
    given = rectification(Fisheye624Lens.from_params(ARIA_LIKE, (1408, 1408)), (480, 480), exact)
    np.testing.assert_array_equal(given.K, exact)
    assert given.valid.shape == (480, 480)
    with pytest.raises(ValueError, match="image: expected"):
        wide.apply(white)
    with pytest.raises(ValueError, match="K: expected"):
        rectification(lens, K=np.eye(4))


# ---------------------------------------------------------------- what users give


@each
def test_dictionaries_round_trip_through_json(lens: Lens) -> None:
    data = json.loads(json.dumps(lens.to_dict()))
    assert Lens.from_dict(data) == lens
    assert lens_from(data, lens.image_size_hw) == lens
    assert hash(Lens.from_dict(data)) == hash(lens)


def test_lens_from_accepts_the_usual_forms() -> None:
    pinhole = LENSES[0]
    K = pinhole.K
    for spec in (K, K.tolist(), torch.as_tensor(K), {"K": K}, pinhole):
        assert lens_from(spec, SIZE) == pinhole
    assert lens_from({"f": 400}, SIZE) == PinholeLens(SIZE, 400, 400, 319.5, 239.5)
    distorted = {"model": "opencv", "K": K, "distortion": np.array(OPENCV[0])}
    assert lens_from(distorted, SIZE) == LENSES[1]
    assert lens_from({"params": ARIA_LIKE}, (1408, 1408)) == LENSES[5]
    sixteen = [609.0, *ARIA_LIKE]
    assert lens_from({"model": "fisheye624", "params": sixteen}, (1408, 1408)) == LENSES[5]


def test_a_calibration_at_another_size_is_carried_over() -> None:
    half = lens_from(LENSES[0], (240, 320))
    assert half == PinholeLens((240, 320), 250, 255, 160.75, 117.75)
    points = rays_within(0.4)
    full, small = LENSES[3], LENSES[3].resized((240, 320))
    halved = (full.project(points) + 0.5) / 2 - 0.5  # integers are pixel centres
    np.testing.assert_allclose(small.project(points), halved, atol=1e-10)
    with pytest.raises(ValueError, match="aspect ratio"):
        lens_from({"f": 400, "image_size_hw": [1080, 1440]}, (368, 480))


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        (None, "expected a Lens"),
        ("camera.json", "expected a Lens"),
        (np.eye(4), r"K: expected shape \(3, 3\), got \(4, 4\)"),
        ([["a"]], "K: expected a"),
        (np.diag([500, -500, 1]), "positive focal lengths, got fx 500, fy -500"),
        (np.diag([500, np.nan, 1]), "finite"),
        ([[500, 3, 320], [0, 500, 240], [0, 0, 1]], r"\[\[fx, 0, cx\]"),
        ({"focal": 500}, "got focal"),
        ({"fx": 500}, "both fx and fy"),
        ({"f": 500, "fx": 500}, "both fx and fy"),
        ({"f": 500, "distortion": [0.1] * 4}, "lens, model: expected one of"),
        ({"f": 500, "model": "brown"}, "expected one of pinhole, opencv.*got 'brown'"),
        ({"f": 500, "model": "opencv", "distortion": [0.1] * 3}, "expected 4 or 5 or 8 numbers"),
        ({"f": 500, "model": "opencv", "distortion": [0, 0, 0, "x"]}, r"distortion\[3\]"),
        ({"f": "wide"}, "fx: expected a finite number, got 'wide'"),
        ({"f": 0}, "positive focal lengths"),
        ({"params": ARIA_LIKE[:-1]}, "expected 15 numbers .* got 14"),
        ({"params": ARIA_LIKE, "f": 3}, "params: expected only with"),
        ({"K": np.diag([5, 5, 1]), "cx": 3}, "either K or cx"),
        ({"f": 500, "image_size_hw": 480}, "image_size_hw: expected two positive"),
    ],
)
def test_malformed_input_is_explained(spec: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        lens_from(spec, SIZE)


def test_from_dict_names_missing_and_unknown_keys() -> None:
    data = {**LENSES[1].to_dict(), "k1": 0.1}
    del data["cx"]
    with pytest.raises(ValueError, match=r"missing \['cx'\], unknown \['k1'\]"):
        Lens.from_dict(data)
