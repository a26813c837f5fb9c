"""What a split consists of: ``shards.json``, written last, and sealed JSON in general.

A split is complete when its ``shards.json`` is there. It lists every other file of the folder with
its bytes and sha256, and ``content``, one hash over all shards that names the data whatever the
folder is called. Sealed JSON carries a checksum of itself and has one spelling only, so that no
flipped bit in it goes unseen.
"""

import hashlib
import json
import os
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

from mint_hub.loaders.atomic import replacing
from mint_hub.loaders.tar_layout import CorpusError

MANIFEST: Final = "shards.json"
INDEX: Final = "index.npy"
EPISODES: Final = "episodes.parquet"
STATS: Final = "stats.json"
MANIFEST_VERSION: Final = 1
"""Goes up when a reader of the previous version would misread what is written now."""


@dataclass(frozen=True)
class FileRecord:
    """A file of a split: its name, size and sha256 as 64 hexadecimal digits."""

    name: str
    bytes: int
    sha256: str


@dataclass(frozen=True)
class ShardRecord(FileRecord):
    """A shard: a file with a number of samples."""

    samples: int


@dataclass(frozen=True)
class Manifest:
    """``shards.json`` as a record.

    Attributes:
        config: name of the config.
        split: name of the split.
        format: "compact" or "lossless".
        members: names of every sample's members, in the order of the archive.
        num_frames: frames of all episodes together.
        shards: the shards in order; row i of the index is the i-th sample counted through them.
        files: ``index.npy`` and ``episodes.parquet``.
        spec: the arguments that the split was written with.

    """

    config: str
    split: str
    format: str
    members: tuple[str, ...]
    num_frames: int
    shards: tuple[ShardRecord, ...]
    files: tuple[FileRecord, ...]
    spec: dict[str, Any]

    @property
    def num_episodes(self) -> int:
        """Samples of all shards together."""
        return sum(shard.samples for shard in self.shards)

    @property
    def num_bytes(self) -> int:
        """Bytes of all shards together."""
        return sum(shard.bytes for shard in self.shards)

    @property
    def content(self) -> str:
        """One hash over the data: sha256 of the shards' sha256 in order."""
        return hashlib.sha256("\n".join(s.sha256 for s in self.shards).encode()).hexdigest()

    def to_dict(self) -> dict[str, Any]:
        """Return what ``shards.json`` says, JSON-able."""
        derived = {"num_episodes": self.num_episodes, "content": self.content}
        return {"manifest_version": MANIFEST_VERSION, **asdict(self), **derived}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any], where: str = MANIFEST) -> "Manifest":
        """Build a manifest from ``to_dict``'s result.

        Raises:
            CorpusError: a field is missing or wrong, or the version is a newer one.

        """
        version = values.get("manifest_version", 0)
        if not isinstance(version, int) or version > MANIFEST_VERSION:
            raise CorpusError(
                f"{where}: expected manifest_version at most {MANIFEST_VERSION}, got {version}: "
                "written by a newer mint-hub, so upgrade this one"
            )
        try:
            return cls(
                **{n: str(values[n]) for n in ("config", "split", "format")},
                members=tuple(values["members"]),
                num_frames=int(values["num_frames"]),
                shards=tuple(ShardRecord(**shard) for shard in values["shards"]),
                files=tuple(FileRecord(**file) for file in values["files"]),
                spec=dict(values["spec"]),
            )
        except (KeyError, TypeError, ValueError) as error:
            raise CorpusError(f"{where}: expected the fields of a manifest, got {error}") from None


def read_manifest(split_folder: str | os.PathLike[str]) -> Manifest:
    """Read the ``shards.json`` of a split.

    Raises:
        CorpusError: there is none, so the split is not complete; or it is damaged.

    """
    path = Path(split_folder) / MANIFEST
    return Manifest.from_dict(read_sealed(path), str(path))


def read_sealed(path: Path) -> dict[str, Any]:
    """Read a sealed JSON file, without its checksum.

    Raises:
        CorpusError: no such file, or its bytes are not those that were written.

    """
    try:
        return unseal(path.read_bytes(), str(path))
    except FileNotFoundError:
        missing = "; a split without it is not complete" if path.name == MANIFEST else ""
        raise CorpusError(f"{path}: expected this file, got none{missing}") from None


def write_sealed(path: Path, values: Mapping[str, Any]) -> None:
    """Write a sealed JSON file; it appears whole or not at all."""
    with replacing(path) as temporary:
        temporary.write_bytes(seal(values))


def seal(values: Mapping[str, Any]) -> bytes:
    """Return ``values`` as canonical JSON with a ``checksum`` of the rest, UTF-8.

    Raises:
        ValueError: a number is not finite, or ``values`` has a checksum already.

    """
    if "checksum" in values:
        raise ValueError("checksum: expected values without one")
    return _canonical({**values, "checksum": hashlib.sha256(_canonical(values)).hexdigest()})


def unseal(data: bytes, where: str) -> dict[str, Any]:
    """Return what was sealed, without its checksum.

    Raises:
        CorpusError: not the bytes that ``seal`` made.

    """
    try:
        values: dict[str, Any] = json.loads(data)
        values.pop("checksum")
        same = seal(values) == data
    except (ValueError, TypeError, AttributeError, KeyError):
        same, values = False, {}
    if not same:
        raise CorpusError(f"{where}: expected the bytes that were sealed here, got damaged ones")
    return values


def record_of(path: Path) -> FileRecord:
    """Return the record of a file by reading all of it."""
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    return FileRecord(path.name, path.stat().st_size, digest)


def split_folders(folder: str | os.PathLike[str]) -> list[Path]:
    """Return the splits at or below a folder, sorted: those that hold any file of a split.

    ``folder`` is a corpus, one of its configs, or one split. Names with a leading dot are skipped.
    """
    root = Path(folder)
    candidates: Iterable[Path] = (root, *root.glob("*/"), *root.glob("*/*/"))
    shown = (p for p in candidates if not any(q.startswith(".") for q in _below(p, root)))
    return sorted(p for p in shown if _looks_like_a_split(p))


def _below(path: Path, root: Path) -> tuple[str, ...]:
    return path.relative_to(root).parts


def _looks_like_a_split(folder: Path) -> bool:
    names = (MANIFEST, INDEX, EPISODES)
    return any((folder / n).exists() for n in names) or any(folder.glob("*.tar"))


def _canonical(values: Mapping[str, Any]) -> bytes:
    text = json.dumps(values, sort_keys=True, ensure_ascii=False, allow_nan=False, indent=1)
    return text.encode() + b"\n"
