"""From a lens to a pinhole: the maps that resample a distorted image into a rectified one.

Integer pixel coordinates are pixel centres here, as in OpenCV's calibration and ``cv2.remap``: the
rectified pixel in column j and row i looks along the ray of K at (u, v) = (j, i).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mint_hub.geometry.camera import require_image_size, unproject

if TYPE_CHECKING:
    from mint_hub.geometry.lenses import Lens

OUTSIDE = -2.0
"""Map value of pixels without a source: beyond the border for every interpolation."""


@dataclass(frozen=True, eq=False)
class Rectification:
    """How to resample images of one lens to a pinhole.

    Attributes:
        K: (3, 3) float64 intrinsics of the rectified image, pixels.
        image_size_hw: its size.
        source_size_hw: the size of the images it takes.
        map_x: (H, W) float32, the source column of every rectified pixel, -2 where there is none.
        map_y: (H, W) float32, the source row.
        valid: (H, W) bool, true where the source image has all of the pixel's neighbours.

    """

    K: NDArray[np.float64]
    image_size_hw: tuple[int, int]
    source_size_hw: tuple[int, int]
    map_x: NDArray[np.float32]
    map_y: NDArray[np.float32]
    valid: NDArray[np.bool_]

    def apply(self, image: NDArray[Any]) -> NDArray[Any]:
        """Resample an image (h, w) or (h, w, C <= 4), bilinearly; black where nothing was seen.

        Raises:
            ValueError: the image is not of ``source_size_hw``.

        """
        if image.ndim not in (2, 3) or tuple(image.shape[:2]) != self.source_size_hw:
            raise ValueError(
                f"image: expected (height, width) {self.source_size_hw} of the lens, got shape "
                f"{tuple(image.shape)}"
            )
        import cv2  # a heavy import that only resampling needs

        return cv2.remap(image, self.map_x, self.map_y, cv2.INTER_LINEAR)


def rectification(
    lens: Lens, image_size_hw: tuple[int, int] | None = None, K: Any = None
) -> Rectification:
    """Build the resampling from ``lens`` to a pinhole.

    Args:
        lens: the camera that took the images.
        image_size_hw: size of the rectified image; the lens's own when None. It changes how much
            is seen, not the focal length.
        K: (3, 3) intrinsics of the rectified image, used exactly as given. When None, the principal
            point is the middle of the picture and the focal lengths are the lens's own, which are
            those at its optical axis: the middle of the picture keeps its scale.

    Raises:
        ValueError: malformed size or K.

    """
    height, width = require_image_size(
        lens.image_size_hw if image_size_hw is None else image_size_hw
    )
    if K is None:
        cx, cy = (width - 1) / 2, (height - 1) / 2  # the (W / 2, H / 2) of pixel edges
        pinhole = np.array([[lens.fx, 0, cx], [0, lens.fy, cy], [0, 0, 1.0]])
    else:
        pinhole = require_intrinsics("K", K)
    uv = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).astype(np.float64)
    source = lens.project(unproject(uv, np.ones((height, width)), pinhole))
    rows, columns = lens.image_size_hw
    x, y = source[..., 0], source[..., 1]
    with np.errstate(invalid="ignore"):
        valid = (x >= 0) & (x <= columns - 1) & (y >= 0) & (y <= rows - 1)
        near = (x > -1) & (x < columns) & (y > -1) & (y < rows)
    return Rectification(
        K=pinhole,
        image_size_hw=(height, width),
        source_size_hw=lens.image_size_hw,
        map_x=np.where(near, x, OUTSIDE).astype(np.float32),
        map_y=np.where(near, y, OUTSIDE).astype(np.float32),
        valid=valid,
    )


def require_intrinsics(name: str, K: Any) -> NDArray[np.float64]:
    """``K`` as a float64 (3, 3) array without skew and with positive focal lengths.

    Raises:
        ValueError: anything else.

    """
    try:
        matrix = np.array(np.asarray(K), dtype=np.float64)
    except (TypeError, ValueError, RuntimeError) as error:
        raise ValueError(f"{name}: expected a (3, 3) matrix of numbers, got {K!r}") from error
    if matrix.shape != (3, 3):
        raise ValueError(f"{name}: expected shape (3, 3), got {matrix.shape}")
    if not np.isfinite(matrix).all():
        raise ValueError(f"{name}: expected finite numbers, got {matrix.tolist()}")
    if not (matrix[0, 0] > 0 and matrix[1, 1] > 0):
        raise ValueError(
            f"{name}: expected positive focal lengths, got fx {matrix[0, 0]:g}, fy {matrix[1, 1]:g}"
        )
    rest = matrix[[0, 1, 2, 2, 2], [1, 0, 0, 1, 2]] - [0, 0, 0, 0, 1]
    if np.abs(rest).max() > 1e-6 * matrix[0, 0]:
        raise ValueError(
            f"{name}: expected [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], got {matrix.tolist()}"
        )
    matrix[[0, 1, 2, 2, 2], [1, 0, 0, 1, 2]] = [0, 0, 0, 0, 1]
    return matrix
