"""Statistics that add: sums and counts of any part of a corpus, divided once at the end.

Every process sums the clips it was given; the corpus's statistics are the sum of the processes'.
``sum(parts, Kind())`` is therefore the same however clips are dealt out, to rounding.
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from math import isnan, nan
from typing import Any, Final, Self, cast

import numpy as np
from numpy.typing import NDArray

from mint_hub.geometry.rotations import nearest_rotation

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

DIGITS: Final = {
    "": 3,
    "mm": 2,
    "px": 1,
    "deg": 2,
    "m": 3,
    "mm/frame^2": 2,
    "% of path": 2,
    "m/s^2": 2,
}
"""How many decimals of a number people are shown, by unit."""
NOTHING: Final = "—"


@dataclass(frozen=True)
class Measure:
    """What a number of a table is.

    Attributes:
        name: its key in ``metrics()``.
        unit: "" where it has none.
        ideal: the value of a perfect prediction, and the nearer the better; None for the truth's.

    """

    name: str
    unit: str
    ideal: float | None

    @property
    def title(self) -> str:
        """Name, with the unit in brackets where there is one."""
        return f"{self.name} ({self.unit})" if self.unit else self.name


def number(value: float, unit: str) -> str:
    """Print a number with the decimals of its unit.

    >>> number(29.9264, "mm"), number(-1e-9, "mm"), number(float("nan"), "mm")
    ('29.93', '0.00', '—')
    """
    return NOTHING if isnan(value) else f"{value:z.{DIGITS.get(unit, 3)}f}"


def interval(low: float, high: float, unit: str) -> str:
    """Print an interval, or nothing where there is none.

    >>> interval(1.0, 2.5, "m"), interval(float("nan"), 2.5, "m")
    ('[1.000, 2.500]', '')
    """
    return "" if isnan(low) or isnan(high) else f"[{number(low, unit)}, {number(high, unit)}]"


@dataclass(frozen=True)
class Additive:
    """Base of frozen dataclasses whose fields are all numbers with default 0.

    ``Kind()`` is neutral: ``s + Kind() == s``.
    """

    def __add__(self, other: Self) -> Self:
        """Add field by field."""
        if type(other) is not type(self):
            return NotImplemented
        return type(self)(
            **{f.name: getattr(self, f.name) + getattr(other, f.name) for f in fields(self)}
        )

    def to_dict(self) -> dict[str, float]:
        """Return the fields, ready for JSON."""
        return {f.name: getattr(self, f.name) for f in fields(self)}

    @classmethod
    def from_dict(cls, values: Mapping[str, float]) -> Self:
        """Invert ``to_dict``.

        Raises:
            ValueError: a field is missing or unknown.

        """
        require_fields(cls, values)
        return cls(**values)


def require_fields(kind: Any, values: Mapping[str, Any]) -> None:
    """Raise ValueError unless the keys of ``values`` are the fields of the dataclass ``kind``."""
    expected = {f.name for f in fields(kind)}
    missing, unknown = sorted(expected - set(values)), sorted(set(values) - expected)
    if missing or unknown:
        raise ValueError(
            f"{kind.__name__}: expected the fields {sorted(expected)}, got missing {missing} and "
            f"unknown {unknown}"
        )


def ratio(total: float, count: float) -> float:
    """``total / count``, and NaN where nothing was counted."""
    return total / count if count else nan


def none_for_nan(value: Any) -> Any:
    """Return what JSON holds: None for NaN, lists for tuples, however deep.

    >>> none_for_nan({"a": (1.0, float("nan"))})
    {'a': [1.0, None]}
    """
    if isinstance(value, dict):
        return {k: none_for_nan(v) for k, v in cast("dict[str, Any]", value).items()}
    if isinstance(value, tuple | list):
        return [none_for_nan(v) for v in cast("list[Any]", value)]
    return None if isinstance(value, float) and isnan(value) else value


def checked_fps(fps: float) -> float:
    """``fps``, frames a second.

    Raises:
        ValueError: it is not positive, or not finite.

    """
    if not 0 < fps < float("inf"):
        raise ValueError(f"fps: expected a positive number, got {fps}")
    return fps


def checked_floats(name: str, values: Any, shape: tuple[int, ...]) -> Floats:
    """``values`` as float64 of exactly ``shape``.

    Raises:
        ValueError: another shape; the message names what disagrees.

    """
    array = np.asarray(values, dtype=np.float64)
    if array.shape != shape:
        raise ValueError(f"{name}: expected shape {shape}, got {array.shape}")
    return array


def checked_flags(name: str, values: Any, shape: tuple[int, ...]) -> Bools:
    """``values`` as booleans of exactly ``shape``; numbers are refused, lest logits slip in.

    Raises:
        ValueError: another dtype or shape.

    """
    array = np.asarray(values)
    if array.dtype != np.bool_ or array.shape != shape:
        raise ValueError(
            f"{name}: expected booleans of shape {shape}, got {array.dtype} of {array.shape}"
        )
    return array


def finite_where(name: str, values: Floats, present: Bools) -> Floats:
    """``values`` (T, 2, ...) with zeros where ``present`` (T, 2) is False.

    Raises:
        ValueError: a number that is not finite where ``present``.

    """
    bad = ~np.isfinite(values.reshape(*present.shape, -1)).all(axis=-1) & present
    if bad.any():
        frame, hand = (int(i[0]) for i in np.nonzero(bad))
        raise ValueError(
            f"{name}: expected finite numbers where the hand is present, got others in "
            f"{int(bad.sum())} of {int(present.sum())} hands, the first in frame {frame}, hand "
            f"{hand}"
        )
    return np.where(present.reshape(present.shape + (1,) * (values.ndim - 2)), values, 0.0)


def checked_path(name: str, T_world_from_camera: Any, frames: int | None = None) -> Floats:
    """Camera-to-world poses (T, 4, 4) as float64, their rotation parts made exact rotations.

    Raises:
        ValueError: not (T, 4, 4) with T >= 1 (and ``frames``, if said), numbers that are not
            finite, or a 3 x 3 part further than 0.1 from any rotation.

    """
    T = np.asarray(T_world_from_camera, dtype=np.float64)
    if T.ndim != 3 or T.shape[1:] != (4, 4) or len(T) == 0 or frames not in (None, len(T)):
        wanted = "T" if frames is None else frames
        raise ValueError(f"{name}: expected ({wanted}, 4, 4) poses, got shape {T.shape}")
    bad = ~np.isfinite(T).all(axis=(1, 2))
    if bad.any():
        raise ValueError(
            f"{name}: expected finite poses, got {int(bad.sum())} others of {len(T)}, the first "
            f"in frame {int(bad.argmax())}"
        )
    R = nearest_rotation(T[:, :3, :3], check=False)
    off = np.abs(R - T[:, :3, :3]).max(axis=(1, 2)) > 0.1
    if off.any():
        raise ValueError(
            f"{name}: expected rigid poses, got a 3 x 3 part that is no rotation in "
            f"{int(off.sum())} of {len(T)}, the first in frame {int(off.argmax())}"
        )
    exact = np.broadcast_to(np.eye(4), T.shape).copy()
    exact[:, :3, :3], exact[:, :3, 3] = R, T[:, :3, 3]
    return exact
