"""The unfinished split: finished shards, each with its record, until all of them are there.

``.<split>.partial`` holds ``spec.json``, what the split was begun with; ``files/``, which becomes
the split; and, beside it, a sealed record of every shard. A shard counts when its record is there
and its sha256 is the recorded one.
"""

import json
import os
import shutil
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final

from mint_hub.loaders.fields import KEY_PATTERN
from mint_hub.loaders.manifest import (
    FileRecord,
    ShardRecord,
    read_sealed,
    record_of,
    write_sealed,
)
from mint_hub.loaders.members import Format, member_names
from mint_hub.loaders.tar_layout import SUFFIX, CorpusError

SHARD_BYTES: Final = 64 << 20
_SPEC: Final = "spec.json"
_MADE_WITH: Final = "made_with"


@dataclass(frozen=True)
class ShardSpec:
    """Everything but the episodes that the bytes of a split depend on.

    Raises:
        CorpusError: a name is not [a-z0-9_-]+, or a number is out of range.

    """

    config: str
    split: str
    format: Format = "compact"
    extra: bool = False
    shard_bytes: int = SHARD_BYTES
    seed: int | None = 0
    shuffle_buffer: int = 512

    def __post_init__(self) -> None:
        for name in ("config", "split"):
            if not KEY_PATTERN.fullmatch(getattr(self, name)):
                got = getattr(self, name)
                raise CorpusError(f"{name}: expected only a-z, 0-9, '_' and '-', got {got!r}")
        for name in ("shard_bytes", "shuffle_buffer"):
            if getattr(self, name) < 1:
                raise CorpusError(f"{name}: expected at least 1, got {getattr(self, name)}")
        member_names(self.format, self.extra)

    def shard_name(self, number: int) -> str:
        """Return the file name of a shard: ``ego4d-train-00012.tar``."""
        return f"{self.config}-{self.split}-{number:05d}{SUFFIX}"


@dataclass
class UnfinishedSplit:
    """The unfinished split: ``files/`` becomes the split; beside it, a record of each shard.

    ``made_with`` are the arguments that the episodes are made with, by name, where they are made
    while they are written: keys alone do not tell clips of one seed apart.
    """

    folder: Path
    spec: ShardSpec
    made_with: Mapping[str, Any] = field(default_factory=dict[str, Any])
    shards: list[ShardRecord] = field(default_factory=list[ShardRecord])
    shard_keys: list[list[str]] = field(default_factory=list[list[str]])
    members: tuple[str, ...] = ()

    @property
    def files(self) -> Path:
        """The folder that becomes the split."""
        return self.folder / "files"

    def keys(self) -> list[str]:
        """Return the keys of all finished shards, in order."""
        return [key for keys in self.shard_keys for key in keys]

    def resume(self, length: int | None) -> int:
        """Take over shards that are finished and whole, remove all else; return how many.

        Raises:
            CorpusError: it was begun with other arguments; names the first, expected and got.

        """
        self.files.mkdir(parents=True, exist_ok=True)
        began = {**asdict(self.spec), "num_episodes": length, _MADE_WITH: dict(self.made_with)}
        if (self.folder / _SPEC).exists() and any(self.files.glob(f"*{SUFFIX}")):
            was = read_sealed(self.folder / _SPEC)
            now: dict[str, Any] = json.loads(json.dumps(began))  # as it would be read
            self._refuse_others(was.pop(_MADE_WITH, {}), now.pop(_MADE_WITH))
            self._refuse_others(was, now)
        else:
            write_sealed(self.folder / _SPEC, began)
        while self._take_over(self.spec.shard_name(len(self.shards))):
            pass
        keep = {_SPEC, "files", *(f"{s.name}.json" for s in self.shards)}
        _clear(self.folder, keep)
        _clear(self.files, {s.name for s in self.shards})
        return len(self.shards)

    def _refuse_others(self, was: Mapping[str, Any], now: Mapping[str, Any]) -> None:
        for name in {**now, **was}:
            if name not in was or name not in now or was[name] != now[name]:
                expected, got = (repr(v[name]) if name in v else "none" for v in (was, now))
                raise CorpusError(
                    f"{self.folder}: expected {name} {expected} as it was begun, got {got}: "
                    "resume with the same arguments, or delete that folder"
                )

    def _take_over(self, name: str) -> bool:
        tar = self.files / name
        try:
            values = read_sealed(self.folder / f"{name}.json")
        except CorpusError:
            return False
        record = ShardRecord(**values["shard"])
        if not tar.exists() or record_of(tar) != FileRecord(name, record.bytes, record.sha256):
            return False
        self._add(record, values["keys"], tuple(values["members"]))
        return True

    def _add(self, record: ShardRecord, keys: list[str], members: tuple[str, ...]) -> None:
        self.shards.append(record)
        self.shard_keys.append(keys)
        self.members = members

    def finish_shard(self, partial: Path, digest: str, size: int, keys: list[str]) -> None:
        """Give a whole shard its name, then write its record: without one it does not count."""
        name = self.spec.shard_name(len(self.shards))
        os.replace(partial, self.files / name)
        record = ShardRecord(name, size, digest, len(keys))
        values = {"shard": asdict(record), "keys": keys, "members": list(self.members)}
        write_sealed(self.folder / f"{name}.json", values)
        self._add(record, keys, self.members)


def _clear(folder: Path, keep: set[str]) -> None:
    for path in folder.iterdir():
        if path.name not in keep:
            shutil.rmtree(path) if path.is_dir() else path.unlink()
