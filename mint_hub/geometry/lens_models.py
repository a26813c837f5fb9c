"""Lens models: how a camera bends rays (x right, y down, z forward) into pixels (u right, v down).

Every lens has focal lengths, a principal point and distortion numbers, all in the pixels of
``image_size_hw``. Integer pixel coordinates are pixel centres, as in OpenCV's and Project Aria's
calibrations.

Law: ``lens.project(lens.unproject(uv)) == uv`` wherever ``unproject`` is not NaN. Both answer NaN
outside the region where the model is one-to-one: distortion polynomials fold back far from the
axis, and a folded model would show things behind the border inside the picture.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from math import isfinite, pi
from typing import Any, ClassVar

import numpy as np
from numpy.polynomial import Polynomial
from numpy.typing import NDArray

from mint_hub.geometry.arrays import (
    Array,
    ArrayT,
    as_dtype,
    components,
    namespace,
    norm,
    require_shape,
)
from mint_hub.geometry.camera import require_image_size
from mint_hub.geometry.lens_inversion import (
    evaluate,
    first_positive_root,
    invert_monotone,
    newton_2d,
    ratio,
)

TOLERANCE = 1e-9
"""Largest error, in focal lengths, of an unprojection that counts as solved."""


@dataclass(frozen=True)
class Lens(ABC):
    """What all lenses share.

    Attributes:
        image_size_hw: (height, width) of the calibrated image, pixels.
        fx: focal length along u, pixels, at the optical axis.
        fy: focal length along v.
        cx: principal point, u.
        cy: principal point, v.
        distortion: the model's own numbers, in its own order; missing ones at the end are zero.

    """

    image_size_hw: tuple[int, int]
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()

    model: ClassVar[str]
    distortion_names: ClassVar[tuple[str, ...]] = ()
    allowed_lengths: ClassVar[tuple[int, ...]] = ()

    def __post_init__(self) -> None:
        """Check and normalise the fields.

        Raises:
            ValueError: a malformed field, named.

        """
        object.__setattr__(self, "image_size_hw", require_image_size(self.image_size_hw))
        for name in ("fx", "fy", "cx", "cy"):
            object.__setattr__(
                self, name, _number(f"{self.model} lens, {name}", getattr(self, name))
            )
        if self.fx <= 0 or self.fy <= 0:
            raise ValueError(
                f"{self.model} lens: expected positive focal lengths, got fx {self.fx:g}, "
                f"fy {self.fy:g}"
            )
        numbers = _numbers(f"{self.model} lens, distortion", self.distortion)
        full = len(self.distortion_names)
        if len(numbers) not in {0, full, *self.allowed_lengths}:
            lengths = " or ".join(str(n) for n in sorted({*self.allowed_lengths, full}))
            raise ValueError(
                f"{self.model} lens, distortion: expected {lengths} numbers "
                f"({', '.join(self.distortion_names) or 'none'}), got {len(numbers)}"
            )
        object.__setattr__(self, "distortion", numbers + (0.0,) * (full - len(numbers)))

    @property
    def K(self) -> NDArray[np.float64]:  # noqa: N802
        """Intrinsics (3, 3) of the undistorted part."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1.0]])

    @property
    @abstractmethod
    def max_angle_rad(self) -> float:
        """Angle from the optical axis up to which the model is one-to-one."""

    @abstractmethod
    def _distort(self, points: Any) -> Any:
        """Map points (..., 3) to distorted coordinates (..., 2) in focal lengths, unchecked."""

    @abstractmethod
    def _undistort(self, target: Any) -> Any:
        """Solve for directions (..., 3), of any length, seen at coordinates (..., 2)."""

    def project(self, points_camera: ArrayT) -> ArrayT:
        """Pixels (..., 2) of points (..., 3), any unit; they may lie outside the image.

        NaN for points outside the valid region (``valid``).

        Raises:
            ValueError: wrong shape.

        """
        require_shape("points_camera", points_camera, (3,))
        xp = namespace(points_camera)
        points: Any = points_camera
        ok = self.valid(points)[..., None]
        forward = xp.concatenate(
            [xp.zeros_like(points[..., :2]), xp.ones_like(points[..., 2:])], axis=-1
        )
        x, y = components(self._distort(xp.where(ok, points, forward)))
        uv = xp.stack([self.fx * x + self.cx, self.fy * y + self.cy], axis=-1)
        return xp.where(ok, uv, float("nan"))

    def valid(self, points_camera: Array) -> Any:
        """Whether points (..., 3) lie within ``max_angle_rad`` of the axis (bool (...)).

        The camera centre itself, and anything not finite, does not.
        """
        xp = namespace(points_camera)
        points: Any = points_camera
        radius, z = norm(points[..., :2]), points[..., 2]
        inside = xp.arctan2(radius, z) < self.max_angle_rad
        return inside & ((radius > 0) | (z > 0)) & xp.isfinite(radius) & xp.isfinite(z)

    def unproject(self, uv: ArrayT) -> ArrayT:
        """Find unit rays (..., 3) of pixels (..., 2); NaN where no valid ray leads to the pixel.

        Newton's method in float64; a ray is given only when it projects back to within 1e-9 focal
        lengths.

        Raises:
            ValueError: wrong shape.

        """
        require_shape("uv", uv, (2,))
        xp = namespace(uv)
        u, v = components(as_dtype(uv, xp.float64))
        target = xp.stack([(u - self.cx) / self.fx, (v - self.cy) / self.fy], axis=-1)
        with np.errstate(all="ignore"):
            rays = self._undistort(target)
            rays = rays / norm(rays, keepdims=True)
            error = norm(self._distort(rays) - target)
            solved = self.valid(rays) & (error <= TOLERANCE * (1 + norm(target)))
        return as_dtype(xp.where(solved[..., None], rays, float("nan")), uv.dtype)

    def resized(self, image_size_hw: tuple[int, int]) -> Lens:
        """Describe the same camera when its images are resized to ``image_size_hw``."""
        height, width = require_image_size(image_size_hw)
        sy, sx = height / self.image_size_hw[0], width / self.image_size_hw[1]
        size = (height, width)
        return replace(
            self,
            image_size_hw=size,
            fx=self.fx * sx,
            fy=self.fy * sy,
            cx=(self.cx + 0.5) * sx - 0.5,  # integers are pixel centres
            cy=(self.cy + 0.5) * sy - 0.5,
        )

    def to_dict(self) -> dict[str, Any]:
        """Return the lens as JSON-able data; ``Lens.from_dict`` reads it back."""
        return {
            "model": self.model,
            "image_size_hw": list(self.image_size_hw),
            **{name: getattr(self, name) for name in ("fx", "fy", "cx", "cy")},
            "distortion": list(self.distortion),
        }

    @staticmethod
    def from_dict(data: Mapping[str, Any]) -> Lens:
        """Read ``to_dict``'s data; ``distortion`` may be missing.

        Raises:
            ValueError: an unknown model, a missing or unknown key, a malformed field.

        """
        model = data.get("model")
        found = [kind for kind in LENS_KINDS if kind.model == model]
        if not found:
            names = ", ".join(kind.model for kind in LENS_KINDS)
            raise ValueError(f"lens, model: expected one of {names}, got {model!r}")
        required = ("image_size_hw", "fx", "fy", "cx", "cy")
        missing = [key for key in required if key not in data]
        unknown = sorted(set(data) - {*required, "model", "distortion"})
        if missing or unknown:
            raise ValueError(
                f"{model} lens: expected the keys {', '.join(required)} and maybe distortion; "
                f"missing {missing or 'none'}, unknown {unknown or 'none'}"
            )
        arguments = {key: data[key] for key in required}
        return found[0](**arguments, distortion=data.get("distortion", ()))


@dataclass(frozen=True)
class PinholeLens(Lens):
    """No distortion; valid in front of the camera."""

    model: ClassVar[str] = "pinhole"

    @property
    def max_angle_rad(self) -> float:
        """A right angle."""
        return pi / 2

    def _distort(self, points: Any) -> Any:
        return points[..., :2] / points[..., 2:]

    def _undistort(self, target: Any) -> Any:
        return _on_plane(target)


@dataclass(frozen=True)
class OpenCVLens(Lens):
    """OpenCV's pinhole with distortion: rational radial and tangential, as ``cv2.projectPoints``.

    ``distortion`` is k1 k2 p1 p2 [k3 [k4 k5 k6]], OpenCV's order. With s = x^2 + y^2 on the plane
    z = 1: factor (1 + k1 s + k2 s^2 + k3 s^3) / (1 + k4 s + k5 s^2 + k6 s^3), then
    x += 2 p1 x y + p2 (s + 2 x^2), y += p1 (s + 2 y^2) + 2 p2 x y. Valid in front of the camera up
    to the radius at which the radial part turns back.
    """

    model: ClassVar[str] = "opencv"
    distortion_names: ClassVar[tuple[str, ...]] = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
    allowed_lengths: ClassVar[tuple[int, ...]] = (4, 5)

    @cached_property
    def _radial(self) -> tuple[Polynomial, Polynomial]:
        k1, k2, _, _, k3, k4, k5, k6 = self.distortion
        return Polynomial([1, k1, k2, k3]), Polynomial([1, k4, k5, k6])

    @cached_property
    def max_angle_rad(self) -> float:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Angle at which d(r factor)/dr, or the denominator, first vanishes; at most pi / 2."""
        N, D = self._radial
        s = Polynomial([0, 1])
        slope = (N + 2 * s * N.deriv()) * D - 2 * s * N * D.deriv()
        return float(np.arctan(np.sqrt(min(first_positive_root(slope), first_positive_root(D)))))

    def _distort(self, points: Any) -> Any:
        return self._with_jacobian(points[..., :2] / points[..., 2:])[0]

    def _undistort(self, target: Any) -> Any:
        limit = min(np.tan(self.max_angle_rad), 1e6)
        N, D = self._radial
        r = invert_monotone(
            lambda r: r * evaluate(N, r * r) / evaluate(D, r * r),
            lambda r: self._slope(r * r),
            norm(target),
            limit,
        )
        start = target * ratio(r, norm(target))[..., None]
        return _on_plane(newton_2d(self._with_jacobian, target, start))

    def _slope(self, s: Any) -> Any:
        """d(r factor)/dr at r^2 = s."""
        N, D = self._radial
        n, d = evaluate(N, s), evaluate(D, s)
        return (n + 2 * s * (evaluate(N.deriv(), s) - n * evaluate(D.deriv(), s) / d)) / d

    def _with_jacobian(self, xy: Any) -> tuple[Any, tuple[Any, Any, Any, Any]]:
        """Distorted coordinates (..., 2) and the entries of their Jacobian, row by row."""
        N, D = self._radial
        _, _, p1, p2, *_ = self.distortion
        x, y = components(xy)
        s = x * x + y * y
        n, d = evaluate(N, s), evaluate(D, s)
        factor = n / d
        slope = (evaluate(N.deriv(), s) - factor * evaluate(D.deriv(), s)) / d
        xd = x * factor + 2 * p1 * x * y + p2 * (s + 2 * x * x)
        yd = y * factor + p1 * (s + 2 * y * y) + 2 * p2 * x * y
        cross = 2 * x * y * slope + 2 * p1 * x + 2 * p2 * y
        xx = factor + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x
        yy = factor + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x
        return namespace(xy).stack([xd, yd], axis=-1), (xx, cross, cross, yy)


@dataclass(frozen=True)
class KannalaBrandtLens(Lens):
    """The equidistant fisheye of ``cv2.fisheye`` (Kannala and Brandt 2006).

    ``distortion`` is k1 k2 k3 k4: a ray at angle t from the axis lands at
    t (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8) focal lengths from the principal point. Rays beyond a
    right angle are valid as long as that grows with t.
    """

    model: ClassVar[str] = "kannala_brandt"
    distortion_names: ClassVar[tuple[str, ...]] = ("k1", "k2", "k3", "k4")

    @cached_property
    def _radial(self) -> Polynomial:
        """The factor as a polynomial of t^2."""
        return Polynomial([1.0, *self.distortion[: 6 if self.model == "fisheye624" else 4]])

    @cached_property
    def max_angle_rad(self) -> float:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Angle at which the landing radius stops growing; at most pi."""
        slope = self._radial + 2 * Polynomial([0, 1]) * self._radial.deriv()
        return float(min(np.sqrt(first_positive_root(slope)), pi))

    def _distort(self, points: Any) -> Any:
        radius = norm(points[..., :2])
        angle = namespace(points).arctan2(radius, points[..., 2])
        factor = evaluate(self._radial, angle * angle) * ratio(angle, radius, 1 / points[..., 2])
        return points[..., :2] * factor[..., None]

    def _undistort(self, target: Any) -> Any:
        xp = namespace(target)
        radial, slope = self._radial, self._radial + 2 * Polynomial([0, 1]) * self._radial.deriv()
        radius = norm(target)
        angle = invert_monotone(
            lambda t: t * evaluate(radial, t * t),
            lambda t: evaluate(slope, t * t),
            radius,
            self.max_angle_rad,
        )
        across = target * ratio(xp.sin(angle), radius)[..., None]
        return xp.concatenate([across, xp.cos(angle)[..., None]], axis=-1)


@dataclass(frozen=True)
class Fisheye624Lens(KannalaBrandtLens):
    """FISHEYE624 of Project Aria and HOT3D: six radial, two tangential, four thin-prism numbers.

    ``distortion`` is k0..k5 p0 p1 s0..s3. The published list of 15 numbers is f cx cy followed by
    these (one focal length; 16 numbers have fx fy): ``from_params`` reads it. A ray at angle t from
    the axis goes to radius t (1 + k0 t^2 + ... + k5 t^12) in its own direction; from there, with
    q = x^2 + y^2, x += p0 (q + 2 x^2) + 2 p1 x y + s0 q + s1 q^2 and
    y += p1 (q + 2 y^2) + 2 p0 x y + s2 q + s3 q^2.
    """

    model: ClassVar[str] = "fisheye624"
    distortion_names: ClassVar[tuple[str, ...]] = (
        *("k0", "k1", "k2", "k3", "k4", "k5"),
        *("p0", "p1", "s0", "s1", "s2", "s3"),
    )

    @classmethod
    def from_params(cls, params: Any, image_size_hw: tuple[int, int]) -> Fisheye624Lens:
        """Read 15 numbers [f cx cy k0..k5 p0 p1 s0..s3], or 16 with fx fy for f.

        Raises:
            ValueError: another count, or not numbers.

        """
        numbers = _numbers("fisheye624 lens, params", params)
        if len(numbers) not in (15, 16):
            raise ValueError(
                "fisheye624 lens, params: expected 15 numbers (f, cx, cy, k0..k5, p0, p1, s0..s3) "
                f"or 16 (fx, fy, ...), got {len(numbers)}"
            )
        fx, fy, cx, cy = (numbers[0], *numbers[:3]) if len(numbers) == 15 else numbers[:4]
        return cls(image_size_hw, fx, fy, cx, cy, numbers[-12:])

    def _distort(self, points: Any) -> Any:
        return self._with_jacobian(super()._distort(points))[0]

    def _undistort(self, target: Any) -> Any:
        return super()._undistort(newton_2d(self._with_jacobian, target, target))

    def _with_jacobian(self, xy: Any) -> tuple[Any, tuple[Any, Any, Any, Any]]:
        """Tangential and thin-prism part (..., 2) and the entries of its Jacobian, row by row."""
        p0, p1, s0, s1, s2, s3 = self.distortion[6:]
        x, y = components(xy)
        q = x * x + y * y
        xd = x + p0 * (q + 2 * x * x) + 2 * p1 * x * y + s0 * q + s1 * q * q
        yd = y + p1 * (q + 2 * y * y) + 2 * p0 * x * y + s2 * q + s3 * q * q
        prism_x, prism_y = 2 * (s0 + 2 * s1 * q), 2 * (s2 + 2 * s3 * q)
        xx = 1 + 6 * p0 * x + 2 * p1 * y + prism_x * x
        xy_ = 2 * p0 * y + 2 * p1 * x + prism_x * y
        yx = 2 * p1 * x + 2 * p0 * y + prism_y * x
        yy = 1 + 6 * p1 * y + 2 * p0 * x + prism_y * y
        return namespace(xy).stack([xd, yd], axis=-1), (xx, xy_, yx, yy)


LENS_KINDS: tuple[type[Lens], ...] = (PinholeLens, OpenCVLens, KannalaBrandtLens, Fisheye624Lens)
"""Every lens model, as ``Lens.from_dict`` knows them by their ``model``."""


def _number(name: str, value: Any) -> float:
    """``value`` as a finite float."""
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = float("nan")
    if not isfinite(number):
        raise ValueError(f"{name}: expected a finite number, got {value!r}")
    return number


def _numbers(name: str, values: Any) -> tuple[float, ...]:
    """``values`` as finite floats."""
    try:
        flat = list(np.ravel(np.asarray(values)))
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name}: expected a list of numbers, got {values!r}") from error
    return tuple(_number(f"{name}[{i}]", value) for i, value in enumerate(flat))


def _on_plane(xy: Any) -> Any:
    """Directions (..., 3) through (..., 2) on the plane z = 1."""
    return namespace(xy).concatenate([xy, 0 * xy[..., :1] + 1], axis=-1)
