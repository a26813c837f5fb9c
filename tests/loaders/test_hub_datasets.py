"""One corpus, read through `datasets`: under its name, by stock loaders, from a hub, resumed."""

import inspect
import os
import pickle
import shutil
import subprocess
import sys
from dataclasses import fields, replace
from itertools import chain
from pathlib import Path
from types import ModuleType

import datasets
import datasets.inspect
import datasets.load
import numpy as np
import pytest
import webdataset as wds
from datasets.distributed import split_dataset_by_node

import mint_hub
from mint_hub.assets import asset_path
from mint_hub.loaders.builder import episode_of, row_of
from mint_hub.loaders.derived import CardConfig, card_yaml, episode_features
from mint_hub.loaders.hub import NAME, answer_name
from mint_hub.loaders.lerobot import from_lerobot, to_lerobot
from mint_hub.loaders.location import CONFIGS, LOCATION, LOCATION_VARIABLE
from mint_hub.loaders.members import decode, encode
from mint_hub.loaders.reader import CorpusReader
from mint_hub.loaders.schema import Episode, EpisodeError
from mint_hub.loaders.shards import split_of, write_corpus
from mint_hub.loaders.tar_layout import CorpusError
from tests.episodes import make_episode
from tests.lerobot_files import RootPlan, write_root
from tests.loopback_hub import LoopbackHub

ROOT = Path(__file__).parent.parent.parent
SHARD_BYTES = 60_000  # four or five episodes of 24 frames
EGO4D = CardConfig("ego4d", default=True)


def episodes(count: int, first: int = 0) -> list[Episode]:
    return [make_episode(24, first + i, key=f"ego4d-{first + i:04d}") for i in range(count)]


@pytest.fixture(scope="module")
def corpus(tmp_path_factory) -> Path:
    """ego4d with two splits and a card, epic with one, in several shards."""
    folder = tmp_path_factory.mktemp("corpus")
    options = {"shard_bytes": SHARD_BYTES}
    write_corpus(episodes(12), folder, "ego4d", "train", **options)
    write_corpus(episodes(5, 100), folder, "ego4d", "validation", **options)
    write_corpus(episodes(3, 200), folder, "epic", "train", **options)
    (folder / "README.md").write_text(f"---\n{card_yaml([EGO4D])}---\n")
    return folder


@pytest.fixture(scope="module")
def cache(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("cache")


@pytest.fixture
def load(corpus, cache):
    """load_dataset("mint-ego") on the corpus above, with its own cache."""

    def call(config: str | None = "ego4d", **options):
        options = {"location": str(corpus), "cache_dir": str(cache)} | options
        return datasets.load_dataset(NAME, config, **options)

    return call


def keys(rows) -> list[str]:
    return [row["key"] for row in rows]


def same(one: Episode, two: Episode) -> bool:
    """Whether arrays are equal, and numbers of meta as near as the library's JSON reader gets."""
    times = [np.array(e.meta.get("source_timestamps_s", [])) for e in (one, two)]
    plain = [replace(e, meta={**e.meta, "source_timestamps_s": None}) for e in (one, two)]
    np.testing.assert_allclose(*times, rtol=1e-13)
    return plain[0].allclose(plain[1], atol=0)


def stored(episode: Episode) -> Episode:
    """What a compact shard keeps of an episode."""
    return decode(encode(episode))


# --- the name -------------------------------------------------------------------------------------


@pytest.mark.parametrize("first", ["import datasets, mint_hub", "import mint_hub, datasets"])
def test_the_sample_is_read_offline_in_either_import_order(first, tmp_path):
    code = f"""
import warnings
{first}
from datasets import get_dataset_config_names, load_dataset
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    data = load_dataset("mint-ego")
    stream = load_dataset("mint-ego", streaming=True, split="train")
said = [str(w.message) for w in caught if "mint-ego" in str(w.message)]
assert len(said) == 2 and all('"all"' in text for text in said), said
keys = ["sample", "sample-2", "sample-3"]
assert [row["key"] for row in stream] == list(data["train"]["key"]) == keys
print(get_dataset_config_names("mint-ego"))
"""
    environment = os.environ | {"HF_HOME": str(tmp_path), "HF_HUB_OFFLINE": "1"}
    environment |= {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    environment.pop(LOCATION_VARIABLE, None)
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, env=environment, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == str(list(CONFIGS))


def test_the_library_has_what_is_wrapped():
    """When this fails, `answer_name` has to follow a new version of `datasets`."""
    for module in (datasets.load, datasets.inspect):
        factory = module.dataset_module_factory
        assert factory.answers == NAME
        assert list(inspect.signature(factory).parameters)[:2] == ["path", "revision"]
    assert list(inspect.signature(datasets.load.DatasetModule).parameters)[:3] == [
        "module_path",
        "hash",
        "builder_kwargs",
    ]


def test_wrapping_twice_changes_nothing_and_other_names_go_through():
    module = ModuleType("stand_in")
    calls = []
    module.dataset_module_factory = lambda *args, **options: calls.append((args, options))
    answer_name(module)
    once = module.dataset_module_factory
    answer_name(module)
    assert module.dataset_module_factory is once
    once("org/other", "v1", data_dir="here")
    once(path="json")
    assert calls == [(("org/other", "v1"), {"data_dir": "here"}), (("json", None), {})]
    assert once(path=NAME, revision="v2").builder_kwargs["revision"] == "v2"
    assert len(calls) == 2
    with pytest.warns(UserWarning, match=r"mint_hub\.load_dataset"):
        answer_name(ModuleType("a_later_version"))


def test_the_other_door_needs_no_wrapping(load, corpus, cache, monkeypatch):
    expected = load(split="train")

    def refuse(*args, **options):
        raise AssertionError("a private function was called")

    monkeypatch.setattr(datasets.load, "dataset_module_factory", refuse)
    options = {"location": corpus, "split": "train"}
    found = mint_hub.load_dataset("ego4d", cache_dir=cache, **options)
    assert found.cache_files == expected.cache_files
    assert keys(mint_hub.load_dataset("ego4d", streaming=True, **options)) == keys(expected)
    with pytest.raises(ValueError, match="num_proc"):
        mint_hub.load_dataset("ego4d", streaming=True, num_proc=2, **options)


# --- the rows -------------------------------------------------------------------------------------


def test_rows_are_the_episodes_that_were_written(load):
    data = load()
    assert {split: len(rows) for split, rows in data.items()} == {"train": 12, "validation": 5}
    assert data["train"].features == episode_features()
    assert set(data["train"].column_names) == {f.name for f in fields(Episode)}
    found = {row["key"]: episode_of(row) for row in data["train"]}
    for episode in episodes(12):
        assert same(found[episode.key], stored(episode))
    numpy_row = data["train"].with_format("numpy")[0]
    assert numpy_row["hand_state"].shape == (24, 2, 109)
    with pytest.raises(EpisodeError, match=r"with_format\(None\)"):
        episode_of(numpy_row)


def test_a_row_holds_what_an_episode_may_lack():
    whole = make_episode(8)
    assert episode_of(row_of(whole)).allclose(whole, atol=0)
    lacking = stored(whole)
    assert lacking.presence_score is None
    assert row_of(lacking)["presence_score"].shape == (0, 2)
    assert episode_of(row_of(lacking)).allclose(lacking, atol=0)


def test_all_readers_read_the_same_samples(load, corpus, cache):
    reader = CorpusReader(corpus, "ego4d", "train")
    arrays = {reader.key(i): reader.arrays(i) for i in range(len(reader))}
    named = {row["key"]: episode_of(row) for row in load(split="train")}
    stream = {row["key"]: episode_of(row) for row in load(split="train", streaming=True)}
    card = datasets.load_dataset(str(corpus), "ego4d", split="train", cache_dir=str(cache))
    stock = {row["__key__"]: row for row in card.with_format("numpy")}
    urls = sorted(map(str, (corpus / "ego4d" / "train").glob("*.tar")))
    plain = {s["__key__"]: s for s in wds.WebDataset(urls, shardshuffle=False)}
    assert len(urls) > 1
    assert len(arrays) == 12
    assert arrays.keys() == named.keys() == stream.keys() == stock.keys() == plain.keys()
    for i in range(len(reader)):
        key, episode = reader.key(i), reader[i]
        for other in (named[key], stream[key], decode(plain[key])):
            assert same(other, episode)
        assert stock[key]["json"]["key"] == key
        for name in ("traj.npy", "rot6d.npy"):
            np.testing.assert_array_equal(stock[key][name], arrays[key][name])


def test_slices_and_processes_give_the_same_rows(load, cache):
    data = load(split="train")
    assert keys(load(split="train[:50%]")) == keys(data)[:6]
    assert keys(load(split="train[3:]+validation")) == keys(data)[3:] + keys(load()["validation"])
    parallel = load(split="train", num_proc=2, cache_dir=str(cache / "parallel"))
    assert sorted(keys(parallel)) == sorted(keys(data))


def test_packed_configs_have_the_clip(tmp_path):
    clips = {e.key: e.key.encode() * 9 for e in episodes(3)}
    write_corpus(
        episodes(3), tmp_path, "mine", "train", extra_members=lambda e: {"mp4": clips[e.key]}
    )
    data = mint_hub.load_dataset("mine", "train", location=tmp_path, cache_dir=tmp_path / "cache")
    assert data.features["video"] == datasets.Video(decode=False)
    assert {row["key"]: row["video"]["bytes"] for row in data} == clips
    assert episode_of(data[0]).key == data[0]["key"]


def test_all_is_the_union_of_its_parts(load):
    parts = [keys(load(part, split="train")) for part in ("ego4d", "epic")]
    assert keys(load("all", split="train")) == parts[0] + parts[1]


# --- streaming ------------------------------------------------------------------------------------


def test_a_stream_resumes_exactly(load):
    expected = keys(load(split="train", streaming=True))
    for taken in (0, 1, 4, 5, 11):
        stream = load(split="train", streaming=True)
        rows = iter(stream)
        head = [next(rows)["key"] for _ in range(taken)]
        resumed = load(split="train", streaming=True)
        resumed.load_state_dict(stream.state_dict())
        assert head + keys(resumed) == expected


@pytest.mark.parametrize("world", [2, 3, 5])
def test_nodes_share_a_stream_without_loss(load, world):
    shares = [
        keys(split_dataset_by_node(load(split="train", streaming=True), rank, world))
        for rank in range(world)
    ]
    assert sorted(chain(*shares)) == sorted(keys(load(split="train")))


def test_a_stream_travels_to_other_processes(load):
    stream = load(split="train", streaming=True)
    assert keys(pickle.loads(pickle.dumps(stream))) == keys(stream)


# --- caches and damage ----------------------------------------------------------------------------


def test_shards_rewritten_in_place_are_read_anew(tmp_path):
    def read() -> list[str]:
        options = {"location": tmp_path, "cache_dir": tmp_path / "cache"}
        return sorted(keys(mint_hub.load_dataset("ego4d", "train", **options)))

    for first in (0, 50):
        shutil.rmtree(tmp_path / "ego4d", ignore_errors=True)
        write_corpus(episodes(2, first), tmp_path, "ego4d", "train")
        assert read() == keys_of(first)
    shard = next((tmp_path / "ego4d" / "train").glob("*.tar"))
    os.utime(shard, ns=(1, 1))
    before = len(list((tmp_path / "cache").glob("mint-ego/*/*/*/*.arrow")))
    assert read() == keys_of(50)
    assert len(list((tmp_path / "cache").glob("mint-ego/*/*/*/*.arrow"))) == before + 1


def keys_of(first: int) -> list[str]:
    return [e.key for e in episodes(2, first)]


def test_damaged_shards_are_named(load, corpus, tmp_path):
    damaged = shutil.copytree(corpus, tmp_path / "corpus")
    shard = sorted((damaged / "ego4d" / "train").glob("*.tar"))[1]
    options = {"location": str(damaged), "cache_dir": str(tmp_path / "cache")}
    whole = shard.read_bytes()
    flipped = bytearray(whole)
    flipped[3000] ^= 1
    shard.write_bytes(flipped)
    with pytest.raises(CorpusError, match=f"{shard.name}.*sha256"):
        list(load(split="train", streaming=True, **options))
    with pytest.raises(datasets.exceptions.DatasetGenerationError) as caught:
        load(**options)
    assert shard.name in str(caught.value.__cause__)
    shard.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(CorpusError, match=rf"{shard.name}: expected {len(whole)} bytes"):
        load(**options)
    shard.unlink()
    with pytest.raises(CorpusError, match=rf"{shard.name}: .*episodes\), got none"):
        load(**options)
    (shard.parent / "shards.json").unlink()
    with pytest.raises(CorpusError, match=r"train: expected shards\.json, got none"):
        load(**options)


def test_mistakes_are_explained(load, corpus, tmp_path, monkeypatch):
    with pytest.raises(ValueError, match=r"one of \['ego4d', 'epic'\] at .*, got 'egodex'"):
        load("egodex")
    with pytest.raises(ValueError, match="got 'sample'"):
        load("sample")  # a location that is given counts for the sample too
    with pytest.raises(ValueError, match="location: expected a folder, a hub id"):
        load(location=str(tmp_path / "nowhere"))
    with pytest.raises(ValueError, match=r"data_files: .*location="):
        load(data_files="x.tar")
    monkeypatch.setenv(LOCATION_VARIABLE, str(corpus))
    assert len(load("epic", location=None, split="train")) == 3
    rows = mint_hub.load_dataset("sample", "train", streaming=True)
    assert keys(rows) == ["sample", "sample-2", "sample-3"]


# --- what is embedded, published, or was published first ------------------------------------------


def test_the_embedded_sample_is_the_truth_of_the_clip():
    folder = asset_path("sample_corpus")
    truth = Episode.load(asset_path("sample.npz"))
    first, *_ = mint_hub.load_dataset("sample", "train", streaming=True)
    read = episode_of(first)  # shards keep poses in float32
    assert replace(read, meta={}).allclose(replace(truth, meta={}), atol=1e-7)
    assert read.meta["synth"]["seed"] == truth.meta["synth"]["seed"]
    assert first["video"]["bytes"] == asset_path("sample.mp4").read_bytes()
    reader = CorpusReader(folder, "sample", "train")
    for name, data in encode(truth, "lossless", extra=True).items():
        assert bytes(reader.member(0, name)) == data
    config = CardConfig(
        "sample", format="lossless", extra=True, packed=True, splits=("train",), default=True
    )
    assert (folder / "README.md").read_text().startswith(f"---\n{card_yaml([config])}---\n")


def videos(count: int) -> list[Episode]:
    """Short episodes, each of its own video."""
    meta = [{"uid": f"video-{i}"} for i in range(count)]
    return [make_episode(9, i, key=f"e-{i}", meta=meta[i]) for i in range(count)]


def test_published_lerobot_labels_are_read_through_episode(tmp_path):
    root = tmp_path / "ego4d"
    to_lerobot(videos(40), root)
    expected = {e.key: e for e in from_lerobot(root)}
    options = {"location": tmp_path, "cache_dir": tmp_path / "cache"}
    data = mint_hub.load_dataset("ego4d", **options)
    assert data["validation"].num_rows >= 1
    found = [episode_of(row) for split in data.values() for row in split]
    assert sorted(e.key for e in found) == sorted(expected)
    for split, rows in data.items():
        for episode in map(episode_of, rows):
            assert same(episode, expected[episode.key])
            assert split == split_of(episode.meta["uid"], episode.meta.get("participant"))
    assert keys(mint_hub.load_dataset("all", "train", streaming=True, **options)) == keys(
        data["train"]
    )


@pytest.mark.parametrize("dialect", ["camera", "world"])
def test_a_root_without_validation_is_read_without_naming_a_split(tmp_path, dialect):
    """Few videos rarely have one in fifty: then there is a train split, and no other."""
    uids = [u for u in (f"v{i}" for i in range(99)) if split_of(u) == "train"][:5]
    plan = RootPlan(dialect=dialect, episode_columns={"video_uid": uids})
    write_root(tmp_path / "ego4d", plan)
    expected = [e.key for e in from_lerobot(tmp_path / "ego4d")]
    options = {"location": tmp_path, "cache_dir": tmp_path / "cache"}
    for config in ("ego4d", "all"):
        data = datasets.load_dataset("mint-ego", config, **options)
        assert list(data) == ["train"]
        assert data["train"]["key"] == expected
        streamed = datasets.load_dataset("mint-ego", config, streaming=True, **options)
        assert list(streamed) == ["train"]
        assert [row["key"] for row in streamed["train"]] == expected
    with pytest.raises(ValueError, match=r"validation.*train"):
        datasets.load_dataset("mint-ego", "ego4d", split="validation", **options)


REMOTE = """
import os, sys, datasets, mint_hub
from mint_hub.loaders.builder import episode_of
offline = sys.argv[1] == "offline"
data = datasets.load_dataset("mint-ego", "ego4d", location="org/mint-ego")
train = {row["key"]: episode_of(row) for row in data["train"]}
assert (len(train), len(data["validation"])) == (12, 5)
for place in ("org/mint-ego", "hf://datasets/org/mint-ego"):
    for row in mint_hub.load_dataset("ego4d", "train", streaming=True, location=place):
        assert episode_of(row).allclose(train[row["key"]], 0)
if not offline:
    stock = datasets.load_dataset("org/mint-ego", "ego4d", split="train", streaming=True)
    assert {row["__key__"] for row in stock} == train.keys()
    os.environ["MINT_EGO_LOCATION"] = "org/labels"  # a LeRobot root for each source
    for streaming in (False, True):
        labels = datasets.load_dataset("mint-ego", "ego4d", split="train", streaming=streaming)
        assert [row["meta"]["uid"] for row in labels] == ["video-0"]  # the other is validation
    del os.environ["MINT_EGO_LOCATION"]
for kind, config, options in (
    (ConnectionError if offline else ValueError, "all", {}),
    (ConnectionError if offline else ValueError, "ego4d", {"location": "org/none"}),
    (ConnectionError if offline else ValueError, "ego4d",
     {"location": "org/mint-ego", "revision": "v9"}),
):
    try:
        mint_hub.load_dataset(config, **options)
        raise SystemExit(f"{config} {options} was found")
    except kind as error:
        print(error)
"""


def test_a_repository_of_the_hub_is_read_also_offline_afterwards(corpus, tmp_path):
    outputs, labels = [], tmp_path / "labels"
    to_lerobot(videos(2), labels / "ego4d")
    with LoopbackHub() as hub:
        hub.add("org/mint-ego", corpus, kind="datasets")
        hub.add("org/labels", labels, kind="datasets")
        environment = os.environ | hub.environment(tmp_path / "home", token=None)
        environment |= {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
        for name in ("HF_TOKEN", LOCATION_VARIABLE):
            environment.pop(name, None)
        for mode in ("online", "offline"):
            environment["HF_HUB_OFFLINE"] = str(int(mode == "offline"))
            command = [sys.executable, "-c", REMOTE, mode]
            done = subprocess.run(
                command, env=environment, cwd=tmp_path, capture_output=True, text=True
            )
            assert done.returncode == 0, done.stderr
            outputs.append(done.stdout)
    nothing_yet, no_such, no_revision = outputs[0].splitlines()
    assert LOCATION in nothing_yet
    assert "no shards were published there" in nothing_yet
    assert LOCATION_VARIABLE in no_such
    assert "'v9'" in no_revision
    prepared = list((tmp_path / "home" / "datasets").glob("mint-ego/ego4d-*"))
    assert len(prepared) == 2  # shards and labels: offline found what was prepared online
