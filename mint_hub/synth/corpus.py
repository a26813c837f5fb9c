"""Synthetic clips as shards like those of any other source, made ahead by several processes.

Labels are written ``lossless``: they are exact.
"""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Collection, Generator
from dataclasses import asdict, dataclass
from os import PathLike
from typing import Final

from mint_hub.loaders.parallel import in_order
from mint_hub.loaders.schema import Episode
from mint_hub.loaders.shards import CorpusReport, write_corpus
from mint_hub.synth.episodes import (
    Clip,
    check_pieces,
    check_samples,
    check_scale,
    make_clip,
    make_pieces,
    piece_key,
)
from mint_hub.synth.gl import make_context
from mint_hub.synth.lensing import require_share
from mint_hub.synth.presets import GENERATOR, REVISION, key_of, preset_named, seed_of
from mint_hub.synth.render import SAMPLES

__all__ = ["synthesise"]

SHARD_BYTES: Final = 8 << 20
"""A handful of clips: what an interrupted run makes again is less than a shard."""


def synthesise(
    folder: str | PathLike[str],
    preset: str = "train",
    episodes: int | None = None,
    seed: int = 0,
    *,
    config: str | None = None,
    split: str | None = None,
    num_frames: int | None = None,
    pieces: int = 0,
    scale: float = 1.0,
    samples: int = SAMPLES,
    lens: float = 0.0,
    depth: bool = False,
    segmentation: bool = False,
    num_procs: int = 1,
    progress: bool = False,
) -> CorpusReport:
    """Write a split of synthetic clips, ``folder/config/split``; called again, it goes on.

    Going on, it keeps the shards that were finished, and makes no clip of these again.

    Args:
        folder: of the corpus.
        preset: one of ``presets.PRESETS``.
        episodes: how many worlds; by default all of a bench, and it must be said for train.
        seed: of the run; a bench's clips are the same for every seed.
        config: name of the config; ``synth-<preset>`` without it.
        split: "train" for train, "validation" for the benches without it.
        num_frames: of every clip; drawn per clip without it.
        pieces: instead of a whole clip, so many pieces of ``num_frames`` of each world, see
            `make_pieces`; 0: whole clips.
        scale: factor on the size of the pictures, height and width.
        samples: a pixel: 0, 2 or 4; see `make_clip`.
        lens: share of clips whose pictures are bent by a lens; 0 for benches.
        depth: also store depth.
        segmentation: also store segments.
        num_procs: processes that make clips.
        progress: show a bar.

    Raises:
        ImportError, RuntimeError: as ``make_clip`` does.
        CorpusError: as ``write_corpus`` does; an unfinished split was begun with other arguments.
        ValueError: an unknown preset, a number of episodes that it does not have, a bad scale
            or share of lenses.

    """
    kind = preset_named(preset)
    count = kind.clips if episodes is None else episodes
    if count is None or count < 1:
        raise ValueError(f"episodes: expected at least 1 for {preset}, got {episodes}")
    seeds = [seed_of(preset, seed, n) for n in range(count)]
    if num_frames is not None and num_frames < 1:
        raise ValueError(f"num_frames: expected at least 1, got {num_frames}")
    if pieces:
        check_pieces(pieces, num_frames, preset)
    maker = _Maker(
        preset,
        num_frames,
        pieces,
        check_scale(scale),
        check_samples(samples),
        require_share(lens, preset),
        depth,
        segmentation,
    )
    make_context().release()  # say what is missing before a world or a folder is made
    clips = _Clips(maker, seeds, num_procs)
    try:
        return write_corpus(
            clips,
            folder,
            config or f"synth-{preset}",
            split or ("train" if kind.clips is None else "validation"),
            format="lossless",
            extra=True,
            shard_bytes=SHARD_BYTES,
            seed=None,
            progress=progress,
            extra_members=clips.members_of,
            made_with={
                **{name: value for name, value in asdict(maker).items() if name != "pieces"},
                **({"pieces": pieces} if pieces else {}),
                **({"seed": seed} if kind.clips is None else {}),
                "generator": GENERATOR,
                "revision": REVISION,
            },
        )
    finally:
        clips.close()


@dataclass(frozen=True)
class _Maker:
    """Makes the clips of a seed; travels to other processes."""

    preset: str
    num_frames: int | None
    pieces: int
    scale: float
    samples: int
    lens: float
    depth: bool
    segmentation: bool

    def __call__(self, seed: int) -> list[Clip]:
        if multiprocessing.parent_process() is not None:
            # One of several: Mesa draws on this process's own core, without threads beside it.
            os.environ.setdefault("LP_NUM_THREADS", "0")
        asked = asdict(self)
        if asked["pieces"]:
            return make_pieces(seed, **asked)
        del asked["pieces"]
        return [make_clip(seed, **asked)]

    def keys(self, seed: int) -> list[str]:
        """Keys of its clips."""
        key = key_of(self.preset, seed)
        return [piece_key(key, n) for n in range(self.pieces)] or [key]


class _Clips:
    """Clips by number, in a row from the first that is asked for; other processes make them ahead.

    Their keys are known before they are made.
    """

    def __init__(self, maker: _Maker, seeds: Collection[int], num_procs: int) -> None:
        self._maker, self._seeds, self._num_procs = maker, list(seeds), num_procs
        self._keys = [key for seed in self._seeds for key in maker.keys(seed)]
        self._making: Generator[list[Clip]] | None = None
        self._ready: list[Clip] = []
        self._next = -1
        self._members: dict[str, dict[str, bytes]] = {}

    def __len__(self) -> int:
        return len(self._keys)

    def __getitem__(self, i: int, /) -> Episode:
        if self._making is None or i != self._next:
            self.close()
            number, skipped = divmod(i, len(self._keys) // len(self._seeds))
            seeds = self._seeds[number:]
            self._making = in_order(self._maker, seeds, self._num_procs, 1, start="spawn")
            self._ready = next(self._making)[skipped:]
        elif not self._ready:
            self._ready = next(self._making)
        clip = self._ready.pop(0)
        assert clip.episode.key == self.key(i)
        self._next = i + 1
        self._members = {clip.episode.key: clip.members}
        return clip.episode

    def key(self, i: int, /) -> str:
        return self._keys[i]

    def members_of(self, episode: Episode) -> dict[str, bytes]:
        return self._members[episode.key]

    def close(self) -> None:
        if self._making is not None:
            self._making.close()
            self._making = None
