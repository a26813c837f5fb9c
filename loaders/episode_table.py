"""What a reader asks of ``episodes.parquet`` for all rows of a split: keys and checksums."""

from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray


class EpisodeTable:
    """Columns of the table of a split, each read when it is first asked for.

    Args:
        path: gives the file, whose size was checked; it is called once a column.
        check: compares the whole file by hash; CorpusError if it is not what was written.
        samples: of each shard, in order.

    """

    def __init__(
        self, path: Callable[[], Path], check: Callable[[], None], samples: list[int]
    ) -> None:
        self._path, self._check = path, check
        self._first_rows = np.cumsum([0, *samples]).tolist()

    def key(self, row: int) -> str:
        """Return the key of the episode in a row."""
        return str(self._keys[row])

    def first_key(self, shard: int) -> str:
        """Return the key of the first episode of a shard."""
        return self.key(self._first_rows[shard])

    def crc32(self, row: int) -> int:
        """Return what the bytes of the sample in a row hash to.

        Raises:
            CorpusError: the table is not the one that was written.

        """
        return int(self._crc32[row])

    @cached_property
    def _keys(self) -> Any:
        return self._column("key")

    @cached_property
    def _crc32(self) -> NDArray[np.uint32]:
        self._check()
        return self._column("crc32").to_numpy().astype(np.uint32)

    def _column(self, name: str) -> Any:
        from pyarrow import parquet

        with parquet.ParquetFile(self._path()) as file:
            return file.read([name])[name]
