"""Memory maps of the shards of a split, opened when needed and kept within the limit of files."""

import sys
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mint_hub.loaders.manifest import Manifest
from mint_hub.loaders.remote import SplitFiles
from mint_hub.loaders.tar_layout import CorpusError, map_file


class ShardMaps:
    """The bytes of each shard as a memoryview, mapped at first use.

    A map holds a file open, so only as many stay as half of the process may open; the oldest go
    first, and views that are still in use keep theirs. Nothing open is pickled.
    """

    def __init__(self, files: SplitFiles, manifest: Manifest) -> None:
        self._files, self._shards = files, manifest.shards
        self._limit = _file_limit() // 2
        self._open: dict[int, memoryview] = {}
        self._seen: set[int] = set()

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_open": {}}

    def name(self, shard: int) -> str:
        """Return the file name of a shard."""
        return self._shards[shard].name

    def is_new(self, shard: int) -> bool:
        """Whether a shard was never viewed, or was dropped."""
        return shard not in self._seen

    def drop(self, shard: int) -> None:
        """Forget a shard that is not what it should be."""
        self._open.pop(shard, None)
        self._seen.discard(shard)

    def view(self, shard: int) -> memoryview:
        """Return the bytes of a shard.

        Raises:
            CorpusError: it is missing or has another size than it was written with.

        """
        if (view := self._open.get(shard)) is None:
            view = self._map(shard)
            self._trim()
        return view

    def views(self, shards: NDArray[np.uint32]) -> list[memoryview]:
        """Return one view for each of ``shards``, (B,)."""
        numbers = shards.tolist()
        opened = self._open
        if missing := [n for n in set(numbers) if n not in opened]:
            for number in missing:
                self._map(number)
            views = [opened[number] for number in numbers]
            self._trim()
            return views
        return [opened[number] for number in numbers]

    def _map(self, shard: int) -> memoryview:
        record = self._shards[shard]
        path = self._files.path(record)
        view = memoryview(map_file(path))
        if len(view) != record.bytes:
            raise CorpusError(f"{path}: expected {record.bytes} bytes, got {len(view)}")
        self._open[shard] = view
        self._seen.add(shard)
        return view

    def _trim(self) -> None:
        surplus = len(self._open) - self._limit
        for number in list(self._open)[: max(surplus, 0)]:
            del self._open[number]


def _file_limit() -> int:
    if sys.platform == "win32":
        return 512
    import resource

    soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    return 1 << 20 if soft == resource.RLIM_INFINITY else soft
