"""Pictures of a split, decoded and resized once: a file that is mapped, not read.

``pixels-HASH.npy`` is uint8 (frames of all episodes one after another, H, W, 3). Its name is the
hash of the split's videos and of the size, so that it serves every run on the same data. What is
read from it equals what decoding gives, bit for bit. Lenses of synthetic clips are undone.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from mint_hub.loaders.atomic import clear_left_over, replacing
from mint_hub.loaders.manifest import read_manifest
from mint_hub.loaders.packing import packed_images
from mint_hub.loaders.reader import CorpusReader
from mint_hub.synth.undo_lens import lens_of, undo_lens

__all__ = ["PixelCache", "filter_of", "resized"]

Images = NDArray[np.uint8]


def resized(images: Images, processor: Any, size_hw: tuple[int, int]) -> Images:
    """Resize as the model's processor does, (T, H, W, 3) -> (T, h, w, 3)."""
    from transformers.image_utils import SizeDict

    given = torch.from_numpy(np.ascontiguousarray(images)).permute(0, 3, 1, 2)
    size = SizeDict(height=size_hw[0], width=size_hw[1])
    video: Any = processor.video_processor
    made: torch.Tensor = video.resize(given, size, video.resample)
    return made.permute(0, 2, 3, 1).contiguous().numpy()


def filter_of(reader: CorpusReader, processor: Any) -> str:
    """Name how pictures of a split are made: how resized, and whether lenses are undone."""
    bent = any(lens_of(reader[i]) is not None for i in range(len(reader)))
    return f"resample {int(processor.video_processor.resample)}" + (", lens undone" if bent else "")


@dataclass(frozen=True)
class PixelCache:
    """The pictures of one packed split at one size.

    Attributes:
        folder: where the file lies.
        split: folder of the split, ``CORPUS/CONFIG/SPLIT``.
        size_hw: (h, w) of the pictures.
        filter: how they are made, by name (see `filter_of`): part of the file's name.

    """

    folder: Path
    split: Path
    size_hw: tuple[int, int]
    filter: str

    @cached_property
    def path(self) -> Path:
        """The file."""
        facts = [read_manifest(self.split).content, list(self.size_hw), self.filter]
        name = hashlib.sha256(json.dumps(facts).encode()).hexdigest()[:16]
        return self.folder / f"pixels-{name}.npy"

    def made(self) -> bool:
        """Whether it is there."""
        return self.path.is_file()

    def make(self, reader: CorpusReader, processor: Any) -> Iterator[int]:
        """Decode every episode in turn, yielding how many are done; whole at the end, or not made.

        Raises:
            VideoError: a clip that is damaged, missing, or of another length than its episode.
            ValueError: pictures of another size than their lens's.
            OSError: no room for the file.

        """
        clear_left_over(self.path)
        shape = (int(np.sum(reader.num_frames)), *self.size_hw, 3)
        with replacing(self.path) as temporary:
            file = np.lib.format.open_memmap(temporary, "w+", np.uint8, shape)
            _reserve(temporary)
            at = 0
            for i in range(len(reader)):
                images = undo_lens(packed_images(reader, i), reader[i])
                images = resized(images, processor, self.size_hw)
                file[at : at + len(images)] = images
                at += len(images)
                yield i + 1
            file.flush()

    @cached_property
    def _file(self) -> Images:
        return np.load(self.path, mmap_mode="r")

    @cached_property
    def _starts(self) -> NDArray[np.int64]:
        corpus, config = self.split.parent.parent, self.split.parent.name
        frames = CorpusReader(corpus, config, self.split.name).num_frames
        return np.concatenate([[0], np.cumsum(np.asarray(frames, np.int64))])

    def read(self, i: int, start: int, length: int) -> Images:
        """Copy frames (length, h, w, 3) of episode ``i``."""
        at = int(self._starts[i]) + start
        return np.array(self._file[at : at + length])

    def __getstate__(self) -> dict[str, Any]:
        names = ("folder", "split", "size_hw", "filter")
        return {name: getattr(self, name) for name in names}  # an open file stays behind


def _reserve(path: Path) -> None:
    """Take a sparse file's room now: writing a page without room would end the process, silently.

    Raises:
        OSError: there is not so much room.

    """
    size, free = path.stat().st_size, shutil.disk_usage(path.parent).free
    try:
        if free < size:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        if hasattr(os, "posix_fallocate"):
            with path.open("r+b") as file:
                os.posix_fallocate(file.fileno(), 0, size)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.EOPNOTSUPP):  # not every file system can
            raise OSError(error.errno, f"{error.strerror} for {size} bytes", str(path)) from None
