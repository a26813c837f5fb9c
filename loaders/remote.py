"""Files of one split, wherever they lie: a folder, or an address that fsspec opens.

``shards.json`` says of every other file how long it is and what its sha256 is, so a remote file is
fetched once and kept under its hash: whatever the address, equal content is one file of the cache,
and content that is not what was written never enters it.
"""

import errno
import hashlib
import os
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final, Protocol

from mint_hub.loaders.atomic import replacing
from mint_hub.loaders.manifest import MANIFEST, FileRecord, Manifest, read_manifest, unseal
from mint_hub.loaders.tar_layout import CorpusError

_OUR_DISK: Final = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EACCES, errno.EROFS, errno.EPERM})


class SplitFiles(Protocol):
    """The files of a split as local paths."""

    @property
    def address(self) -> str:
        """The split's folder, for messages."""
        ...

    def manifest(self) -> Manifest:
        """Return what ``shards.json`` says; CorpusError where it is missing or damaged."""
        ...

    def path(self, record: FileRecord) -> Path:
        """Return where a file can be read; CorpusError where it is missing or has another size."""
        ...

    def check(self, record: FileRecord, full: bool) -> None:
        """Raise CorpusError unless the file is there, with its size or (``full``) its sha256."""
        ...


def split_files(
    location: str | os.PathLike[str],
    config: str,
    split: str,
    *,
    cache_dir: str | os.PathLike[str] | None = None,
    storage_options: dict[str, Any] | None = None,
) -> SplitFiles:
    """Find the files of a split of a corpus.

    Args:
        location: the corpus: a folder, or an address such as ``hf://datasets/org/name``.
        config: name of the config.
        split: name of the split.
        cache_dir: where remote files are kept; default ``default_cache()``.
        storage_options: what fsspec passes to the file system of an address.

    """
    place = os.fspath(location)
    if "://" not in place:
        return LocalFiles(Path(place) / config / split)
    url = f"{place.rstrip('/')}/{config}/{split}"
    return RemoteFiles(url, Path(cache_dir or default_cache()), storage_options)


def default_cache() -> Path:
    """Return where remote files are kept by default, within the user's cache folder."""
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "mint-hub" / "corpus"


class LocalFiles:
    """A split in a folder."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    @property
    def address(self) -> str:
        """The folder."""
        return str(self._folder)

    def manifest(self) -> Manifest:
        """Read ``shards.json``."""
        return read_manifest(self._folder)

    def path(self, record: FileRecord) -> Path:
        """Return where the file is, once its size is seen to be right."""
        path = self._folder / record.name
        try:
            size = path.stat().st_size
        except FileNotFoundError:
            raise CorpusError(f"{path}: expected this file{_lost(record)}, got none") from None
        if size != record.bytes:
            raise CorpusError(f"{path}: expected {record.bytes} bytes{_lost(record)}, got {size}")
        return path

    def check(self, record: FileRecord, full: bool) -> None:
        """Compare size, or size and sha256."""
        path = self.path(record)
        if full and (got := _sha256(path)) != record.sha256:
            raise _changed(str(path), record, got)


class RemoteFiles:
    """A split at an address of fsspec, kept in a local cache by content hash.

    Args:
        url: folder of the split.
        cache_dir: folder of the cache; files in it are named by their sha256.
        storage_options: what fsspec passes to the file system.

    """

    def __init__(
        self, url: str, cache_dir: Path, storage_options: dict[str, Any] | None = None
    ) -> None:
        self._url, self._cache, self._options = url, cache_dir, storage_options or {}

    @property
    def address(self) -> str:
        """The folder's address."""
        return self._url

    def manifest(self) -> Manifest:
        """Fetch ``shards.json``; it is never cached, since nothing says what it must be."""
        where = f"{self._url}/{MANIFEST}"
        with self._away(MANIFEST) as (filesystem, path):
            data: bytes = filesystem.cat_file(path)
        return Manifest.from_dict(unseal(data, where), where)

    def path(self, record: FileRecord) -> Path:
        """Return the file in the cache, after fetching it where it is not there yet.

        Raises:
            CorpusError: the address has no such file, breaks off, or has other bytes than were
                written. Nothing of it stays in the cache.
            ImportError: fsspec needs a package for this kind of address; names it.
            OSError: the cache cannot be written.

        """
        path = self._cache / record.sha256[:2] / record.sha256
        if path.is_file() and path.stat().st_size == record.bytes:
            return path
        with replacing(path) as temporary:
            with self._away(record.name, record) as (filesystem, remote):
                filesystem.get_file(remote, str(temporary))
            if (got := temporary.stat().st_size) != record.bytes:
                where = f"{self._url}/{record.name}"
                raise CorpusError(
                    f"{where}: expected {record.bytes} bytes{_lost(record)}, got {got}"
                )
            if (digest := _sha256(temporary)) != record.sha256:
                raise _changed(f"{self._url}/{record.name}", record, digest)
        return path

    def check(self, record: FileRecord, full: bool) -> None:
        """With ``full``, fetch the file and compare; else nothing: fetching will compare anyway."""
        if not full:
            return
        path = self.path(record)
        if _sha256(path) != record.sha256:  # the cache was damaged after it was filled
            path.unlink()
            self.path(record)

    @contextmanager
    def _away(self, name: str, record: FileRecord | None = None) -> Generator[tuple[Any, str]]:
        """Give file system and path of a file there; whatever goes wrong there names the file."""
        from fsspec.core import url_to_fs

        url = f"{self._url}/{name}"
        filesystem, path = url_to_fs(url, **self._options)
        try:
            yield filesystem, path
        except FileNotFoundError:
            raise CorpusError(f"{url}: expected this file{_lost(record)}, got none") from None
        except Exception as error:  # of any file system's own kind
            if isinstance(error, OSError) and error.errno in _OUR_DISK:
                raise
            raise CorpusError(
                f"{url}: expected this file{_lost(record)}, got none as fetching it failed: "
                f"{type(error).__name__}: {error}"
            ) from error


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _changed(place: str, record: FileRecord, got: str) -> CorpusError:
    return CorpusError(
        f"{place}: expected sha256 {record.sha256[:12]}...{_lost(record)}, got {got[:12]}...: "
        "other bytes than were written"
    )


def _lost(record: FileRecord | None) -> str:
    samples = getattr(record, "samples", None)
    return "" if samples is None else f" ({samples} episodes)"
