"""Where video comes from: paths, URLs, bytes and file objects, opened or refused by name."""

import io
import tempfile
import urllib.request
from collections.abc import Mapping
from contextlib import ExitStack
from os import PathLike, fspath
from pathlib import Path
from typing import Any, BinaryIO, cast

import av
import fsspec
from av.container import InputContainer
from av.error import FFmpegError

VideoSource = str | PathLike[str] | bytes | bytearray | memoryview | BinaryIO | Mapping[str, Any]
"""Path, URL (http, https, hf, and what fsspec knows), encoded bytes, seekable binary file object,
or the {"path": ..., "bytes": ...} of an undecoded column of a dataset."""

_SPOOL_BYTES = 2**26
_TIMEOUT_S = 60.0
_MP4_BOXES = (b"ftyp", b"mdat", b"moov", b"wide", b"free")
_NOT_VIDEO_FORMATS = frozenset({"tty"})  # ffmpeg would render a text file as a terminal


class VideoError(ValueError):
    """A video that cannot be read; the message names the source and the place."""


class VideoNotFoundError(VideoError, FileNotFoundError):
    """There is nothing at this path or URL."""

    def __str__(self) -> str:
        return str(self.args[0])


def open_video(source: VideoSource, closing: ExitStack) -> tuple[str, InputContainer]:
    """Open any source.

    Returns:
        Its name, for errors, and its container. What is opened here is closed by ``closing``.

    Raises:
        VideoError: nothing there, a folder, text, not a video, a file object that cannot seek.

    """
    known_name = None
    if isinstance(source, Mapping):
        known_name = source.get("path")
        source = _undecoded(source)
    if isinstance(source, bytes | bytearray | memoryview):
        name = known_name or f"<{len(source)} bytes>"
        file = cast("BinaryIO", io.BytesIO(source))
    elif isinstance(source, str) and "://" in source:
        name, file = source, _open_url(source, closing)
    elif isinstance(source, str | PathLike):
        name, file = fspath(source), _existing_file(Path(source))
    else:
        name, file = _check_file_object(source), cast("BinaryIO", source)
    try:
        # The prefix keeps ffmpeg from reading "a:b.mp4" as a protocol.
        container = av.open(f"file:{file}" if isinstance(file, Path) else file, "r")
    except (FFmpegError, OSError) as error:
        raise VideoError(f"{name}: {_why_not_open(file)} ({reason(error)})") from error
    closing.enter_context(container)
    if container.format.name in _NOT_VIDEO_FORMATS:
        raise VideoError(f"{name}: not a video, but text")
    return name, container


def _why_not_open(file: Path | BinaryIO) -> str:
    """Tell an mp4 that lost its end, and with it the index, from what is no video at all."""
    if isinstance(file, Path):
        with file.open("rb") as opened:
            return _why_not_open(opened)
    file.seek(0)
    head = file.read(8)
    if not head:
        return "not a video, but empty"
    if head[4:] in _MP4_BOXES:
        return "cut short: an mp4 without its index, which stands at the end"
    return "not a video"


def _existing_file(path: Path) -> Path:
    if not path.exists():
        raise VideoNotFoundError(f"{path}: no such file")
    if path.is_dir():
        raise VideoError(f"{path}: a folder, expected a video file")
    return path


def _undecoded(column: Mapping[str, Any]) -> VideoSource:
    source = column.get("bytes") or column.get("path")
    if source is None:
        raise VideoError(f"expected a mapping with 'bytes' or 'path', got keys {sorted(column)}")
    return cast("VideoSource", source)


def _check_file_object(file: Any) -> str:
    if not callable(getattr(file, "read", None)):
        raise VideoError(
            f"{type(file).__name__}: expected a path, a URL, bytes or a binary file object"
        )
    name = getattr(file, "name", None)
    name = name if isinstance(name, str) else f"<{type(file).__name__}>"
    if isinstance(file, io.TextIOBase):
        raise VideoError(f"{name}: a file opened as text; open it with mode 'rb'")
    if not callable(getattr(file, "seekable", None)) or not file.seekable():
        raise VideoError(f"{name}: a file object that cannot seek; give its bytes instead")
    file.seek(0)
    return name


def _open_url(url: str, closing: ExitStack) -> BinaryIO:
    """Fetch http and https to a temporary file, the rest through fsspec, which reads as it goes."""
    try:
        if not url.startswith(("http://", "https://")):
            return cast("BinaryIO", closing.enter_context(fsspec.open(url, "rb")))
        copy = closing.enter_context(
            tempfile.SpooledTemporaryFile(_SPOOL_BYTES)  # noqa: SIM115 (the stack closes it)
        )
        with urllib.request.urlopen(url, timeout=_TIMEOUT_S) as response:
            while chunk := response.read(2**20):
                copy.write(chunk)
        copy.seek(0)
        return cast("BinaryIO", copy)
    except Exception as error:  # fsspec's back ends raise their clients' own classes
        if isinstance(error, FileNotFoundError) or getattr(error, "code", None) in (404, 410):
            raise VideoNotFoundError(f"{url}: nothing there") from error
        raise VideoError(f"{url}: cannot be fetched: {error}") from error


def reason(error: Exception) -> str:
    """Say what went wrong without numbers: what ffmpeg says, and what it logged last."""
    if not isinstance(error, FFmpegError):
        return str(error)
    strerror, log = error.strerror, cast("tuple[int, str, str] | None", error.log)
    return f"{strerror} ({log[2].strip()})" if log else str(strerror)
