"""LeRobot roots in slices: the same shards as the stream, whichever process reads what."""

import pickle
import re
import shutil
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from mint_hub.loaders import lerobot_slices
from mint_hub.loaders.lerobot import LeRobotError, LeRobotSlices, from_lerobot, to_lerobot
from mint_hub.loaders.lerobot_slices import splits_of
from mint_hub.loaders.participants import group_of
from mint_hub.loaders.reader import CorpusReader
from mint_hub.loaders.shard_source import Sliced
from mint_hub.loaders.shards import CorpusError, split_of, write_corpus
from tests.corpus_faults import tree
from tests.episodes import make_episode
from tests.lerobot_files import RootPlan, replace_column, write_root

LENGTHS = (12, 9, 20, 8, 15, 30, 7)


@pytest.fixture(autouse=True)
def small_slices(monkeypatch):
    monkeypatch.setattr(lerobot_slices, "SLICE_FRAMES", 16)


@pytest.fixture
def roots(tmp_path):
    plans = {
        "ego4d": RootPlan(LENGTHS, per_file=4, rows_per_group=11),
        "egodex": RootPlan(LENGTHS[::-1], "world", "egodex", per_file=3, seed=9, rows_per_group=50),
    }
    for name, plan in plans.items():
        write_root(tmp_path / name, plan)
    return [tmp_path / name for name in plans]


def stream(roots):
    for root in roots:
        yield from from_lerobot(root)


def write(episodes, folder, **options):
    return write_corpus(
        episodes, folder, "c", "train", shard_bytes=60_000, shuffle_buffer=5, **options
    )


def slices_of(source):
    return list(source)


@pytest.mark.parametrize("num_procs", [1, 2, 3])
@pytest.mark.parametrize("format", ["compact", "lossless"])
def test_slices_give_the_shards_of_the_stream(roots, tmp_path, num_procs, format):
    write(stream(roots), tmp_path / "stream", format=format)
    write(LeRobotSlices(roots), tmp_path / "slices", format=format, num_procs=num_procs)
    files = tree(tmp_path / "stream")
    assert len([name for name in files if name.endswith(".tar")]) > 2
    assert tree(tmp_path / "slices") == files


def test_every_episode_is_in_one_slice_and_slices_begin_with_a_row_group(roots):
    source = LeRobotSlices(roots)
    assert isinstance(source, Sliced)
    parts = slices_of(source)
    assert len(parts) > 5
    for number, root in enumerate(roots):
        own = [part.episodes for part in parts if part.root == number]
        expected = [e.meta["provenance"]["episode_index"] for e in from_lerobot(root)]
        assert np.concatenate([e["episode_index"] for e in own]).tolist() == expected
    by_file = {}
    for part in parts:
        first = part.episodes[0]
        by_file.setdefault((part.root, int(first["data/file_index"])), []).append(part.episodes)
    groups = {0: 11, 1: 50}
    for (root, _), files in by_file.items():
        starts = [int(e[0]["dataset_from_index"] - e[0]["base"]) for e in files]
        lasts = [int(e[-1]["dataset_from_index"] - e[-1]["base"]) for e in files]
        for last, start in zip(lasts, starts[1:], strict=False):
            assert last // groups[root] < start // groups[root]
    read = [e.key for part in parts for e in source.read_slice(part)]
    assert read == [e.key for e in stream(roots)]


def test_what_is_kept_is_decided_before_any_frame_is_read(roots, tmp_path):
    everything = {e.key: e for e in stream(roots)}
    groups = []
    kept = LeRobotSlices(roots, keep=lambda uid, person: groups.append((uid, person)) or "3" in uid)
    keys = [e.key for part in kept for e in kept.read_slice(part)]
    assert groups == [(e.meta["uid"], None) for e in everything.values()]
    assert keys == [k for k, e in everything.items() if "3" in e.meta["uid"]]
    for path in roots[0].glob("data/*/*.parquet"):
        path.unlink()
    assert slices_of(LeRobotSlices(roots[:1], keep=lambda uid, person: False)) == []


def test_the_groups_of_our_own_roots_are_those_of_meta(tmp_path):
    people = ["P01", None, "P02"]
    made = [
        make_episode(9, seed=i, key=f"e-{i}", meta={"source": "s", "participant": people[i]})
        for i in range(3)
    ]
    to_lerobot(made, tmp_path / "root", extra=True)
    seen = []
    slices_of(LeRobotSlices([tmp_path / "root"], keep=lambda *group: bool(seen.append(group))))
    assert seen == [(e.meta.get("uid") or e.key, e.meta.get("participant")) for e in made]


def test_two_roots_of_one_source_have_no_key_and_no_video_in_common(tmp_path):
    for name, seed in (("x", 0), ("y", 30)):
        write_root(tmp_path / name, RootPlan(LENGTHS, seed=seed))
    write(LeRobotSlices([tmp_path / "x", tmp_path / "y"]), tmp_path / "both")
    found = list(CorpusReader(tmp_path / "both", "c", "train"))
    assert len({e.key for e in found}) == len(found) == 2 * len(LENGTHS)
    uids = [{e.meta["uid"] for e in from_lerobot(tmp_path / name)} for name in "xy"]
    assert not uids[0] & uids[1]


def test_a_root_that_comes_twice_is_named(tmp_path):
    write_root(tmp_path / "x")
    shutil.copytree(tmp_path / "x", tmp_path / "copy")
    expected = f"got {tmp_path / 'x'} and {tmp_path / 'copy'}, which are the same root"
    with pytest.raises(LeRobotError, match=re.escape(expected)):
        write(LeRobotSlices([tmp_path / "x", tmp_path / "copy"]), tmp_path / "both")


def test_how_a_root_is_called_changes_no_byte(tmp_path, monkeypatch):
    root = tmp_path / "a/ego4d"
    write_root(root, RootPlan(source=None))
    shutil.copytree(root, tmp_path / "far/away/ego4d")
    monkeypatch.chdir(root.parent)
    places = (str(root), "ego4d", "./ego4d/", str(tmp_path / "far/away/ego4d"), f"file://{root}")
    for number, place in enumerate(places):
        write(LeRobotSlices([place]), tmp_path / str(number))
    trees = [tree(tmp_path / str(number)) for number in range(len(places))]
    assert all(files == trees[0] for files in trees)
    assert not any(str(tmp_path).encode() in data for data in trees[0].values())


def test_splits_are_those_that_episodes_fall_into(roots, tmp_path):
    for root in roots:
        seen = {split_of(*group_of(e.meta, e.key)) for e in from_lerobot(root)}
        assert splits_of(root) == [s for s in ("train", "validation") if s in seen]
    uids = [f"v{i}" for i in range(500)]
    rare = [uid for uid in uids if split_of(uid) == "validation"][:5]
    write_root(tmp_path / "both", RootPlan(episode_columns={"uid": [*uids[:4], rare[0]]}))
    assert splits_of(tmp_path / "both") == ["train", "validation"]
    write_root(tmp_path / "rare", RootPlan(episode_columns={"uid": rare}))
    assert splits_of(tmp_path / "rare") == ["validation"]


def test_a_source_travels_to_a_process_that_shares_nothing(roots):
    source = LeRobotSlices(roots, keep=lambda uid, person: "3" in uid)
    there = pickle.loads(pickle.dumps(source))
    parts = slices_of(source)
    keys = [e.key for part in parts for e in source.read_slice(part)]
    sent = [pickle.loads(pickle.dumps(part)) for part in parts]
    assert [e.key for part in sent for e in there.read_slice(part)] == keys != []


def test_splits_divide_the_episodes(roots, tmp_path):
    for split in ("train", "validation"):
        chosen = LeRobotSlices(
            roots, keep=lambda uid, who, split=split: split_of(uid, who, validation=0.4) == split
        )
        keys = {e.key for part in chosen for e in chosen.read_slice(part)}
        expected = {
            e.key
            for e in stream(roots)
            if split_of(e.meta["uid"], e.meta.get("participant"), validation=0.4) == split
        }
        assert keys == expected != set()


class Breaks(LeRobotSlices):
    """Reads its slices, but for one."""

    def __init__(self, roots, broken):
        super().__init__(roots)
        self.broken = broken

    def read_slice(self, part, /):
        if part.root == self.broken[0] and self.broken[1] in part.episodes["episode_index"]:
            raise RuntimeError("unplugged")
        return super().read_slice(part)


@pytest.mark.parametrize("num_procs", [1, 2])
def test_a_broken_conversion_is_resumed_to_equal_bytes(roots, tmp_path, num_procs):
    write(LeRobotSlices(roots), tmp_path / "whole")
    kept = []
    for root, episode in ((0, 0), (0, 6), (1, 6)):
        folder = tmp_path / f"{root}-{episode}"
        with pytest.raises(RuntimeError, match="unplugged"):
            write(Breaks(roots, (root, episode)), folder, num_procs=num_procs)
        assert not (folder / "c/train").exists()
        kept.append(write(LeRobotSlices(roots), folder, num_procs=num_procs).kept_shards)
        assert tree(folder) == tree(tmp_path / "whole")
    assert kept[0] == 0 < kept[-1]


def test_other_roots_do_not_resume(roots, tmp_path):
    with pytest.raises(RuntimeError, match="unplugged"):
        write(Breaks(roots, (1, 6)), tmp_path / "out")
    with pytest.raises(CorpusError, match="as it was written, got"):
        write(LeRobotSlices(roots[::-1]), tmp_path / "out")


@pytest.fixture
def damaged(roots):
    """The second root's neighbours of one episode are whole; its third frame has no rotation."""
    path = sorted(roots[0].glob("data/*/*.parquet"))[0]
    table = pq.read_table(path)
    quat = np.array(table["cam_quat"].to_pylist(), np.float32)
    quat[12 + 2] = 0.5, 0.0, 0.0, 0.0
    values = pa.FixedSizeListArray.from_arrays(pa.array(quat.reshape(-1)), 4)
    replace_column(Path(path), "cam_quat", values)
    return roots


@pytest.mark.parametrize("num_procs", [1, 2])
def test_a_wrong_value_names_its_episode_and_frame(damaged, tmp_path, num_procs):
    message = r"file-000\.parquet, episode 1: cam_quat: expected unit .* got 0\.5 at frame 2"
    with pytest.raises(LeRobotError, match=message):
        write(LeRobotSlices(damaged), tmp_path / "out", num_procs=num_procs)


def test_a_wrong_episode_may_be_left_out(damaged, tmp_path):
    source = LeRobotSlices(damaged, on_error="skip")
    report = write(source, tmp_path / "out", num_procs=2)
    assert report.num_episodes == 2 * len(LENGTHS) - 1
    keys = [e.key for e in from_lerobot(damaged[0], on_error="skip")]
    assert [e.key for part in source if part.root == 0 for e in source.read_slice(part)] == keys


def test_a_missing_root_and_an_unknown_word_are_told(tmp_path):
    with pytest.raises(ValueError, match="on_error: expected 'raise' or 'skip', got 'never'"):
        LeRobotSlices([], on_error="never")
    with pytest.raises(LeRobotError, match=r"is .* a LeRobot v3 root"):
        write(LeRobotSlices([tmp_path / "none"]), tmp_path / "out")
    with pytest.raises(CorpusError, match="expected at least one episode, got none"):
        write(LeRobotSlices([]), tmp_path / "out")
