"""Withdrawn videos are gone from every split, all else is as it was, and a kill loses nothing."""

import os
import shutil

import pytest

from mint_hub.loaders.card import write_card
from mint_hub.loaders.changelog import Changelog
from mint_hub.loaders.integrity import verify
from mint_hub.loaders.manifest import read_manifest, split_folders
from mint_hub.loaders.reader import CorpusReader
from mint_hub.loaders.shards import write_corpus
from mint_hub.loaders.stats import read_stats
from mint_hub.loaders.tar_layout import CorpusError
from mint_hub.loaders.withdraw import withdraw
from tests.episodes import make_episode

DAY = "2026-01-31"


def episode(video: int, part: int, source: str = "made"):
    key = f"{source}-v{video}-{part}"
    meta = {"uid": f"v{video}", "source": source}
    return make_episode(20 + video, seed=10 * video + part, key=key, meta=meta)


ALL = [episode(video, part) for video in range(4) for part in range(3)]


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """Four videos of three episodes; two episodes a shard; the last video is all of validation."""
    root = tmp_path_factory.mktemp("corpus")
    write_corpus(ALL[:9], root, "made", "train", seed=None, shard_bytes=30_000)
    write_corpus(ALL[9:], root, "made", "validation", seed=None)
    write_corpus(ALL[:6], root, "exact", "train", format="lossless", extra=True)
    write_card(root, default="made")
    return root


@pytest.fixture
def corpus(written, tmp_path):
    return shutil.copytree(written, tmp_path / "corpus")


def tree(root):
    return {str(p.relative_to(root)): p.read_bytes() for p in root.rglob("*") if p.is_file()}


def test_all_else_stays(corpus):
    before = CorpusReader(corpus, "made", "train")
    kept = [before[i] for i in range(len(before)) if before[i].meta["uid"] != "v1"]
    shards = {s.name: s.sha256 for s in read_manifest(corpus / "made/train").shards}
    assert len(shards) > 3
    report = withdraw(corpus, ["v1"], "asked for", date=DAY)
    assert report.episodes == {"exact/train": 3, "made/train": 3}
    assert report.removed_splits == ()
    after = CorpusReader(corpus, "made", "train")
    assert [after[i].key for i in range(len(after))] == [e.key for e in kept]
    assert all(after[i].allclose(e) for i, e in enumerate(kept))
    now = {s.name: s.sha256 for s in read_manifest(corpus / "made/train").shards}
    assert set(now) <= set(shards)
    assert 0 < sum(now[name] == shards[name] for name in now) < len(now)
    assert verify(corpus, "full").ok


def test_nothing_of_the_video_is_left(corpus):
    assert any(b"v2" in data for name, data in tree(corpus).items() if name.endswith(".tar"))
    withdraw(corpus, ["v2"], "asked for", date=DAY)
    for name, data in tree(corpus).items():
        if name.endswith((".tar", ".parquet")):
            assert b"made-v2" not in data, name


def test_tombstones_are_in_changelog_manifest_and_card(corpus):
    withdraw(corpus, ["v1", "v0"], "asked | for", date=DAY)
    stones = Changelog.load(corpus).withdrawn
    assert [(t.source, t.uid, t.date, t.reason) for t in stones] == [
        ("made", "v0", DAY, "asked | for"),
        ("made", "v1", DAY, "asked | for"),
    ]
    assert stones[0].episodes == {"exact/train": 3, "made/train": 3}
    assert read_manifest(corpus / "made/train").spec["withdrawn"] == ["v0", "v1"]
    assert "withdrawn" not in read_manifest(corpus / "made/validation").spec
    text = (corpus / "README.md").read_text()
    row = f"| {DAY} | made | v0 | exact/train: 3, made/train: 3 | asked \\| for |"
    assert row in text
    assert "| made | train | compact | 3 |" in text


def test_statistics_are_of_what_is_left(corpus):
    withdraw(corpus, ["v1"], "asked for", date=DAY)
    manifest = read_manifest(corpus / "made/train")
    stats = read_stats(corpus / "made", "train", manifest.content)
    assert stats["made"]["camera"]["fov_vh"]["count"] == manifest.num_frames == 3 * (20 + 22)


def test_a_split_without_episodes_goes(corpus):
    report = withdraw(corpus, ["v3"], "asked for", date=DAY)
    assert report.removed_splits == ("made/validation",)
    assert not (corpus / "made/validation").exists()
    assert verify(corpus, "full").ok
    head = (corpus / "README.md").read_text()
    assert "validation/*.tar" not in head
    assert "default: true" in head, "the card keeps its default config"
    withdraw(corpus, ["v0", "v1"], "asked for", date=DAY)
    assert not (corpus / "exact/stats.json").exists()
    assert [p.name for p in split_folders(corpus)] == ["train"]
    assert verify(corpus, "full").ok
    before = tree(corpus)
    assert withdraw(corpus, ["v0", "v3"], "again", date="2026-02-01").episodes == {}
    assert tree(corpus) == before


def test_a_kill_at_any_rename_is_mended_by_the_next_call(written, tmp_path, monkeypatch):
    """The n-th file operation fails, for every n; the corpus after the next call is the same."""
    small = shutil.copytree(written, tmp_path / "small", ignore=shutil.ignore_patterns("exact"))
    whole = shutil.copytree(small, tmp_path / "whole")
    uids = ["v1", "v3"]
    withdraw(whole, uids, "asked for", date=DAY)
    replaced, removed = os.replace, shutil.rmtree
    kills = 0
    for number in range(100):
        root = shutil.copytree(small, tmp_path / f"killed-{number}")
        left = [number]

        def failing(real, left=left):
            def call(*args, **kwargs):
                left[0] -= 1
                if left[0] < 0:
                    raise KeyboardInterrupt
                return real(*args, **kwargs)

            return call

        with monkeypatch.context() as patch:
            patch.setattr("mint_hub.loaders.withdraw.os.replace", failing(replaced))
            patch.setattr("mint_hub.loaders.withdraw.shutil.rmtree", failing(removed))
            try:
                withdraw(root, uids, "asked for", date=DAY)
                break
            except KeyboardInterrupt:
                kills += 1
        for split in split_folders(root):
            bad = {f.path.split("/")[-1] for f in verify(split, "full").files if f.status != "ok"}
            assert bad <= {"stats.json", "train", "validation"}, f"{split}: mixture, kill {number}"
        withdraw(root, uids, "asked for", date=DAY)
        assert not list(root.glob("*/*.withdrawing")), f"after kill {number}"
        left_over = {n for n in tree(root) if n.startswith(".") or "/." in n}  # of one write
        assert {n: d for n, d in tree(root).items() if n not in left_over} == tree(whole)
    assert kills > 8


def test_errors_teach_and_change_nothing(corpus):
    before = tree(corpus)
    cases = [
        ({"uids": ["v9"]}, r"expected videos of .*, got 'v9', which is none"),
        ({"uids": ["v1"], "source": "ego4d"}, r"source ego4d, got 'v1', which is none"),
        ({"uids": []}, "uids: expected names of videos"),
        ({"uids": ["v1"], "date": "today"}, "date: expected a date such as"),
        ({"uids": ["v0", "v1", "v2", "v3"]}, "expected an episode to remain, got none"),
    ]
    for arguments, message in cases:
        with pytest.raises(CorpusError, match=message):
            withdraw(corpus, **{"reason": "asked for", **arguments})
    with pytest.raises(CorpusError, match="expected a corpus, with <config>/<split> below it"):
        withdraw(corpus / "made", ["v1"], "asked for")
    assert tree(corpus) == before


def test_one_name_in_two_sources(corpus):
    write_corpus([episode(1, 0, "other"), episode(5, 0, "other")], corpus, "other", "train")
    with pytest.raises(CorpusError, match=r"expected one of \['made', 'other'\], which all have"):
        withdraw(corpus, ["v1"], "asked for")
    report = withdraw(corpus, ["v1"], "asked for", source="other")
    assert report.episodes == {"other/train": 1}
    assert len(CorpusReader(corpus, "made", "train")) == 9


def test_a_damaged_shard_does_not_pass_as_whole(corpus):
    shard = sorted((corpus / "exact/train").glob("*.tar"))[0]
    data = bytearray(shard.read_bytes())
    data[len(data) // 2] ^= 1
    shard.write_bytes(data)
    before = tree(corpus)
    with pytest.raises(CorpusError, match="expected the bytes that were written: run verify"):
        withdraw(corpus, ["v1"], "asked for")
    assert tree(corpus) == before


def test_an_unfinished_split_is_refused(corpus):
    (corpus / "made/.extra.partial").mkdir()
    with pytest.raises(CorpusError, match="would bring withdrawn videos back"):
        withdraw(corpus, ["v1"], "asked for")
