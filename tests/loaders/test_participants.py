"""A participant is on one side of the split, whichever way the labels came in."""

import doctest
import json

import numpy as np
import pytest

from mint_hub.cli import main
from mint_hub.labelling.label import _Books
from mint_hub.loaders import beside, builder, participants
from mint_hub.loaders.changelog import Changelog
from mint_hub.loaders.lerobot import LeRobotSlices, from_lerobot, to_lerobot
from mint_hub.loaders.location import Shard
from mint_hub.loaders.participants import group_of, participant_of
from mint_hub.loaders.reader import CorpusReader
from mint_hub.loaders.shards import split_of
from mint_hub.loaders.vitra import from_vitra
from tests.episodes import make_episode
from tests.lerobot_files import RootPlan, write_root
from tests.loaders.test_vitra import annotation

PEOPLE = ("P01", "P30", "P37")
"""Made up; by the law of ``split_of`` not all of them are on one side."""

UIDS = [f"{person}_{video:02d}" for person in PEOPLE for video in range(60)]


def sides(pairs):
    """The splits of each person, given (uid, split)."""
    found = {person: set() for person in PEOPLE}
    for uid, split in pairs:
        found[uid.split("_")[0]].add(split)
    return found


def test_the_example():
    assert doctest.testmod(participants).failed == 0


@pytest.mark.parametrize(
    ("source", "uid", "expected"),
    [
        ("epic", "P01_101", "P01"),
        ("EPIC-KITCHENS-100", "P01/videos/p01_101.MP4", "P01"),
        ("hot3d", "P0003_c701bd11", "P0003"),
        ("hot3d", "P03_c701bd11", None),
        ("egodex", "P01_101", None),
        ("epic", "videos/observation.images.ego/chunk-000/file-000", None),
        ("epic", None, None),
        (None, "P01_101", None),
    ],
)
def test_names_tell_where_a_source_names_videos_so(source, uid, expected):
    assert participant_of(source, uid) == expected
    assert participant_of(source, uid, "somebody") == "somebody"


def test_the_law_alone_would_part_them():
    """Without participants these very names are on both sides: the tests below can fail."""
    assert any(len(s) == 2 for s in sides((u, split_of(u)) for u in UIDS).values())
    people = {person: split_of("", person) for person in PEOPLE}
    assert set(people.values()) == {"train", "validation"}


def epic_root(folder):
    lengths = (4,) * len(UIDS)
    plan = RootPlan(lengths, source="epic", per_file=99, episode_columns={"video_uid": UIDS})
    write_root(folder, plan)
    return folder


def test_lerobot_roots_read_directly_and_converted(tmp_path):
    root = epic_root(tmp_path / "epic")
    read = {e.key: e for e in from_lerobot(root)}
    assert {e.meta["participant"] for e in read.values()} == set(PEOPLE)
    got = []
    for split in ("train", "validation"):
        rows = builder._lerobot_rows(Shard(str(root), split), None)
        got += [(json.loads(row["meta"])["uid"], split) for row in rows]
    assert sorted(uid for uid, _ in got) == sorted(UIDS)
    expected = {person: {split_of("", person)} for person in PEOPLE}
    assert sides(got) == expected
    parts = {}
    for split in ("train", "validation"):
        source = LeRobotSlices([root], lambda *group, s=split: split_of(*group) == s)
        kept = [e for part in source for e in source.read_slice(part)]
        parts |= {e.meta["uid"]: split for e in kept}
    assert dict(got) == parts


def test_our_own_exports_that_never_said_a_participant(tmp_path):
    metas = [{"uid": uid, "source": "epic"} for uid in UIDS[:90]]
    made = [make_episode(4, seed=i, key=f"e-{i}", meta=m) for i, m in enumerate(metas)]
    to_lerobot(made, tmp_path / "root")
    source = LeRobotSlices([tmp_path / "root"], lambda uid, person: person == PEOPLE[0])
    assert sum(1 for part in source for _ in source.read_slice(part)) == 60


def test_vitra_on_the_command_line(tmp_path, capsys):
    paths = []
    for uid in UIDS[::20]:
        path = tmp_path / f"epic_{uid}_ep_000001.npy"
        fields = {**annotation(), "video_name": uid}
        np.save(path, np.array(fields, dtype=object), allow_pickle=True)
        assert from_vitra(path).meta["participant"] == uid.split("_")[0]
        paths.append(str(path))
    call = ["convert", "vitra", *paths, "-o", str(tmp_path / "c"), "--config", "epic", "--quiet"]
    assert main(call) == 0
    found = [
        (episode.meta["uid"], split)
        for split in ("train", "validation")
        for episode in CorpusReader(tmp_path / "c", "epic", split)
    ]
    assert sorted(uid for uid, _ in found) == sorted(UIDS[::20])
    assert sides(found) == {person: {split_of("", person)} for person in PEOPLE}


def test_labelled_videos(tmp_path):
    for uid in UIDS:
        place = tmp_path / "videos" / uid
        place.mkdir(parents=True)
        account = {"source": "epic", "uid": uid, "episodes": [f"{uid}-0"]}
        (place / beside.ACCOUNT).write_text(json.dumps(account))
    books = _Books(tmp_path, None, False)  # the stages are not asked
    files = books.episode_files("epic", Changelog())
    found = [(path.stem.removesuffix("-0"), s) for s, paths in files.items() for path in paths]
    assert sides(found) == {person: {split_of("", person)} for person in PEOPLE}


def test_an_episode_without_a_video_is_a_group_by_itself():
    assert group_of({"source": "epic"}, "key") == ("key", None)
    assert group_of({"uid": "v", "participant": "p"}, "key") == ("v", "p")
