import json
import zlib

import numpy as np
import pytest

from mint_hub.loaders import members
from mint_hub.loaders.index import (
    ROW,
    CorpusError,
    Index,
    build_index,
    episodes_schema,
    read_episodes,
    read_rows,
    summarise,
    write_rows,
)
from mint_hub.loaders.meta_member import META_FIELDS
from mint_hub.loaders.shards import write_corpus
from mint_hub.loaders.tar_layout import END, members_at, pack_sample
from tests.episodes import make_episode

EPISODES = [
    make_episode(
        10 + i, seed=i, key=f"e-{i}", meta={"participant": f"P{i}", "quality": {"jumps": i}}
    )
    for i in range(7)
]
NAMES = members.member_names()


@pytest.fixture(scope="module")
def split(tmp_path_factory):
    folder = tmp_path_factory.mktemp("corpus")
    return write_corpus(EPISODES, folder, "sample", "train", shard_bytes=30_000, extra=True).folder


@pytest.fixture(scope="module")
def index(split) -> Index:
    return Index.load(split)


def test_a_row_is_24_bytes():
    assert ROW.itemsize == 24


def test_every_row_leads_to_its_episode(index):
    by_key = {episode.key: episode for episode in EPISODES}
    table = index.episodes()
    assert len(index) == table.num_rows == len(EPISODES)
    assert sorted(table["key"].to_pylist()) == sorted(by_key)
    for row, said in zip(index.rows, table.to_pylist(), strict=True):
        data = index.paths[row["shard"]].read_bytes()
        offset, size = int(row["offset"]), int(row["size"])
        spans = members_at(data, offset, size)
        parts = {m.name: data[m.offset : m.offset + m.size] for m in spans}
        episode = members.decode(parts)
        assert episode.key == said["key"]
        assert episode.num_frames == row["num_frames"] == by_key[said["key"]].num_frames
        assert spans[1].offset == offset + row["arrays"] + 512
        assert zlib.crc32(data[offset : offset + size]) == said["crc32"]
        assert (said["shard"], said["offset"], said["size"]) == (row["shard"], offset, size)


def test_rows_count_through_the_shards(index):
    assert len(index.paths) > 2
    numbers = np.searchsorted(index.first_rows, np.arange(len(index)), side="right") - 1
    np.testing.assert_array_equal(numbers, index.rows["shard"])
    assert index.first_rows[-1] == len(index)


def test_rows_stay_on_disk(index):
    assert isinstance(index.rows, np.memmap)


def test_the_index_can_be_made_again_from_the_shards(index):
    made = np.concatenate([build_index(path, i) for i, path in enumerate(index.paths)])
    np.testing.assert_array_equal(made, index.rows)


def test_the_table_says_what_the_json_says(index):
    by_key = {episode.key: episode for episode in EPISODES}
    for said in index.episodes().to_pylist():
        episode = by_key[said["key"]]
        assert said["text"] == [s.to_dict() for s in episode.text]
        assert tuple(said["image_size_hw"]) == episode.image_size_hw
        for name in ("source", "uid", "participant", "shape_space", "scale_status"):
            assert said[name] == episode.meta[name]
        assert json.loads(said["quality"]) == episode.meta["quality"]
        rest = json.loads(said["meta"])
        assert rest == {"provenance": episode.meta["provenance"], "warnings": []}
        assert said["conventions"] is None
        shares = [said["presence_left"], said["presence_right"]]
        np.testing.assert_allclose(shares, episode.presence.mean(axis=0), rtol=1e-6)


def test_columns_are_the_declared_entries_but_the_arrays():
    names = episodes_schema().names
    declared = [f.name for f in META_FIELDS if f.name != "shape"]
    assert names[: len(declared)] == declared
    assert names[len(declared) :] == [
        *("presence_left", "presence_right", "shard", "offset", "size", "crc32")
    ]


def test_a_missing_column_or_another_type_is_named(split, tmp_path):
    from pyarrow import parquet

    table = read_episodes(split)
    parquet.write_table(table.drop_columns(["uid"]), tmp_path / "episodes.parquet")
    with pytest.raises(CorpusError, match=r"episodes\.parquet: expected column uid"):
        read_episodes(tmp_path)
    place = table.schema.get_field_index("num_frames")
    other = table.set_column(place, "num_frames", table["num_frames"].cast("float32"))
    parquet.write_table(other, tmp_path / "episodes.parquet")
    with pytest.raises(CorpusError, match="num_frames: expected int64, got float"):
        read_episodes(tmp_path)


def test_files_that_are_none_are_named(tmp_path):
    for read, name in ((read_episodes, "episodes.parquet"), (Index.load, "shards.json")):
        with pytest.raises(CorpusError, match=f"{name}: expected this file, got none"):
            read(tmp_path)
    (tmp_path / "episodes.parquet").write_bytes(b"PAR1 but no parquet")
    with pytest.raises(CorpusError, match="expected a whole parquet file"):
        read_episodes(tmp_path)
    (tmp_path / "index.npy").write_bytes(b"no npy")
    with pytest.raises(CorpusError, match="expected a whole npy file"):
        read_rows(tmp_path / "index.npy")
    np.save(tmp_path / "index.npy", np.zeros((3, 3)))
    with pytest.raises(CorpusError, match=r"expected \(N,\) rows"):
        read_rows(tmp_path / "index.npy")


def test_an_index_of_another_length_is_refused(split, index, tmp_path):
    (tmp_path / "shards.json").write_bytes((split / "shards.json").read_bytes())
    write_rows(tmp_path / "index.npy", np.asarray(index.rows[:-1]))
    with pytest.raises(CorpusError, match=r"index\.npy: expected 7 rows, got 6"):
        Index.load(tmp_path)


def shard_of(path, **changes):
    """A shard of one sample with members replaced; None takes one away."""
    parts = {**members.encode(EPISODES[0]), **changes.pop("changes", {})}
    key = changes.pop("key", "e-0")
    path.write_bytes(pack_sample(key, {k: v for k, v in parts.items() if v is not None}) + END)
    return path


OTHER_TRAJ = members.encode(EPISODES[1])["traj.npy"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"traj.npy": None}, r"x\.tar, episode e-0: expected members .*traj"),
        ({"mp4": b"video"}, r"x\.tar, episode e-0: expected members"),
        ({"traj.npy": OTHER_TRAJ}, r"traj\.npy: expected 10 frames, got 11"),
        ({"json": b"{"}, r"json.*x\.tar, episode e-0"),
        ({"rot6d.npy": b"\x93NUMPY"}, r"rot6d\.npy.*x\.tar, episode e-0"),
    ],
)
def test_samples_that_break_the_schema_are_named(tmp_path, changes, message):
    path = shard_of(tmp_path / "x.tar", changes=changes)
    with pytest.raises(ValueError, match=message):
        summarise(path, 0, NAMES)


def test_a_sample_under_another_key_is_named(tmp_path):
    path = shard_of(tmp_path / "x.tar", key="e-9")
    with pytest.raises(CorpusError, match=r"x\.tar, episode e-9: expected that key .* got 'e-0'"):
        summarise(path, 0, NAMES)
