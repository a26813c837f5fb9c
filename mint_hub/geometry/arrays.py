"""One code for numpy and torch: which library an array belongs to, and the few helpers both need.

Geometry is written against a namespace ``xp`` that is ``numpy`` or ``torch``; results have the
kind, dtype and device of the inputs. Torch is looked up, never imported, so that a program that
works on numpy arrays does not pay for it.
"""

import sys
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

if TYPE_CHECKING:
    import torch
    from numpy.typing import NDArray

    Array = NDArray[Any] | torch.Tensor
else:
    Array = Any

ArrayT = TypeVar("ArrayT", bound="Array")
"""For functions that return the kind of array they were given."""


def is_torch(value: object) -> bool:
    """Whether ``value`` is a torch tensor; never imports torch."""
    torch_module = sys.modules.get("torch")
    return torch_module is not None and isinstance(value, torch_module.Tensor)


def namespace(*arrays: object) -> Any:
    """Return the module, ``numpy`` or ``torch``, that all ``arrays`` belong to.

    Python numbers and None belong to both and are skipped; with nothing else left it is numpy.

    Raises:
        TypeError: a mix of both, or something that is neither.

    >>> namespace(np.zeros(3), 2.0).__name__
    'numpy'

    """
    found: set[str] = set()
    for value in arrays:
        if value is None or isinstance(value, (bool, int, float)):
            continue
        if is_torch(value):
            found.add("torch")
        elif isinstance(value, (np.ndarray, np.generic)):
            found.add("numpy")
        else:
            raise TypeError(
                f"expected numpy arrays or torch tensors, got {type(value).__module__}."
                f"{type(value).__name__}"
            )
    if len(found) > 1:
        raise TypeError("expected all numpy arrays or all torch tensors, got a mix of both")
    return sys.modules["torch"] if "torch" in found else np


def require_shape(name: str, value: Array, tail: tuple[int, ...]) -> None:
    """Raise ValueError unless the last axes of ``value`` have the sizes ``tail``."""
    shape = tuple(value.shape)
    if len(shape) < len(tail) or shape[len(shape) - len(tail) :] != tail:
        expected = ", ".join(("...", *map(str, tail)))
        raise ValueError(f"{name}: expected shape ({expected}), got {shape}")


def require_finite(name: str, value: Array) -> None:
    """Raise ValueError when ``value`` has a NaN or an infinity."""
    bad = ~namespace(value).isfinite(value)
    if bool(bad.any()):
        raise ValueError(
            f"{name}: expected finite numbers, got {int(bad.sum())} non-finite of "
            f"{int(np.prod(tuple(value.shape)))}"
        )


def runs(mask: "NDArray[np.bool_]") -> list[tuple[int, int]]:
    """Stretches (start, stop) in which a mask (N,) is true, in order.

    >>> runs(np.array([True, True, False, True]))
    [(0, 2), (3, 4)]
    """
    edges = np.flatnonzero(np.diff(mask.astype(np.int8), prepend=0, append=0))
    return [(int(start), int(stop)) for start, stop in edges.reshape(-1, 2)]


def detached(x: ArrayT) -> ArrayT:
    """``x`` without its gradient history; numpy arrays are returned as they are."""
    values: Any = x
    return values.detach() if is_torch(x) else values


def as_dtype(x: ArrayT, dtype: Any) -> ArrayT:
    """``x`` converted to ``dtype``, one of its own library's."""
    values: Any = x
    return values.to(dtype) if is_torch(x) else values.astype(dtype, copy=False)


def full(shape: tuple[int, ...], value: float, like: ArrayT) -> ArrayT:
    """Make an array filled with ``value``, of the kind, dtype and device of ``like``."""
    xp = namespace(like)
    place = {"device": like.device} if is_torch(like) else {}
    return xp.full(shape, value, dtype=like.dtype, **place)


def eye(size: int, like: ArrayT) -> ArrayT:
    """Make the identity (size, size), of the kind, dtype and device of ``like``."""
    xp = namespace(like)
    place = {"device": like.device} if is_torch(like) else {}
    return xp.eye(size, dtype=like.dtype, **place)


def constant(values: Any, like: ArrayT) -> ArrayT:
    """``values`` (nested numbers) as an array of the kind, dtype and device of ``like``."""
    xp = namespace(like)
    place = {"device": like.device} if is_torch(like) else {}
    return xp.asarray(values, dtype=like.dtype, **place)


def norm(x: ArrayT, axis: int = -1, keepdims: bool = False) -> ArrayT:
    """Euclidean norm along ``axis``; its gradient at the zero vector is zero instead of NaN."""
    xp = namespace(x)
    values: Any = x
    square = (values * values).sum(axis=axis, keepdims=keepdims)
    positive = square > 0
    root = xp.sqrt(xp.where(positive, square, 1.0))
    return xp.where(positive, root, square)


def dot(a: ArrayT, b: ArrayT, keepdims: bool = False) -> ArrayT:
    """Dot product along the last axis."""
    product: Any = a * b
    return product.sum(axis=-1, keepdims=keepdims)


def cross(a: ArrayT, b: ArrayT) -> ArrayT:
    """Cross product of vectors (..., 3), broadcast over leading axes."""
    (ax, ay, az), (bx, by, bz) = components(a), components(b)
    xp = namespace(a, b)
    return xp.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=-1)


def components(x: Array) -> tuple[Any, ...]:
    """Return the slices of ``x`` along its last axis."""
    return tuple(x[..., i] for i in range(x.shape[-1]))


def transpose(matrix: ArrayT) -> ArrayT:
    """Swap the last two axes."""
    return namespace(matrix).swapaxes(matrix, -1, -2)


def over_points(matrix: ArrayT, points: Array) -> ArrayT:
    """Insert axes so that one matrix (..., n, m) serves many points.

    The leading axes of ``matrix`` are matched with the *first* leading axes of ``points``; the
    further axes of ``points`` share a matrix. A ``matrix`` with at least as many leading axes is
    returned as it is and broadcasts as usual.

    >>> over_points(np.zeros((7, 4, 4)), np.zeros((7, 2, 21, 3))).shape
    (7, 1, 1, 4, 4)
    """
    extra = (len(points.shape) - 1) - (len(matrix.shape) - 2)
    values: Any = matrix
    if extra <= 0:
        return values
    shape = tuple(matrix.shape)
    return values.reshape(shape[:-2] + (1,) * extra + shape[-2:])


def matvec(matrix: ArrayT, vector: ArrayT) -> ArrayT:
    """Matrices (..., n, m) times vectors (..., m), broadcast over leading axes."""
    product: Any = matrix @ vector[..., None]
    return product[..., 0]
