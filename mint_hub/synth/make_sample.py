"""Make the embedded clips and their truth: ``python -m mint_hub.synth.make_sample``.

Three synthetic clips of the preset ``train`` become the config "sample" of mint-ego,
``assets/sample_corpus``: pictures beside exact labels, like `mint-hub synth` writes them. The first
is also the clip that commands take for want of another, ``assets/sample.mp4``, with its truth in
``sample.npz``. Their seeds are reserved: no other run makes these clips.

The same machine gives the same bytes; another driver or FFmpeg may round otherwise.
"""

from __future__ import annotations

import argparse
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from mint_hub.assets import asset_path
from mint_hub.loaders.card import write_card
from mint_hub.loaders.location import SAMPLE
from mint_hub.loaders.shards import CorpusReport, write_corpus
from mint_hub.synth.corruption import Corruption
from mint_hub.synth.episodes import MP4, Clip, make_clip
from mint_hub.synth.presets import RESERVED_SEEDS

NUM_FRAMES: Final = 120
CAMERA: Final = Corruption(
    shutter=0.15,
    exposure_drift=0.04,
    white_drift=0.02,
    vignette=0.12,
    blur_px=0.3,
    shot_noise=0.007,
    read_noise=0.002,
    crf=21,
)
"""Better than most of those that `mint-hub synth` draws: these clips are looked at."""


@dataclass(frozen=True)
class Chosen:
    """A clip that was picked, by eye, from contact sheets of the reserved seeds.

    Attributes:
        key: of its episode.
        number: of its seed among the reserved ones.
        scale: factor on the size of its pictures.

    """

    key: str
    number: int
    scale: float


CHOSEN: Final = (
    Chosen("sample", 109, 0.75),
    Chosen("sample-2", 12, 0.6),
    Chosen("sample-3", 17, 0.75),
)
"""Jar, block and bottle, in a wide view; close up, with a lively head; a parcel, turns of the head,
and a hand that leaves the picture."""


def sample_clips() -> Iterator[Clip]:
    """Draw the clips, the one of ``sample.mp4`` first.

    Raises:
        ImportError: moderngl is not installed.
        RuntimeError: EGL is missing. Both say what to install.

    """
    for chosen in CHOSEN:
        seed = RESERVED_SEEDS + chosen.number
        clip = make_clip(seed, "train", NUM_FRAMES, scale=chosen.scale, corruption=CAMERA)
        meta = {
            **clip.episode.meta,
            "source": "mint-hub sample",
            "uid": chosen.key,
            "provenance": {"made_by": "python -m mint_hub.synth.make_sample"},
        }
        yield Clip(replace(clip.episode, key=chosen.key, meta=meta), clip.members)


def write_sample(folder: Path) -> CorpusReport:
    """Write ``sample.mp4``, ``sample.npz`` and ``sample_corpus`` into a folder, over older ones.

    A text that people wrote in the corpus's card stays, as ``write_card`` has it.
    """
    clips = {clip.episode.key: clip for clip in sample_clips()}
    first = clips[CHOSEN[0].key]
    (folder / "sample.mp4").write_bytes(first.members[MP4])
    first.episode.save(folder / "sample.npz")
    corpus = folder / "sample_corpus"
    shutil.rmtree(corpus / SAMPLE, ignore_errors=True)
    report = write_corpus(
        [clip.episode for clip in clips.values()],
        corpus,
        SAMPLE,
        "train",
        format="lossless",
        extra=True,
        seed=None,
        extra_members=lambda episode: clips[episode.key].members,
    )
    write_card(corpus, SAMPLE)
    return report


def main() -> None:
    """Write them beside this package's other assets, or into ``--out``."""
    parser = argparse.ArgumentParser(description="Make the embedded clips and their truth.")
    parser.add_argument("--out", type=Path, default=asset_path("sample.mp4").parent)
    folder: Path = parser.parse_args().out
    folder.mkdir(parents=True, exist_ok=True)
    write_sample(folder)


if __name__ == "__main__":
    main()
