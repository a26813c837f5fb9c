"""Where the corpus lies: a folder, a dataset repository of the hub, or any address fsspec opens.

Its shards are ``<config>/<split>/*.tar`` with a ``shards.json`` in every split. The config "sample"
is embedded in the package. "all", where it has no folder of its own, is the shards of its parts.
Where a config is a LeRobot v3 root instead, as the labels were first published, that is read.
"""

import hashlib
import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from mint_hub.assets import asset_path
from mint_hub.loaders.derived import SPLITS, VIDEO_MEMBER
from mint_hub.loaders.lerobot_files import roots_below
from mint_hub.loaders.lerobot_slices import splits_of
from mint_hub.loaders.manifest import MANIFEST, Manifest, ShardRecord, unseal
from mint_hub.loaders.tar_layout import CorpusError

LOCATION: Final = "ZZJAsher/wuji_ego_mint"
"""Where the published labels lie: a dataset repository of the hub, one LeRobot root a source.

No shards are published yet. It could not be opened where this was written, so the names of its
folders are those of the configs until someone has looked."""

LOCATION_VARIABLE: Final = "MINT_EGO_LOCATION"
"""Environment variable that names another folder, repository or address than LOCATION."""

SAMPLE: Final = "sample"
ALL: Final = "all"
PARTS: Final = ("ego4d", "epic", "egodex")
CONFIGS: Final = (SAMPLE, ALL, *PARTS, "lossless")
"""The published configs."""


@dataclass(frozen=True)
class Shard:
    """One tar file, or a whole LeRobot root: its path or address, and the split to read.

    ``record`` is what a tar file was written with; a root has none.
    """

    url: str
    split: str
    record: ShardRecord | None = None


@dataclass(frozen=True)
class CorpusFiles:
    """The shards of one config, by split, and what they hold beside the labels.

    ``stamp`` changes when any shard's size, time, checksum or place does: caches are named by it.
    """

    splits: dict[str, list[Shard]]
    packed: bool
    stamp: str


def corpus_files(
    config: str,
    location: str | os.PathLike[str] | None = None,
    *,
    revision: str | None = None,
    token: str | bool | None = None,
) -> CorpusFiles:
    """Find the shards of a config. The embedded sample obeys only a location that is given.

    Args:
        config: one of CONFIGS, or another that the location has.
        location: folder, hub id or address; default: $MINT_EGO_LOCATION, else LOCATION.
        revision: branch, tag or commit, where the location is a repository of the hub.
        token: token for a gated or private repository.

    Raises:
        ValueError: nothing is there, or not this config.
        CorpusError: a shard is missing or has another size than it was written with.
        ConnectionError: the hub is out of reach, and nothing of the repository is in its cache.

    """
    if config == SAMPLE and location is None:
        location = asset_path("sample_corpus")
    chosen = os.fspath(location or os.environ.get(LOCATION_VARIABLE) or LOCATION)
    place = _find(chosen, revision, token)
    parts = _parts(place, config)
    folders = [f for part in parts for f in place.folders(part)]
    splits: dict[str, list[Shard]] = {}
    packed, stamp = False, hashlib.sha256(f"{place.identity} {config}".encode())
    for root in [r for part in parts for r in place.lerobot_roots(part)]:
        for split in splits_of(root, {"token": token} if root.startswith("hf://") else None):
            splits.setdefault(split, []).append(Shard(root, split))
        folders = [f for f in folders if f"{place.prefix}{_parent(f)}" != root]
        if not place.fixed:
            place.stamp_files(root, stamp)
    for folder in folders:
        manifest, shards = _split(place, folder, stamp)
        splits.setdefault(_name(folder), []).extend(shards)
        packed |= VIDEO_MEMBER in manifest.members
    if not splits:
        there = sorted(_name(f) for f in place.folders("") if place.folders(_name(f)))
        raise ValueError(f"config: expected one of {there} at {chosen}, got {config!r}")
    return CorpusFiles(splits, packed, stamp.hexdigest()[:16])


def _parts(place: "_Place", config: str) -> tuple[str, ...]:
    """Return the folders that make a config up."""
    return PARTS if config == ALL and not place.folders(ALL) else (config,)


@dataclass(frozen=True)
class _Place:
    """A folder of some file system; ``identity`` is what it is called in stamps.

    What is ``fixed`` is named by its content already, so that times of files say nothing.
    """

    fs: Any
    root: str
    prefix: str
    identity: str
    fixed: bool = False
    repository: tuple[str, str | None, str | bool | None] | None = None  # name, revision, token

    def folders(self, name: str) -> list[str]:
        """Return the folders in a folder, sorted; none where there is no such folder.

        A web server may not list what it has: then the splits are asked for by their names.
        """
        path = f"{self.root}/{name}"
        shown = [e for e in self._listed(path) if not _name(e["name"]).startswith(".")]
        found = sorted(str(e["name"]).rstrip("/") for e in shown if self._is_folder(e))
        if not found and self._is_web and name:
            asked = [f"{path}/{split}" for split in SPLITS]
            found = [folder for folder in asked if self.fs.exists(f"{folder}/{MANIFEST}")]
        return found

    def lerobot_roots(self, name: str) -> list[str]:
        """Return the address of a folder that is a LeRobot root; nothing where it is none."""
        path = f"{self.root}/{name}"
        return roots_below(self.fs, path, f"{self.prefix}{path}", depth=0)

    def stamp_files(self, address: str, stamp: Any) -> None:
        """Add every file below an address to a stamp: its name, size and time."""
        found: dict[str, dict[str, Any]] = self.fs.find(
            address.removeprefix(self.prefix), detail=True
        )
        for name, entry in sorted(found.items()):
            stamp.update(f"{name} {entry['size']} {self.time(entry)}\n".encode())

    def time(self, entry: dict[str, Any]) -> Any:
        """Return when a file was last written, where that says anything."""
        return None if self.fixed else entry.get("mtime")

    def files(self, folder: str) -> dict[str, dict[str, Any]]:
        """Return the files in a folder by name, links to files included."""
        return {_name(e["name"]): e for e in self._listed(folder) if not self._is_folder(e)}

    def file(self, path: str) -> dict[str, Any] | None:
        """Return what is known of one file, its size included; None where there is none."""
        try:
            entry: dict[str, Any] = self.fs.info(path)
        except FileNotFoundError:
            return None
        return entry

    @property
    def _is_web(self) -> bool:
        return self.root.startswith(("http://", "https://"))

    def _listed(self, path: str) -> list[dict[str, Any]]:
        try:
            entries: list[dict[str, Any]] = self.fs.ls(path, detail=True)
        except (FileNotFoundError, NotADirectoryError):
            return []
        except Exception:  # a web server's own way to refuse
            if not self._is_web:
                raise
            return []
        return entries

    def manifest(self, folder: str) -> Manifest:
        """Read a split's shards.json; one from the hub stays in its cache, to be read offline."""
        where = f"{self.prefix}{folder}/{MANIFEST}"
        if self.repository is None:
            data: bytes = self.fs.cat_file(f"{folder}/{MANIFEST}")
        else:
            from huggingface_hub import hf_hub_download

            repo, revision, token = self.repository
            name = f"{folder.removeprefix(self.root).lstrip('/')}/{MANIFEST}"
            path = hf_hub_download(repo, name, repo_type="dataset", revision=revision, token=token)
            data = Path(path).read_bytes()
        return Manifest.from_dict(unseal(data, where), where)

    def _is_folder(self, entry: dict[str, Any]) -> bool:
        if entry["type"] in ("file", "directory"):
            return bool(entry["type"] == "directory")
        return bool(self.fs.isdir(entry["name"]))  # a link


def _split(place: _Place, folder: str, stamp: Any) -> tuple[Manifest, list[Shard]]:
    """Return what a split consists of, once every shard is seen to be there in its size."""
    files = place.files(folder)
    if MANIFEST not in files and place.file(f"{folder}/{MANIFEST}") is None:
        raise CorpusError(
            f"{place.prefix}{folder}: expected {MANIFEST}, got none; a split without it is not "
            "complete: run its writer again"
        )
    manifest = place.manifest(folder)
    shards: list[Shard] = []
    for record in manifest.shards:
        url = f"{place.prefix}{folder}/{record.name}"
        found = files.get(record.name) or {"size": None}
        if found["size"] is None:
            found = place.file(f"{folder}/{record.name}")
        if found is None or found["size"] != record.bytes:
            got = "none" if found is None else f"{found['size']} bytes"
            raise CorpusError(
                f"{url}: expected {record.bytes} bytes ({record.samples} episodes), got {got}"
            )
        stamp.update(f"{record} {place.time(found)}\n".encode())
        shards.append(Shard(url, _name(folder), record))
    return manifest, shards


# ----------------------------------------------------------------------------- the place


def _find(location: str, revision: str | None, token: str | bool | None) -> _Place:
    """Open a folder, a repository at a commit, or an address."""
    from fsspec.core import url_to_fs

    if "://" not in location and (folder := Path(location).expanduser()).is_dir():
        return _local(folder.resolve(), folder.resolve().as_posix())
    repo = location.removeprefix("hf://datasets/")
    if "://" in repo:
        fs, root = url_to_fs(location.rstrip("/"))
        return _Place(fs, root, location.rstrip("/").removesuffix(root), location)
    if not re.fullmatch(r"[\w.-]+/[\w.-]+", repo):
        raise ValueError(
            f"location: expected a folder, a hub id such as {LOCATION!r}, or an address, got "
            f"{location!r}, which is none"
        )
    commit = _commit(repo, revision, token)
    if isinstance(commit, Path):
        return _local(commit, f"{repo}@{commit.name}", fixed=True)
    url = f"hf://datasets/{repo}@{commit}"
    fs, root = url_to_fs(url, token=token)
    return _Place(fs, root, "hf://", f"{repo}@{commit}", True, (repo, revision, token))


def _local(folder: Path, identity: str, fixed: bool = False) -> _Place:
    from fsspec.implementations.local import LocalFileSystem

    return _Place(LocalFileSystem(), folder.as_posix(), "", identity, fixed)


def _commit(repo: str, revision: str | None, token: str | bool | None) -> str | Path:
    """Return the commit of a revision; where the hub is out of reach, its folder in the cache."""
    from huggingface_hub import HfApi, snapshot_download
    from huggingface_hub.errors import (
        LocalEntryNotFoundError,
        RepositoryNotFoundError,
        RevisionNotFoundError,
    )

    hint = f"give location= or ${LOCATION_VARIABLE}, a folder or a hub id; or take {SAMPLE!r}"
    if repo == LOCATION:
        hint = f"no shards were published there when this version was made; {hint}"
    try:
        return str(HfApi(token=token).dataset_info(repo, revision=revision).sha)
    except RevisionNotFoundError:
        raise ValueError(f"revision: {repo!r} on the hub has no {revision!r}") from None
    except RepositoryNotFoundError:
        expected = "a dataset repository that this token may read"
        raise ValueError(f"location: expected {expected}, got {repo!r}: {hint}") from None
    except Exception as error:  # whatever went wrong on the way there
        try:
            found = snapshot_download(
                repo, repo_type="dataset", revision=revision, local_files_only=True
            )
        except LocalEntryNotFoundError:
            message = f"location: {repo!r} on the hub is out of reach: {hint}"
            raise ConnectionError(message) from error
        return Path(found)


def _name(path: str) -> str:
    return path.rstrip("/").rsplit("/", 1)[-1]


def _parent(path: str) -> str:
    return path.rstrip("/").rsplit("/", 1)[0]
