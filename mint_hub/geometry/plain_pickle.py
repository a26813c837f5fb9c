"""Read pickles that hold data, without ever running what a pickle may ask to run.

A pickle is a small program: loading one calls whatever it names. The reader here answers every name
with an inert record (or refuses it), so that loading only collects values; plain Python containers,
numpy arrays, scipy sparse matrices and chumpy arrays are then rebuilt from those records by this
module. MANO's files and VITRA's annotations are read this way.
"""

from __future__ import annotations

import ast
import io
import pickle
from collections import OrderedDict
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

_MAX_ELEMENTS = 200_000_000
_MAX_DEPTH = 200
_ARRAY_KINDS = "biufcSU"


class UnreadablePickleError(ValueError):
    """A pickle asks for something that is not plain data; nothing of it was run."""


def load_plain_pickle(source: Path | str | bytes) -> Any:
    """Read the containers, strings, numbers and arrays of a pickle; nothing in it is executed.

    Args:
        source: a file, or the bytes of a pickle. Pickles of Python 2 are read as latin-1.

    Returns:
        dict, list, tuple, set, str, bytes, numbers, None and numpy arrays. Scipy sparse matrices
        come back dense, chumpy arrays as the numpy arrays they hold. A chumpy expression, which
        has no stored value, comes back as an ``Opaque`` that only knows its name.

    Raises:
        UnreadablePickleError: it names anything else (the message says what), or is damaged.

    """
    data = source if isinstance(source, bytes) else Path(source).read_bytes()
    where = "pickle" if isinstance(source, bytes) else str(source)
    try:
        return _decode(_Reader(io.BytesIO(data), where).load(), 0)
    except UnreadablePickleError:
        raise
    except RecursionError as error:
        raise UnreadablePickleError(f"{where}: nested too deeply, or within itself") from error
    except Exception as error:  # a damaged pickle may raise nearly anything
        raise UnreadablePickleError(f"{where}: not a readable pickle: {error}") from error


def load_plain_npy(path: Path | str) -> Any:
    """Read what ``numpy.load(path, allow_pickle=True)`` would, with nothing executed.

    A zero-dimensional object array, as ``numpy.save`` makes of a dict, is returned as its content.

    Raises:
        UnreadablePickleError: not an npy file, or its pickle asks for more than plain data.

    """
    path = Path(path)
    with path.open("rb") as file:
        try:
            version = np.lib.format.read_magic(file)
            length = int.from_bytes(file.read(2 if version == (1, 0) else 4), "little")
            header: dict[str, Any] = ast.literal_eval(file.read(length).decode("latin-1"))
        except (ValueError, SyntaxError) as error:
            raise UnreadablePickleError(f"{path}: not an npy file: {error}") from error
        if header.get("descr") != "|O":
            file.seek(0)
            return np.load(file, allow_pickle=False)
        content = load_plain_pickle(file.read())
    return content.item() if isinstance(content, np.ndarray) and content.shape == () else content


class _Record:
    """Something a pickle asked to have built: its arguments and state, kept and not acted upon."""

    name: ClassVar[str] = ""
    args: tuple[Any, ...]
    state: Any

    def __new__(cls, *args: Any) -> _Record:
        made = super().__new__(cls)
        made.args = args
        made.state = None
        return made

    def __setstate__(self, state: Any) -> None:
        self.state = state

    def decode(self, depth: int) -> Any:
        raise UnreadablePickleError(f"{self.name} is incomplete here")


class _Dtype(_Record):
    def decode(self, depth: int) -> np.dtype[Any]:
        text = str(self.args[0])
        order = self.state[1] if isinstance(self.state, tuple) and len(self.state) > 1 else "="
        order = order if order in ("<", ">", "=", "|") else "="
        dtype = np.dtype(text).newbyteorder("=" if order == "|" else order)
        if dtype.kind not in _ARRAY_KINDS + "O":
            raise UnreadablePickleError(f"arrays of {text!r} are not plain data")
        return dtype


class _Array(_Record):
    """``_reconstruct(ndarray, ...)``; its state is (version, shape, dtype, fortran, data)."""

    def decode(self, depth: int) -> np.ndarray:
        _, shape, dtype_record, fortran, data = self.state
        dtype = _decode(dtype_record, depth)
        order = "F" if fortran else "C"
        if dtype.kind == "O":
            flat = np.empty(len(data), dtype=object)
            for i, item in enumerate(data):
                flat[i] = _decode(item, depth)
            return flat.reshape(_checked_shape(shape), order=order)
        raw = _decode(data, depth)
        return _array_of(raw, dtype, shape, order)


class _FromBuffer(_Record):
    """``numpy`` ``_frombuffer(buffer, dtype, shape, order)`` of pickle protocol 5."""

    def decode(self, depth: int) -> np.ndarray:
        raw, dtype, shape, order = (_decode(x, depth) for x in self.args[:4])
        return _array_of(raw, dtype, shape, "F" if order == "F" else "C")


class _Scalar(_Record):
    def decode(self, depth: int) -> Any:
        dtype, raw = (_decode(x, depth) for x in self.args)
        return raw if dtype.kind == "O" else _array_of(raw, dtype, (), "C")[()]


class _Encode(_Record):
    """``_codecs.encode(text, "latin1")``, how protocol 2 writes bytes."""

    def decode(self, depth: int) -> bytes:
        return str(self.args[0]).encode("latin-1")


class _Builtin(_Record):
    """A set, bytes, bytearray or complex number, which old protocols write as a call."""

    def decode(self, depth: int) -> Any:
        kinds = {"set": set, "frozenset": frozenset, "bytes": bytes, "bytearray": bytearray}
        kind = kinds.get(self.name.split(".")[1], complex)
        arguments = [_decode(x, depth) for x in self.args]
        if any(isinstance(x, int) for x in arguments) and kind in (bytes, bytearray):
            raise UnreadablePickleError("bytes are asked for by their number alone")
        if kind is bytearray and len(arguments) == 2:
            return bytearray(str(arguments[0]).encode("latin-1"))
        return kind(*arguments)


class _Object(_Record):
    """``copyreg._reconstructor(cls, object, None)``: an instance that no constructor made."""

    def decode(self, depth: int) -> Any:
        cls = self.args[0]
        if not (isinstance(cls, type) and issubclass(cls, _Record)):
            raise UnreadablePickleError("an object is rebuilt that is not plain data")
        instance = cls()
        instance.state = self.state
        return instance.decode(depth)


class _Sparse(_Record):
    """A scipy CSC or CSR matrix, returned dense."""

    def decode(self, depth: int) -> np.ndarray:
        state: dict[str, Any] = _decode(self.state, depth)
        rows, columns = _checked_shape(state["_shape"] if "_shape" in state else state["shape"])
        major, minor = (columns, rows) if "csc" in self.name else (rows, columns)
        counts = np.diff(np.asarray(state["indptr"], dtype=np.int64))
        majors = np.repeat(np.arange(major), counts)
        minors = np.asarray(state["indices"], dtype=np.int64)[: len(majors)]
        if len(minors) and not 0 <= minors.min() <= minors.max() < minor:
            raise UnreadablePickleError("a sparse matrix has indices outside its shape")
        dense = np.zeros((rows, columns), dtype=np.asarray(state["data"]).dtype)
        where = (minors, majors) if "csc" in self.name else (majors, minors)
        np.add.at(dense, where, np.asarray(state["data"])[: len(majors)])
        return dense


class Opaque(_Record):
    """A chumpy object without a stored value; only its ``name`` is known."""


class _Chumpy(Opaque):
    """``chumpy.ch.Ch`` holds its array as ``x``; ``Select`` picks flat elements of another."""

    def decode(self, depth: int) -> Any:
        state = self.state if isinstance(self.state, dict) else {}
        if "x" in state:
            return np.asarray(_decode(state["x"], depth))
        if {"a", "idxs"} <= set(state):
            source = _decode(state["a"], depth)
            if isinstance(source, np.ndarray):
                picked = source.ravel()[np.asarray(_decode(state["idxs"], depth), dtype=np.int64)]
                shape = _decode(state.get("preferred_shape"), depth)
                return picked if shape is None else picked.reshape(_checked_shape(shape))
        return self


_RECORDS: dict[tuple[str, str], type[_Record]] = {
    ("numpy", "ndarray"): _Record,
    ("numpy", "dtype"): _Dtype,
    ("numpy.core.multiarray", "_reconstruct"): _Array,
    ("numpy.core.multiarray", "scalar"): _Scalar,
    ("numpy.core.numeric", "_frombuffer"): _FromBuffer,
    ("_codecs", "encode"): _Encode,
    ("copyreg", "_reconstructor"): _Object,
    ("builtins", "object"): _Record,
    **{("builtins", n): _Builtin for n in ("set", "frozenset", "bytes", "bytearray", "complex")},
}


class _Reader(pickle.Unpickler):
    def __init__(self, file: io.BytesIO, where: str) -> None:
        super().__init__(file, encoding="latin-1")
        self._where = where

    def find_class(self, module_name: str, global_name: str, /) -> Any:
        old_names = {"copy_reg": "copyreg", "__builtin__": "builtins"}
        module = old_names.get(module_name, module_name).replace("numpy._core", "numpy.core")
        if (module, global_name) == ("collections", "OrderedDict"):
            return OrderedDict
        base = _RECORDS.get((module, global_name))
        if module.startswith("scipy.sparse") and global_name[:4] in ("csc_", "csr_"):
            base = _Sparse
        if module == "chumpy" or module.startswith("chumpy."):
            base = _Chumpy
        if base is None:
            raise UnreadablePickleError(
                f"{self._where}: it asks for {module_name}.{global_name}; only plain data is read "
                "(containers, numbers, text, numpy arrays, scipy sparse matrices). Nothing was run"
            )
        return type(base.__name__, (base,), {"name": f"{module_name}.{global_name}"})


def _decode(value: Any, depth: int) -> Any:
    """Rebuild the arrays below ``value``."""
    if depth > _MAX_DEPTH:
        raise RecursionError
    depth += 1
    if isinstance(value, _Record):
        return value.decode(depth)
    if isinstance(value, dict):
        return {_decode(k, depth): _decode(v, depth) for k, v in value.items()}
    if isinstance(value, (list, tuple, set, frozenset)):
        return type(value)(_decode(v, depth) for v in value)
    if isinstance(value, type):
        raise UnreadablePickleError(f"a class is stored where data was expected: {value.__name__}")
    return value


def _checked_shape(shape: Any) -> tuple[int, ...]:
    checked = tuple(int(n) for n in np.atleast_1d(np.asarray(shape, dtype=np.int64)))
    if any(n < 0 for n in checked) or np.prod([float(n) for n in checked]) > _MAX_ELEMENTS:
        raise UnreadablePickleError(f"an array of shape {checked} is not believable")
    return checked


def _array_of(raw: Any, dtype: np.dtype[Any], shape: Any, order: str) -> np.ndarray:
    if dtype.kind == "O":
        raise UnreadablePickleError("an object array is stored as raw bytes")
    data = raw.encode("latin-1") if isinstance(raw, str) else bytes(raw)
    checked = _checked_shape(shape)
    array = np.frombuffer(data, dtype).reshape(checked, order="F" if order == "F" else "C")
    return np.array(array, dtype=dtype.newbyteorder("="), order="C")
