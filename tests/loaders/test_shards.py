import doctest
import os
import signal
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import ClassVar

import numpy as np
import psutil
import pytest

from mint_hub.loaders import members, parallel, shards
from mint_hub.loaders.index import Index
from mint_hub.loaders.integrity import verify
from mint_hub.loaders.manifest import read_manifest, split_folders
from mint_hub.loaders.order import Order
from mint_hub.loaders.parallel import in_order
from mint_hub.loaders.shards import CorpusError, ShardSpec, split_of, write_corpus
from tests import corpus_faults as faults
from tests.corpus_faults import EPISODES, SHARD_BYTES, tree
from tests.episodes import make_episode


def keys_of(split: Path) -> list[str]:
    return Index.load(split).episodes()["key"].to_pylist()


def write(episodes, folder, split="train", **options):
    return write_corpus(episodes, folder, "sample", split, shard_bytes=SHARD_BYTES, **options)


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole")
    faults.write(folder)
    return tree(folder)


# --------------------------------------------------------------------- content


def test_doctests():
    assert doctest.testmod(shards).failed == 0


@pytest.mark.parametrize(("format", "extra"), [("compact", False), ("lossless", True)])
def test_what_is_written_comes_back(tmp_path, format, extra):
    report = write(EPISODES, tmp_path, format=format, extra=extra)
    by_key = {episode.key: episode for episode in EPISODES}
    found = {}
    for path in Index.load(report.folder).paths:
        data = path.read_bytes()
        for sample in faults.spans_of(path):
            parts = {m.name: data[m.offset : m.offset + m.size] for m in sample.members}
            assert tuple(parts) == members.member_names(format, extra)
            found[sample.key] = members.decode(parts, path.name)
    assert found.keys() == by_key.keys()
    for key, episode in by_key.items():
        np.testing.assert_allclose(found[key].hand_state, episode.hand_state, atol=1e-3)
        np.testing.assert_array_equal(found[key].presence, episode.presence)
        assert found[key].text == episode.text


def test_the_report_and_the_manifest_count_the_same(tmp_path):
    report = write(EPISODES, tmp_path)
    manifest = read_manifest(report.folder)
    assert report.num_episodes == manifest.num_episodes == len(EPISODES)
    assert report.num_frames == manifest.num_frames == sum(e.num_frames for e in EPISODES)
    assert report.num_bytes == sum(p.stat().st_size for p in report.folder.glob("*.tar"))
    assert report.num_shards == len(manifest.shards) == 3
    assert report.content == manifest.content
    assert report.kept_shards == 0


def test_shards_are_no_larger_than_asked(tmp_path):
    report = write(EPISODES, tmp_path / "a")
    assert all(s.bytes <= SHARD_BYTES for s in read_manifest(report.folder).shards)
    one_each = write_corpus(EPISODES, tmp_path / "b", "sample", "train", shard_bytes=1)
    assert [s.samples for s in read_manifest(one_each.folder).shards] == [1] * len(EPISODES)


def test_further_members_follow_and_must_be_the_same_everywhere(tmp_path):
    def video(episode):
        return {"mp4": episode.key.encode()}

    split = write(EPISODES, tmp_path, extra_members=video).folder
    assert read_manifest(split).members == ("json", "traj.npy", "rot6d.npy", "mp4")
    with pytest.raises(CorpusError, match=r"episode e-\d: expected members .* like those before"):
        write(EPISODES, tmp_path / "b", extra_members=lambda e: video(e) if e.key < "e-5" else {})


def test_a_stock_tar_reader_reads_a_shard(tmp_path):
    import webdataset

    split = write(EPISODES, tmp_path).folder
    urls = [str(path) for path in Index.load(split).paths]
    found = list(webdataset.WebDataset(urls, shardshuffle=False))
    assert [sample["__key__"] for sample in found] == keys_of(split)
    assert set(found[0]) >= set(members.member_names())


# ----------------------------------------------------------------------- order


def test_equal_input_gives_equal_bytes_over_any_number_of_processes(tmp_path, whole):
    for number, episodes in enumerate((EPISODES, tuple(EPISODES), lambda: EPISODES)):
        faults.write(tmp_path / str(number), num_procs=1 + number % 2, episodes=episodes)
        assert tree(tmp_path / str(number)) == whole


def test_streams_give_equal_bytes_over_any_number_of_processes(tmp_path):
    for number in (1, 2):
        faults.write(tmp_path / str(number), number, episodes=(e for e in EPISODES))
    assert tree(tmp_path / "1") == tree(tmp_path / "2")


def test_indexed_episodes_are_in_the_order_of_order(tmp_path):
    keys = keys_of(write(EPISODES, tmp_path, seed=5).folder)
    places = Order(len(EPISODES), 5).permute(0, range(len(EPISODES)))
    assert keys == [EPISODES[i].key for i in places]


@pytest.mark.parametrize("size", [1, 3, 100])
def test_a_stream_is_shuffled_through_its_buffer(tmp_path, size):
    keys = keys_of(write(iter(EPISODES), tmp_path, shuffle_buffer=size).folder)
    numbers = [int(key.removeprefix("e-")) for key in keys]
    assert sorted(numbers) == list(range(len(EPISODES)))
    assert all(number < place + size for place, number in enumerate(numbers))
    assert (numbers == sorted(numbers)) == (size == 1)


def test_seeds_differ_and_none_keeps_the_order(tmp_path):
    orders = {tuple(keys_of(write(EPISODES, tmp_path, f"s{s}", seed=s).folder)) for s in range(4)}
    assert len(orders) > 1
    plain = [episode.key for episode in EPISODES]
    assert keys_of(write(EPISODES, tmp_path, "list", seed=None).folder) == plain
    assert keys_of(write(iter(EPISODES), tmp_path, "stream", seed=None).folder) == plain


def test_splits_share_their_statistics_file(tmp_path):
    write(EPISODES[:5], tmp_path, "train")
    write(EPISODES[5:], tmp_path, "validation")
    assert verify(tmp_path, "full").ok


def test_split_of_is_a_law_of_the_participant_then_of_the_video():
    uids = [f"video-{i}" for i in range(4000)]
    share = np.mean([split_of(uid, validation=0.1) == "validation" for uid in uids])
    assert abs(share - 0.1) < 0.02
    for person in ("P01", "P02", "P37"):
        assert len({split_of(uid, person, validation=0.5) for uid in uids[:50]}) == 1
    assert {split_of("x", f"P{i}", validation=0.5) for i in range(20)} == {"train", "validation"}
    assert [u for u in uids[:120] if split_of(u) == "validation"] == PUBLISHED


PUBLISHED = ["video-1", "video-34", "video-54"]
"""The law may never change: it would move videos between published splits."""


# ------------------------------------------------------- interruption and resume


def test_a_source_that_breaks_leaves_nothing_complete_and_is_resumed(tmp_path, whole):
    class Breaks(list):
        reads = 0

        def __getitem__(self, i):
            Breaks.reads += 1
            if Breaks.reads == 8:
                raise RuntimeError("unplugged")
            return super().__getitem__(i)

    with pytest.raises(RuntimeError, match="unplugged"):
        faults.write(tmp_path, episodes=Breaks(EPISODES))
    assert not split_folders(tmp_path)
    report = write(EPISODES, tmp_path)
    assert report.kept_shards == 2
    assert tree(tmp_path) == whole


def test_a_stream_is_resumed_at_the_right_episode(tmp_path):
    write(iter(EPISODES), tmp_path / "whole", shuffle_buffer=3)

    def stops(after):
        yield from EPISODES[:after]
        raise RuntimeError("unplugged")

    for after in range(len(EPISODES) + 1):
        folder = tmp_path / str(after)
        with pytest.raises(RuntimeError, match="unplugged"):
            write(stops(after), folder, shuffle_buffer=3)
        write(iter(EPISODES), folder, shuffle_buffer=3)
        assert tree(folder) == tree(tmp_path / "whole")


def test_a_writer_killed_at_any_rename_goes_on_to_equal_bytes(tmp_path, whole):
    row = faults.killed_at_every_rename(tmp_path, whole)
    assert row.cases >= 20
    assert row.resumed == row.cases, row


@pytest.mark.parametrize("num_procs", [1, 2])
def test_a_writer_killed_at_random_moments_goes_on_to_equal_bytes(tmp_path, whole, num_procs):
    row = faults.killed_at_random_moments(tmp_path, whole, num_procs)
    assert row.cases >= faults.KILLS // 2
    assert row.resumed == row.cases, row


def test_a_full_disk_is_an_error_and_is_resumed(tmp_path, whole):
    row = faults.full_disk(tmp_path, whole)
    assert row.cases >= 8
    assert row.resumed == row.cases, row


def test_a_finished_shard_that_changed_is_written_again(tmp_path, whole):
    _stop_in_the_last_shard(tmp_path)
    second = tmp_path / "sample/.train.partial/files/sample-train-00001.tar"
    data = bytearray(second.read_bytes())
    data[5000] ^= 4
    second.write_bytes(data)
    assert write(EPISODES, tmp_path).kept_shards == 1
    assert tree(tmp_path) == whole


def _stop_in_the_last_shard(folder: Path, episodes=EPISODES) -> None:
    class Breaks(list):
        def __getitem__(self, i):
            if self.last == i:
                raise RuntimeError("unplugged")
            return super().__getitem__(i)

    breaks = Breaks(episodes)
    breaks.last = int(Order(len(episodes), 0).permute(0, [len(episodes) - 1])[0])
    with pytest.raises(RuntimeError, match="unplugged"):
        write(breaks, folder)


def test_other_arguments_or_episodes_do_not_resume(tmp_path):
    _stop_in_the_last_shard(tmp_path)
    with pytest.raises(CorpusError, match="expected seed 0 as it was begun, got 1"):
        write(EPISODES, tmp_path, seed=1)
    with pytest.raises(CorpusError, match="expected num_episodes 9 as it was begun, got 8"):
        write(EPISODES[:8], tmp_path)
    others = [make_episode(7, seed=i, key=f"f-{i}") for i in range(len(EPISODES))]
    with pytest.raises(CorpusError, match=r"expected 'e-\d' as it was written, got 'f-\d'"):
        write(others, tmp_path)
    assert write(EPISODES, tmp_path).kept_shards == 2


def test_keys_that_are_known_are_compared_without_reading(tmp_path, whole):
    class Keyed(list):
        read: ClassVar[list[int]] = []

        def __getitem__(self, i):
            self.read.append(i)
            return super().__getitem__(i)

        def key(self, i, /):
            return EPISODES[i].key

    _stop_in_the_last_shard(tmp_path)
    order = Order(len(EPISODES), 0).permute(0, range(len(EPISODES))).tolist()
    others = Keyed(EPISODES)
    others.key = lambda i: "f-1" if i == order[1] else EPISODES[i].key  # neither end
    with pytest.raises(CorpusError, match=r"episode 1 .* got 'f-1'"):
        write(others, tmp_path)
    assert write(Keyed(EPISODES), tmp_path).kept_shards == 2
    assert sorted(Keyed.read) == sorted(order[-len(Keyed.read) :])
    assert len(Keyed.read) < len(order)
    assert tree(tmp_path) == whole


def test_what_episodes_are_made_with_is_part_of_what_is_begun(tmp_path, whole):
    class Breaks(list):
        def __iter__(self):
            yield from EPISODES[:-1]
            raise RuntimeError("unplugged")

    def made(frames, source=EPISODES):
        return write(iter(source), tmp_path, made_with=frames, shuffle_buffer=1)

    with pytest.raises(RuntimeError, match="unplugged"):
        made({"frames": 3, "size": (1, 2)}, Breaks())
    for other, message in (
        ({"frames": 4, "size": (1, 2)}, "frames 3 as it was begun, got 4"),
        ({"frames": 3}, r"size \[1, 2\] as it was begun, got none"),
        ({"frames": 3, "size": (1, 2), "seed": 0}, "seed none as it was begun, got 0"),
    ):
        with pytest.raises(CorpusError, match=f"expected {message}: resume with the same"):
            made(other)
    report = made({"size": [1, 2], "frames": 3.0})
    assert report.kept_shards == 2
    assert "made_with" not in read_manifest(report.folder).spec


def test_processes_end_with_a_killed_writer(tmp_path):
    code = (
        "import sys, time\n"
        "from mint_hub.loaders.parallel import in_order\n"
        "list(in_order(time.sleep, [0.01] * 10**6, 2))\n"
    )
    writer = psutil.Popen([sys.executable, "-c", code], cwd=Path(__file__).parents[2])
    deadline = time.monotonic() + 60
    while len(workers := writer.children()) < 2 and time.monotonic() < deadline:
        time.sleep(0.05)
    assert len(workers) == 2
    writer.send_signal(signal.SIGKILL)
    writer.wait()
    gone, alive = psutil.wait_procs(workers, timeout=60)
    for process in alive:
        process.kill()
    assert (len(gone), alive) == (2, [])


# ------------------------------------------------------------------- bad input


def test_a_split_that_exists_is_left_alone(tmp_path):
    faults.write(tmp_path)
    before = tree(tmp_path)
    with pytest.raises(CorpusError, match="expected no such split yet; delete it"):
        faults.write(tmp_path)
    assert tree(tmp_path) == before


def test_a_key_that_comes_twice_is_refused(tmp_path):
    with pytest.raises(CorpusError, match="to have its own, got 'e-0' twice: leave out the input"):
        write([*EPISODES[:3], EPISODES[0]], tmp_path)


@pytest.mark.parametrize("num_procs", [0, -1, 1.5, "2"])
def test_a_wrong_number_of_processes_is_refused_before_anything_is_written(tmp_path, num_procs):
    with pytest.raises(ValueError, match="num_procs: expected a whole number of at least 1, got"):
        write(EPISODES[:3], tmp_path, num_procs=num_procs)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("nothing", [[], iter(())])
def test_no_episodes_are_refused(tmp_path, nothing):
    with pytest.raises(CorpusError, match="expected at least one episode, got none"):
        write(nothing, tmp_path)
    assert tree(tmp_path) == {}


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"config": "Ego4D"}, "config: expected only a-z"),
        ({"split": "../train"}, "split: expected only a-z"),
        ({"shard_bytes": 0}, "shard_bytes: expected at least 1, got 0"),
        ({"shuffle_buffer": 0}, "shuffle_buffer: expected at least 1, got 0"),
        ({"format": "small"}, "format: expected 'compact' or 'lossless', got 'small'"),
    ],
)
def test_specifications_that_cannot_be_are_refused(wrong, message):
    with pytest.raises(ValueError, match=message):
        ShardSpec(**{"config": "a", "split": "train", **wrong})


def test_an_episode_that_cannot_be_encoded_is_named(tmp_path):
    episode = EPISODES[0]
    state = episode.hand_state.copy()
    state[-1, 1, -1] += 1.0
    from dataclasses import replace

    with pytest.raises(ValueError, match=r"use lossless .*e-0"):
        write([replace(episode, hand_state=state)], tmp_path)


# --------------------------------------------------------------------- in order


@pytest.mark.parametrize("num_procs", [1, 2])
def test_results_come_in_the_order_of_the_items(num_procs):
    assert list(in_order(abs, range(-50, 0), num_procs, batch=3)) == list(range(50, 0, -1))
    assert list(in_order(abs, [], num_procs)) == []


@pytest.mark.parametrize("num_procs", [1, 2])
def test_items_are_taken_a_few_batches_ahead_only(num_procs):
    taken = []
    results = in_order(abs, (taken.append(i) or i for i in range(1000)), num_procs, batch=2)
    assert next(results) == 0
    assert len(taken) <= 2 * (2 * num_procs + 1)
    results.close()


def _wait_from_1_on(folder: Path, item: int) -> int:
    (folder / f"begun-{item}").touch()
    while item and not (folder / "go").exists():
        time.sleep(0.01)
    return item


def test_items_that_wait_are_left_when_the_results_are(tmp_path, monkeypatch):
    class Pool(ProcessPoolExecutor):
        def __exit__(self, *error):
            (tmp_path / "go").touch()
            return super().__exit__(*error)

    monkeypatch.setattr(parallel, "ProcessPoolExecutor", Pool)
    results = in_order(partial(_wait_from_1_on, tmp_path), range(9), 2, batch=1)
    assert next(results) == 0
    results.close()
    begun = {path.name for path in tmp_path.glob("begun-*")}
    assert begun <= {"begun-0", "begun-1", "begun-2"}  # of five that were handed out


def _threads(_: int) -> int:
    import torch

    return torch.get_num_threads()


@pytest.mark.parametrize("start", ["fork", "spawn"])
def test_processes_share_the_cores(start, monkeypatch):
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    assert set(in_order(_threads, range(4), 2, batch=1, start=start)) == {1}


def test_an_error_in_a_process_arrives_and_a_death_is_told():
    with pytest.raises(TypeError, match="bad operand"):
        list(in_order(abs, [1, "x"], 2))
    with pytest.raises(CorpusError, match="a worker process died"):
        list(in_order(os._exit, [3], 2))


@pytest.mark.parametrize("num_procs", [1, 2])
@pytest.mark.parametrize("format", ["compact", "lossless"])
def test_scores_that_are_not_kept_are_counted_and_told(tmp_path, caplog, format, num_procs):
    made = [make_episode(6, seed=i, key=f"s-{i}") for i in range(5)]
    made[2] = replace(made[2], presence_score=None)
    options = {"format": format, "num_procs": num_procs}
    told = write_corpus(made, tmp_path, "without", "train", **options)
    assert told.lost_scores == 4
    (line,) = caplog.messages
    assert "without/train: presence scores of 4 episodes are not in the shards" in line
    assert write_corpus(made, tmp_path, "with", "train", extra=True, **options).lost_scores == 0
    assert len(caplog.messages) == 1
