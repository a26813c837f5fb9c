"""Benchmarks of our own format: a corpus folder, packed or not; the synthetic benches; labels."""

from dataclasses import replace
from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from mint_hub.evaluation.clips import (
    Benchmark,
    BenchmarkError,
    Clip,
    MissingFilesError,
    PackedFrames,
    Source,
    knows_hands,
    truth_model,
)
from mint_hub.loaders.derived import VIDEO_MEMBER
from mint_hub.loaders.manifest import MANIFEST
from mint_hub.loaders.reader import CorpusReader
from mint_hub.loaders.schema import Episode


class ShardsBenchmark(Benchmark):
    """The episodes of one split as clips; pictures are those packed beside the labels."""

    def __init__(self, source: Source, title: str | None = None) -> None:
        config, split = _choice(Path(source.root), source.config, source.split)
        self.source = replace(source, config=config, split=split)  # results say which
        self.reader = CorpusReader(source.root, config, split)
        self._packed = VIDEO_MEMBER in self.reader.manifest.members
        self.title = title or f"{config}/{split}"
        if not len(self.reader):
            raise BenchmarkError(f"{source.root}: {config}/{split}: expected episodes, found none")

    def __len__(self) -> int:
        return len(self.reader)

    def num_frames(self, i: int) -> int:
        """Return the length of clip ``i``, from the index."""
        return int(self.reader.num_frames[i])

    def clip(self, i: int) -> Clip:
        """Read clip ``i``."""
        episode, frames = self.reader[i], None
        if self._packed:
            frames = PackedFrames(bytes(self.reader.member(i, VIDEO_MEMBER)), episode)
        why = "" if frames else f"{self.title} has no packed video: see `mint-hub pack`"
        return clip_of(episode, frames, self.source.mano_dir, why)


class LabelsBenchmark(Benchmark):
    """Saved episodes (.npz) as truth: what other labels of the same clips are compared with."""

    def __init__(self, source: Source) -> None:
        self.source = source
        self.title = f"labels in {Path(source.root).name}"
        self._files = sorted(label_files(Path(source.root)).items())

    def __len__(self) -> int:
        return len(self._files)

    def num_frames(self, i: int) -> int:
        """Return the length of clip ``i``, from its presence alone."""
        path = self._files[i][1]
        try:
            with np.load(path) as file:
                return len(file["presence"])
        except (OSError, KeyError, TypeError, ValueError, BadZipFile):
            return super().num_frames(i)  # says what is wrong with it

    def clip(self, i: int) -> Clip:
        """Read clip ``i``."""
        episode = Episode.load(self._files[i][1])
        return clip_of(episode, None, self.source.mano_dir, "labels come without video")


def synthetic_benchmark(source: Source, num_procs: int = 1) -> ShardsBenchmark:
    """Open bench or bench-ood; its clips are drawn once and kept in ``source.root``.

    Raises:
        ImportError, RuntimeError: the renderer is missing; the message says what to install.
        BenchmarkError: other clips lie there than were frozen.

    """
    from mint_hub.synth.corpus import synthesise
    from mint_hub.synth.frozen import require_frozen
    from mint_hub.synth.presets import GENERATOR, REVISION, preset_named

    generator = f"generator-{GENERATOR}.{REVISION}"
    folder = Path(source.root) / generator
    config = f"synth-{source.name}"
    if not (folder / config / "validation" / MANIFEST).is_file():
        synthesise(folder, source.name, num_procs=num_procs, progress=True)
    opened = replace(source, root=str(folder), config=config, split="validation")
    title = f"mint-hub {source.name}, generator {GENERATOR}.{REVISION}"
    benchmark = ShardsBenchmark(opened, title=title)
    expected = preset_named(source.name).clips
    if len(benchmark) != expected:
        raise BenchmarkError(
            f"{folder / config}: expected the {expected} clips of {source.name}, got "
            f"{len(benchmark)}: remove the folder to have them drawn again"
        )
    try:
        for i in range(len(benchmark)):
            require_frozen(source.name, i, benchmark.reader[i])
    except ValueError as error:
        raise BenchmarkError(
            f"{folder / config}: {error}: remove the folder to have them drawn again"
        ) from error
    benchmark.source = source
    benchmark.notes = ("synthetic clips: exact truth, drawn pictures",)
    return benchmark


def clip_of(
    episode: Episode, frames: PackedFrames | None, mano_dir: str | None, why: str = ""
) -> Clip:
    """Make the clip of an episode, scored in its own camera: one K, or a K a frame if it zooms."""
    zooms = bool(np.ptp(episode.fov_vh_rad, axis=0).any())
    return Clip(
        key=episode.key,
        truth=episode,
        K=episode.K if zooms else episode.K[0],
        image_size_hw=episode.image_size_hw,
        frames=frames,
        hand_model=truth_model(episode, mano_dir),
        source=str(episode.meta.get("source", "unknown")),
        visible=_visible(episode),
        hands=knows_hands(episode),
        without_frames=why,
    )


def label_files(folder: Path) -> dict[str, Path]:
    """Saved episodes below a folder by key: ``KEY.npz``, or ``KEY/episode.npz`` of predict.

    Raises:
        MissingFilesError: there is no such folder, or no episode in it.
        BenchmarkError: two files of one key; names both.

    """
    if not folder.is_dir():
        raise MissingFilesError(
            f"{folder}: expected a folder with episodes (.npz), found no folder"
        )
    found: dict[str, Path] = {}
    for path in sorted(folder.rglob("*.npz")):
        if any(part.startswith(".") for part in path.relative_to(folder).parts):
            continue
        key = path.parent.name if path.stem == "episode" else path.stem
        if key in found:
            raise BenchmarkError(
                f"{folder}: expected one file of each episode, got two of {key}: {found[key]} and "
                f"{path}"
            )
        found[key] = path
    if not found:
        raise MissingFilesError(f"{folder}: expected episodes (KEY.npz, KEY/episode.npz), got none")
    return found


def is_corpus(folder: Path) -> bool:
    """Whether a folder is a corpus: a config with a split that has shards."""
    return any(folder.glob(f"*/*/{MANIFEST}"))


def _choice(folder: Path, config: str | None, split: str | None) -> tuple[str, str]:
    if not folder.is_dir():
        raise MissingFilesError(f"{folder}: expected a corpus folder, found no folder")
    there = sorted((p.parent.parent.name, p.parent.name) for p in folder.glob(f"*/*/{MANIFEST}"))
    if not there:
        raise MissingFilesError(
            f"{folder}: expected a corpus (CONFIG/SPLIT/{MANIFEST}), found none; "
            "`mint-hub convert` and `mint-hub pack` write one"
        )
    configs = sorted({c for c, _ in there})
    if config is None and len(configs) > 1:
        raise BenchmarkError(f"{folder}: --config: expected one of {configs}, got none")
    config = config or configs[0]
    splits = [s for c, s in there if c == config]
    if not splits:
        raise BenchmarkError(f"{folder}: --config: expected one of {configs}, got {config!r}")
    split = split or ("validation" if "validation" in splits else splits[0])
    if split not in splits:
        raise BenchmarkError(f"{folder}/{config}: --split: expected one of {splits}, got {split!r}")
    return config, split


def _visible(episode: Episode) -> np.ndarray | None:
    """Visible share of the hands of a synthetic clip, which is what its presence scores are."""
    return episode.presence_score if isinstance(episode.meta.get("synth"), dict) else None
