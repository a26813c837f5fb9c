"""The pinhole camera: intrinsics, fields of view, projection.

K (..., 3, 3) is [[fx, s, cx], [0, fy, cy], [0, 0, 1]] in pixels, u right, v down. A field of view
belongs to a pinhole without skew whose principal point is the image centre (W / 2, H / 2).
Functions take numpy or torch and keep kind and dtype.

Laws: ``K_to_fov_vh(fov_vh_to_K(fov, size), size) == fov``; ``project(unproject(uv, z, K), K)``
gives back ``(uv, z)``.
"""

from typing import Any

from mint_hub.geometry.arrays import (
    Array,
    ArrayT,
    components,
    namespace,
    over_points,
    require_finite,
    require_shape,
)

MIN_DEPTH_M = 0.01
"""A point no further than this along z is not on screen; metrics floor predicted depths at it."""


def fov_vh_to_K(  # noqa: N802
    fov_vh_rad: ArrayT, image_size_hw: tuple[int, int], check: bool = True
) -> ArrayT:
    """Intrinsics (..., 3, 3), pixels, of fields of view (..., 2), radians, (vertical, horizontal).

    fx = W / (2 tan(horizontal / 2)), fy = H / (2 tan(vertical / 2)), principal point (W/2, H/2).

    Raises:
        ValueError: wrong shape or size; with ``check``, an angle outside (0, pi) or non-finite.

    """
    require_shape("fov_vh_rad", fov_vh_rad, (2,))
    height, width = require_image_size(image_size_hw)
    xp = namespace(fov_vh_rad)
    if check:
        require_finite("fov_vh_rad", fov_vh_rad)
        if bool(((fov_vh_rad <= 0) | (fov_vh_rad >= 3.14159265)).any()):
            raise ValueError(
                f"fov_vh_rad: expected radians between 0 and pi, got {float(fov_vh_rad.min()):g} "
                f"to {float(fov_vh_rad.max()):g}"
            )
    vertical, horizontal = components(fov_vh_rad)
    fx, fy = width / (2 * xp.tan(horizontal / 2)), height / (2 * xp.tan(vertical / 2))
    zero = xp.zeros_like(fx)
    cx, cy, one = zero + width / 2, zero + height / 2, zero + 1
    entries = [fx, zero, cx, zero, fy, cy, zero, zero, one]
    return xp.stack(entries, axis=-1).reshape((*fov_vh_rad.shape[:-1], 3, 3))


def K_to_fov_vh(K: ArrayT, image_size_hw: tuple[int, int]) -> ArrayT:  # noqa: N802
    """Fields of view (..., 2), radians, (vertical, horizontal), of intrinsics (..., 3, 3).

    Only the focal lengths count: the principal point is taken to be the image centre.

    Raises:
        ValueError: wrong shape or size.

    """
    require_shape("K", K, (3, 3))
    height, width = require_image_size(image_size_hw)
    xp = namespace(K)
    vertical = 2 * xp.arctan(height / (2 * K[..., 1, 1]))
    horizontal = 2 * xp.arctan(width / (2 * K[..., 0, 0]))
    return xp.stack([vertical, horizontal], axis=-1)


def project(points_camera: ArrayT, K: ArrayT) -> tuple[ArrayT, ArrayT]:
    """Pixels (..., 2) and depth (...) of points (..., 3), metres, OpenCV camera axes.

    K's leading axes are matched with the first leading axes of the points, whose further axes
    share a K: K (T, 3, 3) serves points (T, 2, 21, 3). Points with depth <= 0 are not in front of
    the camera: their pixels are NaN (their gradient is zero, not NaN), their depth is as it is.

    Raises:
        ValueError: wrong shapes.

    """
    require_shape("points_camera", points_camera, (3,))
    require_shape("K", K, (3, 3))
    xp = namespace(points_camera, K)
    x, y, z = components(points_camera)
    fx, skew, cx, fy, cy = _entries(K, points_camera)
    front = z > 0
    safe = xp.where(front, z, 1.0)
    u = (fx * x + skew * y) / safe + cx
    v = fy * y / safe + cy
    nan = float("nan")
    return xp.stack([xp.where(front, u, nan), xp.where(front, v, nan)], axis=-1), z


def on_screen(uv: Array, depth: Array, image_size_hw: tuple[int, int]) -> Any:
    """Whether points, pixels (..., 2) and depths (...), are seen: (...) bool.

    More than `MIN_DEPTH_M` before the camera, and inside the image: 0 <= u < W, 0 <= v < H. NaN is
    not seen.
    """
    height, width = image_size_hw
    u, v = uv[..., 0], uv[..., 1]
    return (depth > MIN_DEPTH_M) & (u >= 0) & (u < width) & (v >= 0) & (v < height)


def unproject(uv: ArrayT, depth: ArrayT, K: ArrayT) -> ArrayT:
    """Points (..., 3), metres, OpenCV camera axes, of pixels (..., 2) at depth (...) along z.

    K is matched with the pixels as in ``project``.

    Raises:
        ValueError: wrong shapes.

    """
    require_shape("uv", uv, (2,))
    require_shape("K", K, (3, 3))
    xp = namespace(uv, depth, K)
    u, v = components(uv)
    fx, skew, cx, fy, cy = _entries(K, uv)
    y = (v - cy) / fy
    x = (u - cx - skew * y) / fx
    one = 0 * x + 1
    return xp.stack([x * depth, y * depth, one * depth], axis=-1)


def require_image_size(image_size_hw: Any) -> tuple[int, int]:
    """``image_size_hw`` as two positive ints, (height, width).

    Raises:
        ValueError: anything else.

    """
    try:
        height, width = (int(n) for n in image_size_hw)
        exact = all(int(n) == n for n in image_size_hw)
    except (TypeError, ValueError):
        height = width = 0
        exact = False
    if not exact or height < 1 or width < 1:
        raise ValueError(
            f"image_size_hw: expected two positive integers (height, width), got {image_size_hw!r}"
        )
    return height, width


def _entries(K: Array, points: Array) -> tuple[Any, Any, Any, Any, Any]:
    """fx, skew, cx, fy, cy of K, shaped to broadcast against ``points[..., 0]``."""
    k: Any = over_points(K, points)
    return k[..., 0, 0], k[..., 0, 1], k[..., 0, 2], k[..., 1, 1], k[..., 1, 2]
