"""What an episode is made of: its arrays declared once, its text segments, and their checks.

Letters in shapes: T frames. Arrays of hands have the hand (left, right) on the axis after it.
"""

import json
import math
import operator
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields
from typing import Any, Final, Literal, SupportsIndex, cast

import numpy as np
from numpy.typing import NDArray

from mint_hub.conventions import SIDES, Side
from mint_hub.geometry import hand_state as hands

KEY_PATTERN: Final = re.compile(r"[a-z0-9_-]+")
"""Keys name shard members: a dot would silently merge samples in webdataset and datasets."""

ROTATION_TOLERANCE: Final = 1e-4
"""Largest entry of R Rᵀ - I that still counts as a rotation; float32 round-off is far below."""

PER_FRAME_META: Final = ("source_timestamps_s",)
"""Entries of ``meta`` that are lists with one value a frame, and are cut with the frames."""


class EpisodeError(ValueError):
    """An episode, or the file it was read from, breaks the schema."""


@dataclass(frozen=True)
class ArrayField:
    """Declaration of one array of an episode."""

    name: str
    shape: tuple[int | Literal["T"], ...]
    dtype: str
    unit: str
    frame: str
    description: str
    optional: bool = False


ARRAY_FIELDS: Final = (
    ArrayField(
        name="timestamps_s",
        shape=("T",),
        dtype="float64",
        unit="s",
        frame="video",
        description="presentation time, strictly increasing",
    ),
    ArrayField(
        name="T_camera_from_world",
        shape=("T", 4, 4),
        dtype="float64",
        unit="m",
        frame="camera from world",
        description="rigid pose of the camera, world to camera",
    ),
    ArrayField(
        name="fov_vh_rad",
        shape=("T", 2),
        dtype="float32",
        unit="rad",
        frame="image",
        description="field of view, vertical then horizontal, between 0 and pi",
    ),
    ArrayField(
        name="hand_state",
        shape=("T", 2, hands.HAND_STATE_SIZE),
        dtype="float32",
        unit="m, 6D rows, shape",
        frame="camera",
        description="wrist pose, joint rotations and shape, read through geometry.hand_state",
    ),
    ArrayField(
        name="presence",
        shape=("T", 2),
        dtype="bool",
        unit="",
        frame="",
        description="whether the hand is there",
    ),
    ArrayField(
        name="presence_score",
        shape=("T", 2),
        dtype="float32",
        unit="probability",
        frame="",
        description="confidence, 0 to 1, that the hand is there",
        optional=True,
    ),
    ArrayField(
        name="filled",
        shape=("T", 2),
        dtype="bool",
        unit="",
        frame="",
        description="whether the hand is there by interpolation over a gap, not by observation",
        optional=True,
    ),
)
"""The arrays of an episode, declared once: checks, files and dataset features follow this."""


@dataclass(frozen=True)
class TextSegment:
    """What happens in frames start <= k < end of the episode, and by which hand.

    ``side`` is "left", "right", "both", or None where nobody said.

    Raises:
        EpisodeError: a field has another type or value, or the frames are empty.

    """

    id: str
    text: str
    side: Side | Literal["both"] | None
    start: int
    end: int

    def __post_init__(self) -> None:
        for name in ("id", "text"):
            if not isinstance(getattr(self, name), str):
                raise EpisodeError(
                    f"text segment {name}: expected str, got {getattr(self, name)!r}"
                )
        place = f"text segment {self.id!r}"
        if self.side not in (*SIDES, "both", None):
            expected = "left, right, both or None"
            raise EpisodeError(f"{place} side: expected {expected}, got {self.side!r}")
        for name in ("start", "end"):
            object.__setattr__(self, name, integer(getattr(self, name), f"{place} {name}"))
        if not 0 <= self.start < self.end:
            raise EpisodeError(
                f"{place}: expected frames 0 <= start < end, got start {self.start}, end {self.end}"
            )

    def to_dict(self) -> dict[str, Any]:
        """Return the five fields, JSON-able."""
        return {f.name: getattr(self, f.name) for f in fields(self)}

    @classmethod
    def from_dict(cls, values: object) -> "TextSegment":
        """Build a segment from ``to_dict``'s result.

        Raises:
            EpisodeError: not a mapping with exactly the five fields, or one is wrong.

        """
        names = sorted(f.name for f in fields(cls))
        given = cast("dict[str, Any]", dict(values)) if isinstance(values, Mapping) else None
        if given is None or sorted(given) != names:
            got = repr(values) if given is None else sorted(given)
            raise EpisodeError(f"text segment: expected {names}, got {got}")
        return cls(**given)


def placed(error: EpisodeError, where: str, key: str = "") -> EpisodeError:
    """Return the error with the shard and the episode at its end, each said once."""
    message = str(error).removesuffix(f" (episode {key})")
    place = ", ".join([*([where] if where else []), *([f"episode {key}"] if key else [])])
    if not place:
        return error
    return EpisodeError(f"{message} in {place}" if where else f"{message} ({place})")


def integer(value: object, place: str) -> int:
    """Return a whole number of any integer type as int; bools and floats are refused."""
    if type(value) is int:
        return value
    if isinstance(value, bool | np.bool_) or not isinstance(value, SupportsIndex):
        raise EpisodeError(f"{place}: expected a whole number, got {value!r}")
    return operator.index(value)


def checked_key(value: object) -> str:
    """Return the key, or refuse characters that would break shard members."""
    if not isinstance(value, str) or not KEY_PATTERN.fullmatch(value):
        raise EpisodeError(f"key: expected only a-z, 0-9, '_' and '-', got {value!r}")
    return value


def slug(name: str) -> str:
    """Return a name in characters that keys may have, never empty: others become '-'.

    >>> slug("P01/videos (take 2)")
    'p01-videos-take-2'
    """
    return re.sub(r"[^a-z0-9_-]+", "-", name.lower()).strip("-") or "x"


def checked_size(value: object) -> tuple[int, int]:
    """Return (height, width), both positive."""
    if not isinstance(value, tuple | list | np.ndarray) or len(value) != 2:
        raise EpisodeError(f"image_size_hw: expected (height, width), got {value!r}")
    height, width = (integer(v, "image_size_hw") for v in value)
    if height < 1 or width < 1:
        raise EpisodeError(f"image_size_hw: expected positive sizes, got {(height, width)}")
    return height, width


def require_window(start: int, length: int, num_frames: int, key: str | None = None) -> None:
    """Raise EpisodeError unless frames start .. start + length - 1 are among ``num_frames``."""
    if start < 0 or length < 1 or start + length > num_frames:
        place = "" if key is None else f" (episode {key})"
        raise EpisodeError(
            f"window: expected 1 <= length and 0 <= start <= {num_frames} - length, "
            f"got start {start}, length {length}{place}"
        )


def checked_array(spec: ArrayField, value: object, num_frames: int | None) -> NDArray[Any]:
    """Return ``value`` as the declared read-only array.

    Kinds convert upwards only (integers to floats, any float width; never floats to bool). The
    array is copied unless it is read-only already.
    """
    try:
        array = np.asarray(value)
    except (ValueError, TypeError) as error:
        raise EpisodeError(f"{spec.name}: expected an array, got {type(value).__name__}") from error
    want = np.dtype(spec.dtype)
    if not np.can_cast(array.dtype, want, casting="same_kind"):
        raise EpisodeError(f"{spec.name}: expected dtype {want}, got {array.dtype}")
    sizes = [num_frames if size == "T" else size for size in spec.shape]
    if array.ndim != len(sizes) or any(
        size not in (None, got) for size, got in zip(sizes, array.shape, strict=True)
    ):
        named = f"({', '.join(map(str, spec.shape))}{',' if len(sizes) == 1 else ''})"
        where = "" if num_frames is None else f" with T = {num_frames}"
        raise EpisodeError(f"{spec.name}: expected shape {named}{where}, got {array.shape}")
    if array.shape[0] == 0:
        raise EpisodeError(f"{spec.name}: expected at least one frame, got none")
    with np.errstate(over="ignore"):
        array = array.astype(want, copy=array.flags.writeable)
    if not np.isfinite(array).all():
        bad = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        raise EpisodeError(f"{spec.name}: expected finite numbers, got {array[bad]} at {bad}")
    return read_only(array)


def read_only(array: NDArray[Any]) -> NDArray[Any]:
    """Forbid writing to ``array`` and return it."""
    array.setflags(write=False)
    return array


def check_values(arrays: Mapping[str, NDArray[Any]]) -> None:
    """Check what shapes and dtypes cannot say; ``arrays`` are the present ones of ARRAY_FIELDS."""
    steps = np.diff(arrays["timestamps_s"])
    if (late := np.flatnonzero(steps <= 0)).size:
        k = int(late[0])
        pair = arrays["timestamps_s"][k : k + 2].tolist()
        raise EpisodeError(f"timestamps_s: expected increasing times, got {pair} at frame {k}")
    _check_poses(arrays["T_camera_from_world"])
    _check_range("fov_vh_rad", arrays["fov_vh_rad"], 0.0, math.pi, inclusive=False)
    if "presence_score" in arrays:
        _check_range("presence_score", arrays["presence_score"], 0.0, 1.0, inclusive=True)
    if "filled" in arrays and (bad := np.argwhere(arrays["filled"] & ~arrays["presence"])).size:
        frame, hand = (int(i) for i in bad[0])
        raise EpisodeError(
            f"filled: expected only hands that are present, got an absent one at frame {frame}, "
            f"{SIDES[hand]}"
        )
    _check_rotations(arrays["hand_state"])


def row_products(rot6d: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]]:
    """Return a.a, b.b and a.b, each (N,), of the rows a and b of 6D rotations (N, 6).

    One number at a time over all rotations: several times faster than over rows of three.
    """
    a0, a1, a2, b0, b1, b2 = np.ascontiguousarray(rot6d.T)
    aa, bb = a0 * a0 + a1 * a1 + a2 * a2, b0 * b0 + b1 * b1 + b2 * b2
    return aa, bb, a0 * b0 + a1 * b1 + a2 * b2


def _check_rotations(hand_state: NDArray[np.float32]) -> None:
    """Refuse 6D rotations whose rows span no plane."""
    rotations = hand_state[..., hands.ORIENTATION.start : hands.JOINT_ROTATIONS.stop]
    with np.errstate(over="ignore", invalid="ignore"):
        aa, bb, ab = row_products(rotations.reshape(-1, 6))
        if (aa * bb - ab * ab > 0.25).all():  # the squared area, which round-off cannot hide here
            return
    rot6d = rotations.reshape(*hand_state.shape[:-1], -1, 6)
    area = np.linalg.norm(np.cross(rot6d[..., :3], rot6d[..., 3:]), axis=-1)
    if (bad := np.argwhere(area < 1e-6)).size:
        frame, hand, joint = (int(i) for i in bad[0])
        raise EpisodeError(
            f"hand_state: expected two independent rows in every 6D rotation, got "
            f"{rot6d[frame, hand, joint].tolist()} at frame {frame}, {SIDES[hand]} joint {joint}"
        )


def _check_poses(T: NDArray[np.float64]) -> None:
    name = "T_camera_from_world"
    if (bad := np.flatnonzero((T[:, 3] != (0, 0, 0, 1)).any(axis=-1))).size:
        row = T[bad[0], 3].tolist()
        raise EpisodeError(f"{name}: expected last row [0, 0, 0, 1], got {row} at frame {bad[0]}")
    R = T[:, :3, :3]
    off = np.abs(R @ np.swapaxes(R, -1, -2) - np.eye(3))
    if not off.max() <= ROTATION_TOLERANCE:
        error = off.max(axis=(-1, -2))
        k = int(np.flatnonzero(error > ROTATION_TOLERANCE)[0])
        raise EpisodeError(
            f"{name}: expected R Rᵀ = I, got an error of {error[k]:.2g} at frame {k}"
        )
    a, b, c = (R[:, row].T for row in range(3))  # each (3, T)
    turned = a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
    if (bad := np.flatnonzero(sum(x * y for x, y in zip(turned, c, strict=True)) < 0)).size:
        raise EpisodeError(f"{name}: expected a rotation, got a reflection at frame {bad[0]}")


def _check_range(name: str, x: NDArray[Any], low: float, high: float, *, inclusive: bool) -> None:
    inside = (x >= low) & (x <= high) if inclusive else (x > low) & (x < high)
    if not inside.all():
        bad = tuple(int(i) for i in np.argwhere(~inside)[0])
        span = f"{low:g} <= x <= {high:g}" if inclusive else f"{low:g} < x < {high:.6g}"
        raise EpisodeError(f"{name}: expected {span}, got {x[bad]} at {bad}")


def checked_meta(value: object, num_frames: int) -> dict[str, Any]:
    """Return a copy of ``value`` made of plain JSON values (tuples become lists)."""
    if not isinstance(value, Mapping):
        raise EpisodeError(f"meta: expected a mapping, got {type(value).__name__}")
    for place, item in _leaves(cast("Mapping[object, object]", value), "meta"):
        finite = not isinstance(item, float) or math.isfinite(item)
        if not isinstance(item, str | int | float | bool | None) or not finite:
            raise EpisodeError(f"{place}: expected a JSON value, got {item!r}")
    meta: dict[str, Any] = json.loads(json.dumps(value))
    for name in PER_FRAME_META:
        if meta.get(name) is not None and (
            not isinstance(meta[name], list) or len(meta[name]) != num_frames
        ):
            raise EpisodeError(f"meta[{name!r}]: expected a list of {num_frames}, one a frame")
    fps = meta.get("fps", 1)
    if isinstance(fps, bool) or not isinstance(fps, int | float) or fps <= 0:
        raise EpisodeError(f"meta['fps']: expected a positive number, got {fps!r}")
    return meta


def _leaves(value: object, place: str) -> Iterator[tuple[str, object]]:
    if isinstance(value, Mapping):
        for key, item in cast("Mapping[object, object]", value).items():
            if not isinstance(key, str):
                raise EpisodeError(f"{place}: expected names as keys, got {key!r}")
            yield from _leaves(item, f"{place}[{key!r}]")
    elif isinstance(value, list | tuple):
        for i, item in enumerate(cast("list[object]", value)):
            yield from _leaves(item, f"{place}[{i}]")
    else:
        yield place, value
