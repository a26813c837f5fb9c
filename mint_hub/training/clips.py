"""What there is to train on: the splits of corpora, surveyed once, without evaluation clips.

A survey reads every episode of a split once: whether it may be trained on, how many frames it has,
to which stratum it belongs, and the sums behind the scales of camera losses. It is kept by the hash
of the split's content and of everything it depends on, so that it is made once.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from functools import cached_property
from pathlib import Path
from typing import Any, Final

from mint_hub.evaluation.clips import knows_hands
from mint_hub.loaders.atomic import replacing
from mint_hub.loaders.derived import VIDEO_MEMBER
from mint_hub.loaders.manifest import MANIFEST, read_manifest, split_folders
from mint_hub.loaders.reader import CorpusReader
from mint_hub.loaders.schema import Episode
from mint_hub.synth.presets import is_bench
from mint_hub.synth.teacher_noise import TeacherNoise, teacher_noise
from mint_hub.training.normalisation import CameraSums

__all__ = ["ClipRow", "DataError", "Split", "Survey", "evaluation_clip", "find_splits"]

SURVEY_VERSION: Final = 1

RECENT: Final = 512
"""Episodes of a split that stay in memory: about 0.2 MB for 200 frames."""

EVALUATION_SETS: Final = ("hot3d", "arctic")


class DataError(ValueError):
    """Data that cannot be trained on: the message names the folder and what to do."""


def evaluation_clip(episode: Episode) -> str | None:
    """Name what an episode is a clip of, where that is kept for evaluation; else None.

    Synthetic benches are known by their frozen fingerprints, HOT3D and ARCTIC by source and uid.
    """
    if is_bench(episode):
        return "a synthetic bench"
    for name in EVALUATION_SETS:
        words = (str(episode.meta.get(k) or "").lower() for k in ("source", "uid"))
        if any(name in word for word in words):
            return name.upper()
    return None


@dataclass(frozen=True)
class ClipRow:
    """What a survey keeps of an episode.

    Attributes:
        key, source, domain, participant, shape_space: as the episode says; "" where it does not.
        num_frames: T.
        hands_known: whether its record has hands at all.
        kept_for: the evaluation set it belongs to, or None.

    """

    key: str
    source: str
    domain: str
    participant: str
    shape_space: str
    num_frames: int
    hands_known: bool
    kept_for: str | None

    @property
    def stratum(self) -> tuple[str, str, str]:
        """(source, domain, participant)."""
        return self.source, self.domain, self.participant


@dataclass(frozen=True)
class Survey:
    """Every episode of a split, in the reader's order, and its camera sums."""

    rows: tuple[ClipRow, ...]
    sums: CameraSums


@dataclass(frozen=True)
class Split:
    """One split of a corpus, opened when it is needed; travels to other processes.

    Attributes:
        folder: the split's: ``CORPUS/CONFIG/SPLIT``.
        noise: labels are corrupted like this, the same way whenever they are read; None: as stored.
        seed: of the noise.

    """

    folder: Path
    noise: TeacherNoise | None = None
    seed: int = 0

    @cached_property
    def reader(self) -> CorpusReader:
        """The split's episodes."""
        corpus, config, split = self.folder.parent.parent, self.folder.parent.name, self.folder.name
        return CorpusReader(corpus, config, split)

    @property
    def name(self) -> str:
        """CONFIG/SPLIT."""
        return f"{self.folder.parent.name}/{self.folder.name}"

    @cached_property
    def content(self) -> str:
        """Hash of the data, and of the noise on it."""
        facts: list[Any] = [read_manifest(self.folder).content]
        if self.noise is not None:
            facts += [asdict(self.noise), self.seed]
        return hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()

    @property
    def packed(self) -> bool:
        """Whether the pictures lie beside the labels."""
        return VIDEO_MEMBER in self.reader.manifest.members

    def episode(self, i: int) -> Episode:
        """Read episode ``i``, with the noise on it; the last RECENT ones are kept at hand."""
        recent = self._recent
        if i not in recent:
            if len(recent) >= RECENT:
                del recent[next(iter(recent))]
            recent[i] = self._noisy(self.reader[i])
        return recent[i]

    @cached_property
    def _recent(self) -> dict[int, Episode]:
        return {}

    def _noisy(self, episode: Episode) -> Episode:
        if self.noise is None:
            return episode
        words = f"{self.seed} {episode.key}".encode()
        seed = int.from_bytes(hashlib.sha256(words).digest()[:6], "big")
        return teacher_noise(episode, seed, self.noise)

    def survey(self, length: int, stride: int, cache_dir: Path | None = None) -> Survey:
        """Look at every episode once, or at what was kept of an earlier look.

        Raises:
            CorpusError, EpisodeError: an episode cannot be read, or holds NaN; names both.

        """
        facts = [SURVEY_VERSION, self.content, length, stride]
        name = hashlib.sha256(json.dumps(facts).encode()).hexdigest()[:16]
        path = None if cache_dir is None else cache_dir / f"survey-{name}.json"
        if path is not None and path.is_file():
            return _read_survey(path)
        rows: list[ClipRow] = []
        sums = CameraSums.none()
        for i in range(len(self.reader)):
            stored = self.reader[i]
            rows.append(_row(stored))
            sums = sums + CameraSums.of(self._noisy(stored), length, stride)
        survey = Survey(tuple(rows), sums)
        if path is not None:
            _write_survey(path, survey)
        return survey

    def __getstate__(self) -> dict[str, Any]:
        return {f.name: getattr(self, f.name) for f in fields(self)}  # an open reader stays behind


def find_splits(
    folders: Sequence[str | Path],
    split: str = "train",
    noise: TeacherNoise | None = None,
    seed: int = 0,
) -> list[Split]:
    """Find the splits of that name at or below folders; a folder that is a split itself counts.

    Args:
        folders: corpora, their configs, or splits.
        split: name of the splits to take from corpora and configs.
        noise: see `Split`.
        seed: of the noise.

    Raises:
        DataError: no folder, or one without such a split; names it.

    """
    if not folders:
        raise DataError("data: expected a corpus folder, got none")
    found: list[Split] = []
    for folder in map(Path, folders):
        if not folder.is_dir():
            raise DataError(f"{folder}: expected a corpus folder, found no folder")
        there = [path for path in split_folders(folder) if (path / MANIFEST).is_file()]
        if folder in there:
            mine = [folder.absolute()]
        else:
            mine = [path.absolute() for path in there if path.name == split]
        if not mine:
            names = sorted({path.name for path in there})
            raise DataError(
                f"{folder}: expected a corpus with a {split} split (CONFIG/{split}/{MANIFEST}), "
                f"found {names or 'none'}; `mint-hub synth`, `convert` and `pack` write one"
            )
        found += [Split(path, noise, seed) for path in mine]
    return found


def _row(episode: Episode) -> ClipRow:
    def word(name: str) -> str:
        return str(episode.meta.get(name) or "")

    return ClipRow(
        key=episode.key,
        source=word("source"),
        domain=word("domain"),
        participant=word("participant"),
        shape_space=word("shape_space"),
        num_frames=episode.num_frames,
        hands_known=knows_hands(episode),
        kept_for=evaluation_clip(episode),
    )


def _write_survey(path: Path, survey: Survey) -> None:
    content = {"rows": [asdict(row) for row in survey.rows], "sums": survey.sums.to_list()}
    with replacing(path) as temporary:
        temporary.write_text(json.dumps(content))


def _read_survey(path: Path) -> Survey:
    try:
        content = json.loads(path.read_text())
        rows = tuple(ClipRow(**row) for row in content["rows"])
        return Survey(rows, CameraSums.from_list(content["sums"]))
    except (ValueError, TypeError, KeyError) as error:
        raise DataError(f"{path}: damaged ({error}); delete it, and it is made again") from error
