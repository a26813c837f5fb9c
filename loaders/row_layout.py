"""Where the numbers of every episode lie in the shards, and windows of them side by side.

The writer pads every member to whole blocks, and npy headers are of one length, so the index alone
says where each array begins: nothing in a shard is parsed to find a row.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from mint_hub.loaders.manifest import Manifest
from mint_hub.loaders.members import EXTRA, META, member, member_names
from mint_hub.loaders.tar_layout import BLOCK

NPY_HEADER: Final = 128
"""Bytes before the numbers of every npy member that the writer makes."""


class MemberRows(NamedTuple):
    """One npy member of every episode; ``at`` (N,) is where its numbers begin in its shard."""

    name: str
    dtype: np.dtype[Any]
    descr: str
    width: int
    row_bytes: int
    at: NDArray[np.int64]

    def view(self, shard: memoryview, i: int, num_frames: int) -> NDArray[Any]:
        """Return the rows of episode i, (num_frames, width), without a copy."""
        flat = np.frombuffer(shard, self.dtype, num_frames * self.width, int(self.at[i]))
        return flat.reshape(num_frames, self.width)

    def is_there(self, shard: memoryview, i: int, num_frames: int) -> bool:
        """Whether the shard has a member of exactly this type and shape at this place."""
        begin = int(self.at[i])
        head = npy_header(self.descr, num_frames, self.width)
        stop = begin + num_frames * self.row_bytes
        return stop <= len(shard) and bytes(shard[begin - NPY_HEADER : begin]) == head

    def gather(
        self,
        shards: Sequence[memoryview],
        index: NDArray[np.int64],
        start: NDArray[np.int64],
        length: int,
    ) -> NDArray[Any]:
        """Return (B, length, width): of episode index[k], in shards[k], the rows from start[k]."""
        begin = self.at[index] + start * self.row_bytes
        stops = (begin + length * self.row_bytes).tolist()
        places = zip(shards, begin.tolist(), stops, strict=True)
        joined = bytearray().join([shard[first:stop] for shard, first, stop in places])
        return np.ndarray((len(index), length, self.width), self.dtype, joined)


@dataclass(frozen=True)
class Windows:
    """Windows of one length, one after another in memory: B windows of L frames, C columns.

    Attributes:
        index: (B,) which episode of the reader each window is from.
        start: (B,) its first frame there.
        arrays: (B, L, C) by member name, numpy arrays or torch tensors, writable.

    """

    index: Any
    start: Any
    arrays: dict[str, Any]

    def __len__(self) -> int:
        return len(self.index)

    def column(self, name: str) -> Any:
        """Return one column of any member, such as "left_wrist", as a view: (B, L, width).

        Raises:
            KeyError: no member here has such a column.

        """
        for member_name, array in self.arrays.items():
            if name in (slices := member(member_name).slices):
                return array[..., slices[name]]
        raise KeyError(name)

    def torch(self) -> "Windows":
        """Return the same memory as torch tensors."""
        import torch

        arrays = {name: torch.from_numpy(array) for name, array in self.arrays.items()}
        return Windows(torch.from_numpy(self.index), torch.from_numpy(self.start), arrays)


def row_layout(rows: NDArray[np.void], manifest: Manifest) -> list[MemberRows]:
    """Return where every npy member of the given index rows lies, in the order of the archive."""
    num_frames = rows["num_frames"].astype(np.int64)
    at = rows["offset"].astype(np.int64) + rows["arrays"].astype(np.int64) + BLOCK + NPY_HEADER
    layout: list[MemberRows] = []
    extra = EXTRA in manifest.members
    for name in member_names(manifest.format, extra):  # pyright: ignore[reportArgumentType]
        if name == META:
            continue
        spec = member(name)
        dtype = np.dtype(spec.dtype).newbyteorder("<")
        row_bytes = spec.width * dtype.itemsize
        layout.append(MemberRows(name, dtype, dtype.str, spec.width, row_bytes, at))
        size = NPY_HEADER + num_frames * row_bytes
        at = at + -(-size // BLOCK) * BLOCK + BLOCK
    return layout


@lru_cache(maxsize=65536)
def npy_header(descr: str, num_frames: int, width: int) -> bytes:
    """Return what stands before the numbers of a (num_frames, width) npy file, 128 bytes.

    >>> npy_header("<f4", 5, 17)[10:70].decode()
    "{'descr': '<f4', 'fortran_order': False, 'shape': (5, 17), }"
    """
    shape = f"({num_frames}, {width})"
    text = f"{{'descr': '{descr}', 'fortran_order': False, 'shape': {shape}, }}"
    size = NPY_HEADER - 10
    head = np.lib.format.magic(1, 0) + size.to_bytes(2, "little")
    return head + text.encode().ljust(size - 1) + b"\n"
