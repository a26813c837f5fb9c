"""The worker's half of the pipe: runs a script and answers calls. Needs Python 3.9 and numpy only.

A worker script is a file that stands alone (it cannot import mint_hub) and ends with

    if __name__ == "__main__":
        from worker_side import serve

        serve({"detect": detect})

where ``detect(arrays, **values)`` takes a dict of numpy arrays and plain JSON values, and returns
``(arrays, values)`` of the same kinds. The parent runs ``python worker_side.py SCRIPT IN OUT``: two
pipes of their own, so that whatever the script or its libraries print goes to standard error and
harms nothing. The script's folder is not on ``sys.path``.

A message is the length of a header (8 bytes, big-endian), the header (JSON: "arrays", a list of
name, dtype, shape; and whatever else), then the arrays' bytes one after the other, in C order.
Nothing is ever unpickled.
"""

from __future__ import annotations

import json
import os
import runpy
import struct
import sys
import threading
import time
import traceback
from collections.abc import Callable
from typing import Any

import numpy as np

LENGTH = struct.Struct(">Q")
MAX_HEADER = 64 << 20
KINDS = "biufc"
WATCH_S = 1.0

pipes = None
"""(in, out) once the parent gave them."""


def encode(header: dict[str, Any], arrays: dict[str, Any]) -> list[memoryview]:
    """Return the parts of a message, arrays uncopied.

    Raises:
        TypeError: an array of objects or of text, or a value that JSON does not have.

    """
    described: list[Any] = []
    payloads: list[memoryview] = []
    for name, given in arrays.items():
        array = np.asarray(given)
        if array.dtype.kind not in KINDS:
            raise TypeError(f"{name}: expected an array of numbers or bools, got {array.dtype}")
        described.append([name, array.dtype.str, list(array.shape)])
        if array.size:
            flat = np.ascontiguousarray(array).reshape(-1)
            payloads.append(flat.view(np.uint8).data)
    text = json.dumps({**header, "arrays": described}, default=plain).encode()
    return [memoryview(LENGTH.pack(len(text)) + text), *payloads]


def decode(read_into: Callable[[memoryview], None]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Read one message: its header and its arrays.

    Raises:
        ValueError: what came is not a message.

    """
    prefix = bytearray(LENGTH.size)
    read_into(memoryview(prefix))
    (length,) = LENGTH.unpack(prefix)
    if length > MAX_HEADER:
        raise ValueError(f"expected a header of at most {MAX_HEADER} bytes, got {length}")
    text = bytearray(length)
    read_into(memoryview(text))
    header = json.loads(text.decode())
    arrays: dict[str, Any] = {}
    for name, dtype_text, shape in header.pop("arrays"):
        dtype = np.dtype(dtype_text)
        if dtype.kind not in KINDS:
            raise ValueError(f"{name}: expected an array of numbers or bools, got {dtype}")
        array = np.empty(shape, dtype)
        if array.size:
            read_into(array.reshape(-1).view(np.uint8).data)
        arrays[name] = array
    return header, arrays


def plain(value: Any) -> Any:
    """Turn numpy scalars and paths into what JSON has."""
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    raise TypeError(f"expected a plain value (or an array among the arrays), got {type(value)}")


def serve(methods: dict[str, Callable[..., tuple[dict[str, Any], dict[str, Any]]]]) -> None:
    """Answer calls until the parent closes the pipe."""
    if pipes is None:
        raise RuntimeError("this script is a worker: mint_hub.labelling.worker.Worker starts it")
    source, sink = pipes
    write_all(sink, encode({"ready": sorted(methods)}, {}))
    while True:
        try:
            header, arrays = decode(lambda view: read_exactly(source, view))
        except EOFError:
            return
        write_all(sink, _answer(methods, header, arrays))


def _answer(
    methods: dict[str, Callable[..., tuple[dict[str, Any], dict[str, Any]]]],
    header: dict[str, Any],
    arrays: dict[str, Any],
) -> list[memoryview]:
    name = header["method"]
    try:
        if name not in methods:
            raise LookupError(f"expected one of {sorted(methods)}, got {name!r}")
        out, values = methods[name](arrays, **header["values"])
        return encode({"values": values}, out)
    except Exception as error:
        words = "".join(traceback.format_exception_only(type(error), error)).split()
        failure = {"error": " ".join(words)[:1000], "traceback": traceback.format_exc()}
        return encode(failure, {})


def read_exactly(source: int, view: memoryview) -> None:
    """Fill ``view``; EOFError where the pipe ends."""
    while len(view):
        count = os.readv(source, [view])
        if not count:
            raise EOFError("the parent closed the pipe")
        view = view[count:]


def write_all(sink: int, parts: list[memoryview]) -> None:
    """Write all parts."""
    for part in parts:
        while len(part):
            part = part[os.write(sink, part) :]


def end_with(parent: int) -> None:
    """End this process soon after its parent, even in the middle of a long call."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(WATCH_S)
        os._exit(3)

    threading.Thread(target=watch, daemon=True).start()


def main() -> None:
    """Run ``SCRIPT`` as a worker of ``PARENT`` over the pipes ``IN`` and ``OUT``."""
    global pipes
    script, source, sink, parent = sys.argv[1], *map(int, sys.argv[2:5])
    pipes = source, sink
    for descriptor in pipes:
        os.set_inheritable(descriptor, False)
    here = os.path.dirname(os.path.abspath(__file__))
    sys.path[:] = [path for path in sys.path if os.path.abspath(path or ".") != here]
    sys.modules["worker_side"] = sys.modules["__main__"]
    sys.argv = [script]
    end_with(parent)
    runpy.run_path(script, run_name="__main__")


if __name__ == "__main__":
    main()
