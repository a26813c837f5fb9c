"""The `datasets` builder of the corpus: shards in, one row an episode out.

``datasets`` finds the one builder class in this module by importing it by name; people come here
through ``load_dataset("mint-ego")`` or ``mint_hub.load_dataset`` (``mint_hub.loaders.hub``).
"""

import hashlib
import json
import os
import warnings
from collections.abc import Iterator, Mapping
from typing import Any

import datasets
import numpy as np
from datasets.builder import Key

from mint_hub.loaders.derived import VIDEO_COLUMN, VIDEO_MEMBER, episode_features
from mint_hub.loaders.fields import ARRAY_FIELDS
from mint_hub.loaders.hub import NAME
from mint_hub.loaders.lerobot import from_lerobot
from mint_hub.loaders.location import ALL, CONFIGS, PARTS, SAMPLE, Shard, corpus_files
from mint_hub.loaders.manifest import ShardRecord
from mint_hub.loaders.members import decode
from mint_hub.loaders.participants import group_of
from mint_hub.loaders.schema import Episode, EpisodeError
from mint_hub.loaders.shards import split_of
from mint_hub.loaders.tar_layout import Buffer, CorpusError, map_file, samples_in


class MintEgo(datasets.GeneratorBasedBuilder):
    """Rows are episodes, columns the public fields of ``Episode``; packed configs have ``video``.

    Args:
        config_name: one of CONFIGS, or another that the location has; default: the embedded sample.
        location: folder, hub id or address; see ``mint_hub.load_dataset``.
        revision: branch, tag or commit of a hub repository.
        token: token for the hub.
        options: what ``datasets.DatasetBuilder`` takes beside.

    Raises:
        ValueError: no such location or config, or an option that this builder does not take.

    """

    BUILDER_CONFIGS = [datasets.BuilderConfig(name=name) for name in CONFIGS]  # noqa: RUF012
    DEFAULT_CONFIG_NAME = SAMPLE
    DEFAULT_WRITER_BATCH_SIZE = 64  # rows in memory while a cache is written; a row is ~200 kB

    def __init__(
        self,
        *,
        config_name: str | None = None,
        location: str | os.PathLike[str] | None = None,
        revision: str | None = None,
        token: str | bool | None = None,
        **options: Any,
    ) -> None:
        for name in ("data_files", "data_dir", "features"):
            if options.pop(name, None) is not None:
                raise ValueError(f"{name}: {NAME!r} takes none; say location=, and pick columns")
        if config_name is None:
            warnings.warn(
                f"{NAME}: reading the embedded {SAMPLE!r}, three synthetic clips; the corpus is "
                f'load_dataset("{NAME}", "{ALL}"), its parts are {", ".join(PARTS)}',
                stacklevel=4,
            )
            config_name = SAMPLE
        self.files = corpus_files(config_name, location, revision=revision, token=token)
        if config_name not in CONFIGS:
            # One of the user's own: the library then makes a config instead of looking for it.
            vars(self)["BUILDER_CONFIGS"] = []
        config_id = f"{config_name}-{self.files.stamp}"
        super().__init__(config_name=config_name, config_id=config_id, token=token, **options)

    def _info(self) -> datasets.DatasetInfo:
        return datasets.DatasetInfo(
            description="Head camera and both hands in egocentric video: pseudo-labels.",
            features=episode_features(self.files.packed),
        )

    def _split_generators(
        self, dl_manager: datasets.DownloadManager | datasets.StreamingDownloadManager
    ) -> list[datasets.SplitGenerator]:
        generators: list[datasets.SplitGenerator] = []
        for split, shards in self.files.splits.items():
            tars = [shard.url for shard in shards if shard.record is not None]
            fetched: dict[str, str] = dict(zip(tars, dl_manager.download(tars), strict=True))
            paths = [fetched.get(shard.url, shard.url) for shard in shards]
            generators.append(
                datasets.SplitGenerator(name=split, gen_kwargs={"paths": paths, "shards": shards})
            )
        return generators

    def _generate_shards(  # pyright: ignore[reportIncompatibleMethodOverride]
        self, paths: list[str], shards: list[Shard]
    ) -> Iterator[str]:
        yield from (shard.url for shard in shards)

    def _generate_examples(  # pyright: ignore[reportIncompatibleMethodOverride]
        self, paths: list[str], shards: list[Shard]
    ) -> Iterator[tuple[Key, dict[str, Any]]]:
        for i, (path, shard) in enumerate(zip(paths, shards, strict=True)):
            if shard.record is None:
                rows = _lerobot_rows(shard, self.token)
            else:
                rows = _shard_rows(path, shard, shard.record, self.files.packed)
            for k, row in enumerate(rows):
                yield Key(i, k), row


def row_of(episode: Episode) -> dict[str, Any]:
    """Return an episode as the library takes a row: its public fields, arrays it lacks as (0, 2).

    ``meta`` is text here, since the library would round numbers of a dict to ten decimals.
    """
    row: dict[str, Any] = {spec.name: np.zeros((0, 2), spec.dtype) for spec in ARRAY_FIELDS}
    row |= episode.to_dict()
    del row["schema_version"]
    row["meta"] = json.dumps(row["meta"])
    return row


def episode_of(row: Mapping[str, Any]) -> Episode:
    """Return the episode of a row: arrays exactly, numbers of ``meta`` to fourteen digits.

    Raises:
        EpisodeError: a column is missing or wrong, or the row is in another than the plain format
            (which would halve the precision of poses): ``dataset.with_format(None)`` gives it.

    """
    values = {name: row[name] for name in ("key", "image_size_hw", "text", "meta") if name in row}
    for name in ("image_size_hw", "text"):
        if name in values and not isinstance(values[name], list | tuple):
            raise EpisodeError(
                f"{name}: expected a row in the plain format, with_format(None), got "
                f"{type(row[name])}"
            )
    if isinstance(values.get("meta"), str):
        values["meta"] = json.loads(values["meta"])
    for spec in ARRAY_FIELDS:
        value = row.get(spec.name)
        values[spec.name] = None if value is None or len(value) == 0 else value
    return Episode.from_dict(values)


def _shard_rows(
    path: str, shard: Shard, record: ShardRecord, packed: bool
) -> Iterator[dict[str, Any]]:
    buffer = _whole(path, shard.url, record)
    view = memoryview(buffer)
    for sample in samples_in(buffer, shard.url):
        members = {m.name: view[m.offset : m.offset + m.size] for m in sample.members}
        video = members.pop(VIDEO_MEMBER, None)
        row = row_of(decode(members, shard.url))
        if packed:
            clip = None if video is None else bytes(video)
            row[VIDEO_COLUMN] = {"path": f"{sample.key}.{VIDEO_MEMBER}", "bytes": clip}
        yield row


def _whole(path: str, url: str, record: ShardRecord) -> Buffer:
    """Return a shard's bytes, which are those it was written with.

    Raises:
        CorpusError: they are not.

    """
    if "://" in path:
        with open(path, "rb") as file:  # the library makes this open remote files too
            buffer: Buffer = file.read()
    else:
        buffer = map_file(path)
    found = hashlib.sha256(buffer).hexdigest()
    if found != record.sha256:
        raise CorpusError(
            f"{url}: expected {record.bytes} bytes with sha256 {record.sha256[:12]}... "
            f"({record.samples} episodes), got {len(buffer)} with {found[:12]}..."
        )
    return buffer


def _lerobot_rows(root: Shard, token: Any) -> Iterator[dict[str, Any]]:
    """Read the episodes of a LeRobot root that belong to a split by the law of ``split_of``."""
    options = {"token": token} if root.url.startswith("hf://") else None
    for episode in from_lerobot(root.url, storage_options=options):
        if split_of(*group_of(episode.meta, episode.key)) == root.split:
            yield row_of(episode)
