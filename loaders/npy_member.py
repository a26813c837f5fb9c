"""The npy members of a sample as arrays that share the memory of the file, and back to bytes."""

import io
import math
from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mint_hub.loaders.fields import EpisodeError, placed
from mint_hub.loaders.member_table import EXTRA, MEMBERS, Member, member


def npy_bytes(array: NDArray[Any], spec: Member) -> bytes:
    """Return the array as an npy file of format 1.0, little endian, C order."""
    contiguous = np.ascontiguousarray(array, np.dtype(spec.dtype).newbyteorder("<"))
    numbers: Any = contiguous.reshape(-1).view(np.uint8).data
    return b"".join([_header(contiguous.dtype.str, contiguous.shape), numbers])


@lru_cache(maxsize=8192)
def _header(descr: str, shape: tuple[int, ...]) -> bytes:
    stream = io.BytesIO()
    fields = {"descr": descr, "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(stream, fields)
    return stream.getvalue()


def arrays_of(members: Mapping[str, Any], where: str = "") -> dict[str, NDArray[Any]]:
    """Return the npy members among ``members`` as read-only arrays that share their memory.

    Raises:
        EpisodeError: no whole npy file of the declared dtype and width, or numbers that are not
            finite (scores may be NaN).

    """
    arrays = {m.name: _array_of(members[m.name], m, where) for m in MEMBERS if m.name in members}
    for name, array in arrays.items():
        checked = array[:, :1] if name == EXTRA else array
        if not _all_finite(checked):
            frame, column = (int(i) for i in np.argwhere(~np.isfinite(checked))[0])
            message = f"{name}: expected finite numbers, got {array[frame, column]}"
            label = f"{message} at frame {frame}, {_column_at(member(name), column)}"
            raise placed(EpisodeError(label), where)
    return arrays


def data_offset(data: Any) -> int:
    """Return where the numbers begin in the bytes of an npy file.

    >>> import numpy as np
    >>> data_offset(npy_bytes(np.zeros((5, 17)), member("traj.npy")))
    128

    Raises:
        EpisodeError: not the beginning of an npy file.

    """
    head = bytes(data[:12])
    if len(head) < 12 or head[:6] != np.lib.format.MAGIC_PREFIX or head[6] not in (1, 2):
        raise EpisodeError(f"expected a npy file of format 1.0 or 2.0, got {head[:8]!r}")
    size = 2 if head[6] == 1 else 4
    return 8 + size + int.from_bytes(head[8 : 8 + size], "little")


def _array_of(data: Any, spec: Member, where: str) -> NDArray[Any]:
    try:
        start = data_offset(data)
        dtype, shape, by_column = _parsed_header(bytes(data[:start]))
        want = np.dtype(spec.dtype).newbyteorder("<")
        if dtype != want:
            raise EpisodeError(f"expected dtype {spec.dtype}, got {dtype}")
        if len(shape) != 2 or shape[1] != spec.width:
            raise EpisodeError(f"expected (T, {spec.width}), got {_named_shape(shape)}")
        if by_column:
            raise EpisodeError("expected rows one after another (C order), got Fortran order")
        size = math.prod(shape) * dtype.itemsize
        if len(data) - start != size:
            raise EpisodeError(f"expected {size} bytes of numbers, got {len(data) - start}")
    except EpisodeError as error:
        raise placed(EpisodeError(f"{spec.name}: {error}"), where) from None
    array = np.frombuffer(data, dtype, math.prod(shape), start).reshape(shape)
    array.setflags(write=False)
    return array


def _all_finite(array: NDArray[Any]) -> bool:
    """Whether no number is infinite or NaN: those have every bit of the exponent set."""
    bits = array.view(f"<u{array.itemsize}")
    exponent = np.array(np.inf, array.dtype).view(bits.dtype)
    return not ((bits & exponent) == exponent).any()


@lru_cache(maxsize=8192)
def _parsed_header(head: bytes) -> tuple[np.dtype[Any], tuple[int, ...], bool]:
    stream = io.BytesIO(head)
    try:
        version = np.lib.format.read_magic(stream)
        if version == (1, 0):
            shape, by_column, dtype = np.lib.format.read_array_header_1_0(stream)
        else:
            shape, by_column, dtype = np.lib.format.read_array_header_2_0(stream)
    except ValueError as error:
        raise EpisodeError(f"expected a whole npy header, got: {error}") from error
    return dtype, shape, by_column


def _named_shape(shape: tuple[int, ...]) -> str:
    return f"(T, {shape[1]})" if len(shape) == 2 else str(shape)


def _column_at(spec: Member, position: int) -> str:
    return next(name for name, s in spec.slices.items() if s.start <= position < s.stop)
