"""Laws of the reader: what was written comes back, by any way in, and damage is never silent."""

import doctest
import json
import os
import pickle
import shutil
from contextlib import suppress
from dataclasses import replace

import fsspec
import numpy as np
import pytest

from mint_hub.loaders import row_layout
from mint_hub.loaders.manifest import Manifest, read_manifest, write_sealed
from mint_hub.loaders.members import MEMBERS, arrays_of, encode
from mint_hub.loaders.npy_member import npy_bytes
from mint_hub.loaders.reader import CorpusReader
from mint_hub.loaders.row_layout import NPY_HEADER, npy_header
from mint_hub.loaders.schema import TextSegment
from mint_hub.loaders.shards import write_corpus
from mint_hub.loaders.tar_layout import CorpusError
from tests.episodes import make_episode

NUM, LENGTHS = 40, (12, 33, 5, 60)
SHARD_BYTES = 160_000
SENTENCES = ("Open the drawer", "pour water", "fold a towel")


def episode_at(i):
    base = make_episode(LENGTHS[i % len(LENGTHS)], seed=i, gaps=False)
    presence = np.zeros_like(base.presence)
    presence[: (i % 5) * len(presence) // 4, 0] = True
    presence[:, 1] = i % 2 == 0
    meta = {**base.meta, "source": ("ego4d", "epic")[i % 2], "participant": f"p{i % 3}"}
    text = (TextSegment("a", SENTENCES[i % 3], "left", 0, 3),) if i % 4 else ()
    return replace(
        base, key=f"ep-{i:03d}", presence=presence, presence_score=None, text=text, meta=meta
    )


@pytest.fixture(scope="module")
def episodes():
    made = [episode_at(i) for i in range(NUM)]
    return {episode.key: episode for episode in made}


@pytest.fixture(scope="module")
def written(tmp_path_factory, episodes):
    folder = tmp_path_factory.mktemp("corpus")
    write_corpus(list(episodes.values()), folder, "ego4d", "train", shard_bytes=SHARD_BYTES)
    assert len(read_manifest(folder / "ego4d" / "train").shards) >= 4
    return folder


@pytest.fixture
def corpus(written, tmp_path):
    """A copy that a test may damage."""
    shutil.copytree(written, tmp_path / "corpus")
    return tmp_path / "corpus"


@pytest.fixture(scope="module")
def reader(written):
    return CorpusReader(written, "ego4d", "train")


def rows_of(episode):
    return arrays_of({k: v for k, v in encode(episode).items() if k != "json"})


def shards_of(corpus):
    return sorted((corpus / "ego4d" / "train").glob("*.tar"))


# ------------------------------------------------------------------ what was written


def test_every_episode_comes_back(reader, episodes):
    assert len(reader) == NUM
    assert {reader.key(i) for i in range(NUM)} == set(episodes)
    for i, episode in enumerate(reader):
        assert episode.key == reader.key(i)
        for name, array in rows_of(episodes[episode.key]).items():
            assert np.array_equal(reader.arrays(i)[name], array)
            assert np.array_equal(rows_of(episode)[name], array)
    assert reader[-1].key == reader.key(NUM - 1)
    assert [e.key for e in reader[3:5]] == [reader.key(3), reader.key(4)]


def test_arrays_are_views_of_the_file(reader):
    for array in reader.arrays(0).values():
        assert not array.flags.owndata
        assert not array.flags.writeable
    views = [reader.arrays(0)["traj.npy"] for _ in range(2)]
    assert np.shares_memory(*views)


def test_windows_are_rows_of_their_episodes(reader):
    rng = np.random.default_rng(0)
    batch = reader.random_windows(200, 12, rng)
    assert len(batch) == 200
    for name, array in batch.arrays.items():
        assert array.flags.c_contiguous
        assert array.flags.writeable
        for k in range(200):
            i, start = batch.index[k], batch.start[k]
            assert np.array_equal(array[k], reader.arrays(i)[name][start : start + 12])
            assert np.array_equal(array[k], reader.window(i, start, 12)[name])
    again = reader.windows(batch.index[::-1], batch.start[::-1], 12)
    assert np.array_equal(again.arrays["rot6d.npy"], batch.arrays["rot6d.npy"][::-1])


def test_random_windows_are_drawn_alike_from_all(reader):
    length, draws = 33, 20_000
    batch = reader.random_windows(draws, length, 1)
    fits = np.maximum(reader.num_frames - length + 1, 0)
    seen = np.bincount(batch.index, minlength=NUM)
    assert not seen[fits == 0].any()
    expected = draws * fits / fits.sum()
    assert np.abs(seen - expected).max() < 6 * np.sqrt(expected.max())
    assert (batch.start >= 0).all()
    assert (batch.start + length <= reader.num_frames[batch.index]).all()
    same = reader.random_windows(draws, length, 1)
    assert np.array_equal(same.start, batch.start)


def test_columns_are_read_by_name(reader):
    batch = reader.windows([0, 1], [0, 0], 5)
    for spec in MEMBERS:
        if spec.name not in batch.arrays:
            continue
        for column in spec.columns:
            want = batch.arrays[spec.name][..., spec.slices[column.name]]
            assert np.array_equal(batch.column(column.name), want)
    with pytest.raises(KeyError):
        batch.column("nothing")


def test_tensors_share_the_batch(reader):
    torch = pytest.importorskip("torch")
    batch = reader.random_windows(8, 5, 0, as_torch=True)
    assert batch.arrays["traj.npy"].dtype == torch.float32
    assert batch.arrays["rot6d.npy"].dtype == torch.float16
    arrays = reader.random_windows(8, 5, 0).arrays
    assert np.array_equal(batch.arrays["rot6d.npy"].numpy(), arrays["rot6d.npy"])


@pytest.mark.parametrize("format", ["compact", "lossless"])
@pytest.mark.parametrize("extra", [False, True])
def test_other_formats_and_packed_video(tmp_path, episodes, format, extra):
    some = list(episodes.values())[:6]
    videos = {e.key: os.urandom(100 + 700 * i) for i, e in enumerate(some)}
    write_corpus(
        some,
        tmp_path,
        "lossless",
        "train",
        format=format,
        extra=extra,
        extra_members=lambda e: {"mp4": videos[e.key]},
    )
    reader = CorpusReader(tmp_path, "lossless", "train")
    for i in range(6):
        want = encode(episodes[reader.key(i)], format, extra)
        arrays = reader.arrays(i)
        assert set(arrays) == set(want) - {"json"}
        for name, array in arrays_of({k: v for k, v in want.items() if k != "json"}).items():
            assert np.array_equal(arrays[name], array, equal_nan=True)
        assert bytes(reader.member(i, "mp4")) == videos[reader.key(i)]


def test_headers_are_those_that_numpy_writes():
    for num_frames in (1, 9, 10, 197, 100_000):
        for spec in MEMBERS:
            data = npy_bytes(np.zeros((num_frames, spec.width), spec.dtype), spec)[:NPY_HEADER]
            descr = np.dtype(spec.dtype).newbyteorder("<").str
            assert npy_header(descr, num_frames, spec.width) == data


def test_documentation_tells_the_truth():
    assert doctest.testmod(row_layout).failed == 0 < doctest.testmod(row_layout).attempted


# --------------------------------------------------------------------------- filters


def test_filters_choose_what_they_say(written, episodes):
    def keys(**options):
        reader = CorpusReader(written, "ego4d", "train", **options)
        assert all(reader[i].key == reader.key(i) for i in range(len(reader)))
        return {reader.key(i) for i in range(len(reader))}

    def those(law):
        found = {e.key for e in episodes.values() if law(e)}
        assert 0 < len(found) < NUM
        return found

    def says(episode, words):
        return any(words in s.text.lower() for s in episode.text)

    import pyarrow.compute as pc

    assert keys(source="epic") == those(lambda e: e.meta["source"] == "epic")
    assert keys(source=["epic", "ego4d"]) == set(episodes)
    assert keys(min_frames=33) == those(lambda e: e.num_frames >= 33)
    assert keys(text="OPEN THE") == those(lambda e: says(e, "open the"))
    assert keys(presence=0.5) == those(lambda e: (e.presence.mean(axis=0) >= 0.5).all())
    assert keys(presence=(0.5, 0)) == those(lambda e: e.presence[:, 0].mean() >= 0.5)
    of_p1 = those(lambda e: e.meta["participant"] == "p1")
    assert keys(where=[("participant", "==", "p1")]) == of_p1
    assert keys(where=pc.field("participant") == "p1") == of_p1
    assert keys(where=lambda table: pc.equal(table["participant"], "p1")) == of_p1
    both = those(lambda e: e.num_frames >= 33 and says(e, "water"))
    assert keys(text="water", where=lambda t: t["num_frames"].to_numpy() >= 33) == both
    assert keys(text="nothing of the kind") == set()


def test_filtered_windows_are_of_the_chosen_episodes(written):
    reader = CorpusReader(written, "ego4d", "train", source="epic", min_frames=12)
    batch = reader.random_windows(50, 12, 3)
    for k in range(50):
        want = reader.arrays(batch.index[k])["traj.npy"][batch.start[k] :][:12]
        assert np.array_equal(batch.arrays["traj.npy"][k], want)
        assert reader[int(batch.index[k])].meta["source"] == "epic"


@pytest.mark.parametrize(
    ("filters", "message"),
    [
        ({"source": "Epic"}, r"source: expected some of \['ego4d', 'epic'\], got 'Epic'"),
        ({"source": ["epic", "egodex"]}, r"source: expected some of .*, got 'egodex'"),
        ({"source": 3}, "source: expected text, or several texts, got 3"),
        ({"source": []}, r"source: expected text, or several texts, got \[\]"),
        ({"source": ["epic", None]}, "source: expected text, or several texts, got"),
        ({"presence": 3.0}, r"presence: expected a share of frames from 0 to 1.*, got 3\.0"),
        ({"presence": -0.1}, r"presence: expected a share .*, got -0\.1"),
        ({"presence": float("nan")}, "presence: expected a share .*, got nan"),
        ({"presence": (0.5, 2)}, r"presence: expected a share .*, got \(0\.5, 2\)"),
        ({"presence": (0.5, 0.5, 0.5)}, r"presence: expected a share .*, got \(0\.5, 0\.5, 0\.5\)"),
        ({"presence": ()}, r"presence: expected one share, or one a hand, got \(\)"),
        ({"presence": "half"}, "presence: expected a share .*, got 'half'"),
        ({"min_frames": -4}, "min_frames: expected a whole number of at least 0, got -4"),
        ({"min_frames": "a"}, "min_frames: expected a whole number of at least 0, got 'a'"),
        ({"min_frames": 2.5}, r"min_frames: expected a whole number of at least 0, got 2\.5"),
        ({"text": 3}, "text: expected text, got 3"),
        ({"text": ["open"]}, r"text: expected text, got \['open'\]"),
        ({"where": ["source"]}, r"where: expected \(column, op, value\) each, got 'source'"),
    ],
)
def test_filters_that_nothing_can_pass_are_named(written, filters, message):
    with pytest.raises(ValueError, match=message):
        CorpusReader(written, "ego4d", "train", **filters)


def test_numpy_numbers_are_as_good(written):
    plain = CorpusReader(written, "ego4d", "train", min_frames=33, presence=(0.5, 0))
    same = {"min_frames": np.int64(33), "presence": np.array([0.5, 0])}
    assert len(CorpusReader(written, "ego4d", "train", **same)) == len(plain) > 0


def test_an_episode_is_asked_for_by_a_whole_number(written):
    reader = CorpusReader(written, "ego4d", "train")
    assert reader.key(0) == reader[np.int64(0)].key
    with pytest.raises(TypeError, match=r"episode: expected a whole number, got 1\.0"):
        reader[1.0]


def test_wrong_filters_are_named(written):
    with pytest.raises(CorpusError, match="expected column colour"):
        CorpusReader(written, "ego4d", "train", where=[("colour", "==", 1)])
    with pytest.raises(ValueError, match="where: expected an expression"):
        CorpusReader(written, "ego4d", "train", where="source = 'epic'")
    with pytest.raises(ValueError, match=r"where: expected a mask \(40,\), got \(1,\)"):
        CorpusReader(written, "ego4d", "train", where=lambda _: [True])


# ---------------------------------------------------------------------------- errors


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda r: r.window(0, -1, 3), "window: expected"),
        (lambda r: r.window(0, 0, 61), r"window: expected .* \(episode ep-"),
        (lambda r: r.window(0, 0, 0), "window: expected"),
        (lambda r: r.windows([0, NUM], [0, 0], 2), "indices: expected 0 .. 39, got 0 .. 40"),
        (lambda r: r.windows([0, 1], [0], 2), "starts: expected one for each"),
        (lambda r: r.random_windows(4, 61), "expected an episode of 61 frames"),
        (lambda r: r.random_windows(4, 0), "length: expected a whole number of at least 1, got 0"),
        (lambda r: r.random_windows(-1, 4), "batch: expected a whole number of at least 1, got -1"),
        (lambda r: r.windows([0], [0.5], 4), "starts: expected whole numbers, got float64"),
        (lambda r: r.windows([0.0], [0], 4), "indices: expected whole numbers, got float64"),
        (lambda r: r.windows([0], [0], 4.0), r"length: expected a whole number, got 4\.0"),
        (lambda r: r.window(0, 1.5, 4), "starts: expected whole numbers"),
        (lambda r: r.stream(4, 61), "length: expected an episode of 61"),
    ],
)
def test_wrong_windows_are_named(reader, call, message):
    with pytest.raises(ValueError, match=message):
        call(reader)


def test_there_is_no_episode_outside(reader):
    for i in (NUM, -NUM - 1):
        with pytest.raises(IndexError, match=r"expected 0 \.\. 39"):
            reader[i]


def test_options_are_checked(written):
    with pytest.raises(ValueError, match="verify: expected one of"):
        CorpusReader(written, "ego4d", "train", verify="some")
    with pytest.raises(ValueError, match="on_error: expected one of"):
        CorpusReader(written, "ego4d", "train", on_error="ignore")
    with pytest.raises(CorpusError, match=r"shards.json: expected this file, got none"):
        CorpusReader(written, "ego4d", "test")


# ---------------------------------------------------------------------------- damage


def cut(path):
    path.write_bytes(path.read_bytes()[:-10240])


def flip(path):
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


def test_a_cut_or_missing_shard_is_named_at_open(corpus):
    first, second, *_ = shards_of(corpus)
    cut(first)
    with pytest.raises(CorpusError, match=rf"{first.name}: expected \d+ bytes \(\d+ episodes\)"):
        CorpusReader(corpus, "ego4d", "train")
    second.unlink()
    reader = CorpusReader(corpus, "ego4d", "train", on_error="skip")
    lost = sum(s.samples for s in reader.manifest.shards[:2])
    assert len(reader) == NUM - lost == len(list(reader))
    assert reader.num_skipped == lost
    assert [first.name in reader.problems[0], second.name in reader.problems[1]] == [True, True]
    assert len(reader.random_windows(64, 5, 0)) == 64


def test_a_flipped_bit_is_found_by_hash(corpus):
    shard = shards_of(corpus)[1]
    flip(shard)
    CorpusReader(corpus, "ego4d", "train")
    with pytest.raises(CorpusError, match=rf"{shard.name}: expected sha256"):
        CorpusReader(corpus, "ego4d", "train", verify="full")
    index = corpus / "ego4d" / "train" / "index.npy"
    flip(index)
    with pytest.raises(CorpusError, match=r"index.npy: expected sha256"):
        CorpusReader(corpus, "ego4d", "train")


def test_a_damaged_episode_is_named_or_skipped_and_counted(corpus, episodes):
    shard = shards_of(corpus)[0]
    data = shard.read_bytes()
    key = CorpusReader(corpus, "ego4d", "train").key(1)
    at = data.index(f"{key}.traj.npy".encode()) + 512
    shard.write_bytes(data[:at] + b"rubbish" + data[at + 7 :])

    reader = CorpusReader(corpus, "ego4d", "train")
    for read in (lambda: reader[1], lambda: reader.arrays(1), lambda: reader.windows([1], [0], 5)):
        with pytest.raises(CorpusError, match=rf"traj.npy: .* in {shard.name}, episode {key}"):
            read()
    with pytest.raises(CorpusError, match=key):
        list(reader.iter_arrays())

    reader = CorpusReader(corpus, "ego4d", "train", on_error="skip")
    batch = reader.random_windows(2000, 5, 0)
    assert len(batch) == 2000
    assert 1 not in batch.index
    assert len(list(reader)) == NUM - 1 == sum(1 for _ in reader.iter_arrays())
    assert reader.num_skipped == 1
    assert key in reader.problems[0]
    read = [len(b) for b in reader.stream(7, 5, as_torch=False)]
    assert sum(read) == NUM - 1
    with pytest.raises(CorpusError):
        reader.arrays(1)


def test_a_damaged_json_is_skipped_too(corpus):
    shard = shards_of(corpus)[0]
    data = shard.read_bytes()
    key = CorpusReader(corpus, "ego4d", "train").key(0)
    at = data.index(b"{", 512)
    shard.write_bytes(data[:at] + b"[" + data[at + 1 :])
    with pytest.raises(ValueError, match=shard.name):
        CorpusReader(corpus, "ego4d", "train")[0]
    reader = CorpusReader(corpus, "ego4d", "train", on_error="skip")
    assert key not in [episode.key for episode in reader]
    assert reader.num_skipped == 1


def test_by_sample_no_flipped_bit_is_read_and_by_size_most_are(corpus):
    shards = shards_of(corpus)
    clean = {episode.key: episode for episode in CorpusReader(corpus, "ego4d")}
    rng, silent = np.random.default_rng(0), 0
    for _ in range(30):
        path = shards[int(rng.integers(len(shards)))]
        whole = path.read_bytes()
        at = int(rng.integers(len(whole) - 1024))  # not in the end of the archive
        changed = bytearray(whole)
        changed[at] ^= 1 << int(rng.integers(8))
        path.write_bytes(changed)
        with pytest.raises(ValueError, match=path.name):
            list(CorpusReader(corpus, "ego4d", verify="sample"))
        reader = CorpusReader(corpus, "ego4d", verify="sample", on_error="skip")
        left = list(reader)
        assert len(left) == NUM - 1 == sum(1 for _ in reader.iter_arrays())
        assert reader.num_skipped == 1
        assert all(e.allclose(clean[e.key], atol=0) for e in left)
        with suppress(ValueError):
            silent += len(list(CorpusReader(corpus, "ego4d"))) == NUM
        path.write_bytes(whole)
    assert silent > 15, "by size alone a changed number is not seen"
    assert len(list(CorpusReader(corpus, "ego4d", verify="sample"))) == NUM


def test_by_sample_windows_are_checked_and_so_is_the_table(corpus):
    reader = CorpusReader(corpus, "ego4d", min_frames=20)
    path, data = shards_of(corpus)[0], shards_of(corpus)[0].read_bytes()
    at = data.index(npy_header("<f4", int(reader.num_frames[0]), 17)) + 500
    path.write_bytes(data[:at] + bytes([data[at] ^ 1]) + data[at + 1 :])
    CorpusReader(corpus, "ego4d", min_frames=20).window(0, 0, 4)
    by_sample = CorpusReader(corpus, "ego4d", min_frames=20, verify="sample")
    again = pickle.loads(pickle.dumps(by_sample))
    for each in (by_sample, again):
        with pytest.raises(CorpusError, match=rf"{path.name}, episode .*: expected bytes of crc32"):
            each.windows([0], [0], 4)
    path.write_bytes(data)
    table = corpus / "ego4d/train/episodes.parquet"
    table.write_bytes(table.read_bytes()[:-1] + b"X")
    with pytest.raises(CorpusError, match=r"episodes\.parquet"):
        CorpusReader(corpus, "ego4d", verify="sample")


def test_swapped_shards_are_seen_even_where_sizes_agree(corpus):
    """Two shards of one size change places: the first key of each says so."""
    folder = corpus / "ego4d" / "train"
    same = [replace(make_episode(20, seed=i), key=f"same-{i}") for i in range(20)]
    shutil.rmtree(folder)
    write_corpus(same, corpus, "ego4d", "train", shard_bytes=SHARD_BYTES // 3)
    shards = shards_of(corpus)
    a, b = shards[0], next(s for s in shards[1:] if s.stat().st_size == shards[0].stat().st_size)
    held = a.read_bytes()
    a.write_bytes(b.read_bytes())
    b.write_bytes(held)
    reader = CorpusReader(corpus, "ego4d", "train")
    with pytest.raises(CorpusError, match=rf"{a.name}: expected episode .* first, got .*another"):
        reader.arrays(0)


def test_an_index_of_another_length_is_refused(corpus):
    folder = corpus / "ego4d" / "train"
    values = read_manifest(folder).to_dict()
    values["shards"] = [{**s, "samples": s["samples"] + 1} for s in values["shards"]]
    write_sealed(folder / "shards.json", Manifest.from_dict(values).to_dict())
    with pytest.raises(CorpusError, match=rf"rows of index.npy, got {NUM}"):
        CorpusReader(corpus, "ego4d", "train")


# ---------------------------------------------------------------------------- remote


@pytest.fixture
def remote(written):
    """The corpus at an address of fsspec."""
    system = fsspec.filesystem("memory")
    system.put(str(written), "/published", recursive=True)
    yield "memory://published", system
    system.rm("/published", recursive=True)


def test_a_remote_corpus_reads_like_a_local_one(remote, reader, tmp_path):
    url, system = remote
    cache = tmp_path / "cache"
    away = CorpusReader(url, "ego4d", "train", cache_dir=cache)
    assert len([p for p in cache.rglob("*") if p.is_file()]) == 1  # the index, no shard yet
    assert all(a.allclose(b, atol=0) for a, b in zip(away, reader, strict=True))
    shards = {s.sha256 for s in away.manifest.shards}
    assert shards <= {p.name for p in cache.rglob("*")}
    for path in system.glob("/published/**/*.tar"):
        system.rm(path)
    cached = CorpusReader(url, "ego4d", "train", cache_dir=cache)
    assert np.array_equal(cached.arrays(0)["traj.npy"], reader.arrays(0)["traj.npy"])


def test_remote_bytes_that_were_not_written_never_enter_the_cache(remote, tmp_path):
    url, system = remote
    name = sorted(system.glob("/published/ego4d/train/*.tar"))[0]
    data = bytearray(system.cat(name))
    data[700] ^= 1
    system.pipe(name, bytes(data))
    away = CorpusReader(url, "ego4d", "train", cache_dir=tmp_path)
    digest = away.manifest.shards[0].sha256
    with pytest.raises(CorpusError, match=r"-00000.tar: expected sha256"):
        away[0]
    assert digest not in {p.name for p in tmp_path.rglob("*")}
    skipping = CorpusReader(url, "ego4d", "train", cache_dir=tmp_path, on_error="skip")
    batch = skipping.random_windows(64, 5, 0)
    first = away.manifest.shards[0].samples
    assert batch.index.min() >= first
    assert len(list(skipping)) == NUM - first
    with pytest.raises(CorpusError, match="sha256"):
        CorpusReader(url, "ego4d", "train", cache_dir=tmp_path, verify="full")
    system.rm(name)
    with pytest.raises(CorpusError, match=r"-00000.tar: expected this file \(\d+ episodes\)"):
        CorpusReader(url, "ego4d", "train", cache_dir=tmp_path)[0]


def test_a_damaged_cache_is_filled_again(remote, reader, tmp_path):
    url, _ = remote
    away = CorpusReader(url, "ego4d", "train", cache_dir=tmp_path, verify="full")
    digest = away.manifest.shards[0].sha256
    path = tmp_path / digest[:2] / digest
    good = path.read_bytes()
    flip(path)
    CorpusReader(url, "ego4d", "train", cache_dir=tmp_path, verify="full")
    assert path.read_bytes() == good


# ------------------------------------------------------------------- size and processes


def test_a_reader_travels_to_another_process(reader):
    reader.arrays(0)
    copy = pickle.loads(pickle.dumps(reader))
    assert np.array_equal(copy.arrays(2)["traj.npy"], reader.arrays(2)["traj.npy"])


def test_few_files_stay_open(written):
    reader = CorpusReader(written, "ego4d", "train")
    reader._maps._limit = 2
    held = reader.arrays(0)["traj.npy"]
    whole = reader.random_windows(300, 5, 0)
    again = reader.random_windows(300, 5, 0)
    assert len(reader._maps._open) == 2
    for _, arrays in reader.iter_arrays():
        assert arrays
    assert len(reader._maps._open) == 2
    assert np.array_equal(whole.arrays["traj.npy"], again.arrays["traj.npy"])
    assert np.array_equal(held, reader.arrays(0)["traj.npy"])


def test_opening_looks_at_no_shard(corpus):
    for shard in shards_of(corpus):
        size = shard.stat().st_size
        shard.write_bytes(b"")
        os.truncate(shard, size)
    reader = CorpusReader(corpus, "ego4d", "train", text="water")
    assert 0 < len(reader) < NUM
    with pytest.raises(CorpusError):
        reader.arrays(0)


def test_json_of_the_manifest_is_where_the_reader_says(written, reader):
    values = json.loads((written / "ego4d" / "train" / "shards.json").read_text())
    assert values["num_frames"] == int(reader.num_frames.sum())
    assert str(values["num_frames"]) in repr(reader)
