"""Lenses as users give them: one door for matrices, dictionaries and lens objects.

The models are in ``lens_models``, the resampling to a pinhole in ``rectification``; this module
gathers their public names.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast

from mint_hub.geometry.camera import require_image_size
from mint_hub.geometry.lens_models import (
    LENS_KINDS,
    Fisheye624Lens,
    KannalaBrandtLens,
    Lens,
    OpenCVLens,
    PinholeLens,
)
from mint_hub.geometry.rectification import Rectification, rectification, require_intrinsics

__all__ = [
    "LENS_KINDS",
    "Fisheye624Lens",
    "KannalaBrandtLens",
    "Lens",
    "OpenCVLens",
    "PinholeLens",
    "Rectification",
    "lens_from",
    "rectification",
]

ASPECT_TOLERANCE = 0.01
"""Relative difference of aspect ratios up to which a calibration is carried over by resizing."""

KEYS = ["model", "image_size_hw", "K", "fx", "fy", "f", "cx", "cy", "distortion", "params"]
"""What a mapping may hold."""


def lens_from(spec: Any, image_size_hw: tuple[int, int]) -> Lens:
    """Make a lens from what a user knows about a camera whose images have ``image_size_hw``.

    ``spec`` is one of

    - a ``Lens``;
    - intrinsics K (3, 3), nested lists, numpy or torch: a pinhole;
    - a mapping. ``model`` is "pinhole" (default), "opencv", "kannala_brandt" or "fisheye624";
      intrinsics are ``K``, or ``fx fy cx cy`` (or ``f`` for both focal lengths; a missing principal
      point is the image centre); ``distortion`` lists the model's numbers in its order; for
      fisheye624 ``params`` may list the 15 or 16 published numbers instead of all that.
      ``image_size_hw`` is the size it was calibrated at, when not the size of the images.

    A lens calibrated at another size is resized when the aspect ratios agree within 1 percent; a
    crop cannot be guessed and raises.

    Raises:
        ValueError: malformed input; the message names the field, what was expected and what came.

    >>> lens_from({"f": 500, "distortion": [0.1, 0, 0, 0], "model": "opencv"}, (480, 640)).cx
    319.5

    """
    size = require_image_size(image_size_hw)
    if isinstance(spec, Lens):
        lens = spec
    elif isinstance(spec, Mapping):
        lens = _from_mapping(cast("Mapping[str, Any]", spec), size)
    elif spec is None or isinstance(spec, (str, bytes, int, float)):
        raise ValueError(f"lens: expected a Lens, a (3, 3) matrix K or a mapping, got {spec!r}")
    else:
        lens = _from_K("lens, K", "pinhole", spec, size, ())
    if lens.image_size_hw == size:
        return lens
    (h, w), (height, width) = lens.image_size_hw, size
    if abs(w * height / (h * width) - 1) > ASPECT_TOLERANCE:
        raise ValueError(
            f"lens, image_size_hw: expected the aspect ratio of the images {size}, got {(h, w)}; "
            "give the calibration of the images as they are, or use lens.resized() if they were "
            "stretched"
        )
    return lens.resized(size)


def _from_mapping(spec: Mapping[str, Any], images_hw: tuple[int, int]) -> Lens:
    """Read a mapping as ``lens_from`` describes."""
    unknown = sorted(str(key) for key in spec if key not in KEYS)
    if unknown:
        raise ValueError(f"lens: expected keys among {', '.join(KEYS)}, got {', '.join(unknown)}")
    size = require_image_size(spec.get("image_size_hw", images_hw))
    distortion = spec.get("distortion", ())
    if "params" in spec:
        extra = sorted(set(spec) - {"model", "image_size_hw", "params"})
        if extra or spec.get("model", "fisheye624") != "fisheye624":
            raise ValueError(
                f"lens, params: expected only with model fisheye624 and no intrinsics, "
                f"got model {spec.get('model')!r} with {extra}"
            )
        return Fisheye624Lens.from_params(spec["params"], size)
    if "model" not in spec and len(distortion) > 0:
        names = ", ".join(kind.model for kind in LENS_KINDS[1:])
        raise ValueError(f"lens, model: expected one of {names} beside distortion, got none")
    model = spec.get("model", "pinhole")
    if "K" in spec:
        double = sorted({"f", "fx", "fy", "cx", "cy"} & set(spec))
        if double:
            raise ValueError(f"lens: expected either K or {', '.join(double)}, got both")
        return _from_K("lens, K", model, spec["K"], size, distortion)
    fx, fy = spec.get("fx", spec.get("f")), spec.get("fy", spec.get("f"))
    if fx is None or fy is None or ("f" in spec and ("fx" in spec or "fy" in spec)):
        raise ValueError(f"lens: expected K, or f, or both fx and fy, got keys {sorted(spec)}")
    center = {"cx": spec.get("cx", (size[1] - 1) / 2), "cy": spec.get("cy", (size[0] - 1) / 2)}
    return Lens.from_dict(
        {
            "model": model,
            "image_size_hw": size,
            "fx": fx,
            "fy": fy,
            **center,
            "distortion": distortion,
        }
    )


def _from_K(name: str, model: Any, K: Any, size: tuple[int, int], distortion: Any) -> Lens:  # noqa: N802
    """Build a lens of ``model`` from a matrix."""
    m = require_intrinsics(name, K)
    focal = {"fx": m[0, 0], "fy": m[1, 1], "cx": m[0, 2], "cy": m[1, 2]}
    return Lens.from_dict(
        {"model": model, "image_size_hw": size, **focal, "distortion": distortion}
    )
