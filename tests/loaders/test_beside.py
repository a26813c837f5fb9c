"""What lies beside the shards goes with its video, stays away, and is verified."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mint_hub.loaders.beside import (
    ACCOUNT,
    HAND_ANNOTATIONS,
    LABELLING,
    keep_annotation,
    labels_beside,
)
from mint_hub.loaders.changelog import CHANGELOG, Changelog
from mint_hub.loaders.hot3d_hands import Hot3DHands
from mint_hub.loaders.integrity import verify
from mint_hub.loaders.shards import write_corpus
from mint_hub.loaders.tar_layout import CorpusError
from mint_hub.loaders.withdraw import _Split, withdraw
from tests.corpus_faults import tree
from tests.episodes import make_episode

DAY = "2026-01-31"


def hands_of(uid):
    stamps = np.arange(3, dtype=np.int64)
    rng = np.random.default_rng(0)
    numbers = [rng.normal(size=(3, 2, n)) for n in (15, 3, 4, 10)]
    return Hot3DHands(stamps, np.ones((3, 2), bool), *numbers, uid=uid)


def label(root, key, uid, source="made"):
    """As much as `label_videos` leaves of a video."""
    folder = root / LABELLING
    place = folder / "videos" / key
    for part in (place / "episodes", folder / "work" / key, folder / "review" / f"{key}-0"):
        part.mkdir(parents=True)
        (part / "file").write_text(f"what is known of {uid}")
    account = {"source": source, "uid": uid, "episodes": [f"{key}-0"]}
    (place / ACCOUNT).write_text(json.dumps(account))


@pytest.fixture
def corpus(tmp_path):
    root = tmp_path / "corpus"
    made = [
        make_episode(8, seed=i, key=f"e-{i}", meta={"uid": f"v{i}", "source": "hot3d"})
        for i in range(3)
    ]
    write_corpus(made, root, "made", "train", extra=True)
    for i in range(4):  # the last one's episodes are in no split
        keep_annotation(root, hands_of(f"v{i}"), f"e-{i}")
    label(root, "a", "v1", "hot3d")
    label(root, "a-0", "v2", "hot3d")
    return root


def of_video(root, *names):
    return {name: data for name, data in tree(root).items() if any(n in name for n in names)}


def test_the_video_is_remembered(corpus):
    path = corpus / HAND_ANNOTATIONS / "e-2.npz"
    assert Hot3DHands.load(path).uid == "v2"
    assert Hot3DHands.load(path).window(1, 2).uid == "v2"
    uids = {item.uid for item in labels_beside(corpus)}
    assert uids == {"v0", "v1", "v2", "v3"}


def test_all_labels_of_a_withdrawn_video_go_and_no_others(corpus):
    others = of_video(corpus, "e-0.npz", "e-2.npz", "e-3.npz", "videos/a-0", "work/a-0")
    report = withdraw(corpus, ["v1"], "asked for", date=DAY)
    assert sorted(report.beside) == [
        f"{HAND_ANNOTATIONS}/e-1.npz",
        f"{LABELLING}/review/a-0",
        f"{LABELLING}/videos/a/episodes",
        f"{LABELLING}/work/a",
    ]
    assert not [n for n, data in tree(corpus).items() if b"what is known of v1" in data]
    assert not (corpus / HAND_ANNOTATIONS / "e-1.npz").exists()
    assert {n: d for n, d in tree(corpus).items() if n in others} == others
    assert verify(corpus, "full").ok
    assert withdraw(corpus, ["v1"], "asked for", date=DAY).beside == ()


def test_they_are_not_written_again(corpus):
    withdraw(corpus, ["v1"], "asked for", date=DAY)
    assert keep_annotation(corpus, hands_of("v1"), "e-1") is None
    assert keep_annotation(corpus, hands_of("v1"), "other-key") is None
    assert keep_annotation(corpus, hands_of("v0"), "e-0") is not None
    assert "v1" not in {item.uid for item in labels_beside(corpus)}


def test_a_video_that_is_only_beside_the_shards_is_withdrawn_too(corpus):
    report = withdraw(corpus, ["v3"], "asked for", date=DAY)
    assert report.episodes == {}
    assert report.beside == (f"{HAND_ANNOTATIONS}/e-3.npz",)
    (stone,) = Changelog.load(corpus).withdrawn
    assert (stone.source, stone.uid, stone.episodes) == ("hot3d", "v3", {})


@pytest.mark.parametrize("moment", [(Path, "unlink"), (_Split, "rewrite")])
def test_a_killed_call_is_finished_by_the_next(corpus, monkeypatch, moment):
    def die(*_, **__):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(*moment, die)
        with pytest.raises(KeyboardInterrupt):
            withdraw(corpus, ["v1"], "asked for", date=DAY)
    assert Changelog.load(corpus).has("v1", "hot3d")
    assert withdraw(corpus, ["v1"], "asked for", date=DAY).episodes == {"made/train": 1}
    assert "v1" not in {item.uid for item in labels_beside(corpus)}
    assert len(Changelog.load(corpus).withdrawn) == 1


def test_another_sources_video_of_that_name_stays(corpus):
    label(corpus, "b", "v0", "mine")
    with pytest.raises(CorpusError, match=r"source: expected one of \['hot3d', 'mine'\]"):
        withdraw(corpus, ["v0"], "asked for", date=DAY)
    withdraw(corpus, ["v0"], "asked for", source="mine", date=DAY)
    assert (corpus / HAND_ANNOTATIONS / "e-0.npz").exists()
    assert not (corpus / LABELLING / "videos/b/episodes").exists()


def test_nobody_knows_whose_a_damaged_file_is(corpus):
    before = tree(corpus)
    path = corpus / HAND_ANNOTATIONS / "e-2.npz"
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(CorpusError, match=r"e-2\.npz: .*nobody can say whose"):
        withdraw(corpus, ["v1"], "asked for", date=DAY)
    (problem,) = verify(corpus).problems
    assert (problem.path, problem.status) == (f"{HAND_ANNOTATIONS}/e-2.npz", "checksum")
    path.write_bytes(before[f"{HAND_ANNOTATIONS}/e-2.npz"])
    assert tree(corpus) == before
    account = corpus / LABELLING / "videos/a" / ACCOUNT
    account.write_text("{}")
    with pytest.raises(CorpusError, match=r"account\.json: expected the account of a video"):
        withdraw(corpus, ["v1"], "asked for", date=DAY)


def test_verify_names_what_came_back_and_a_damaged_changelog(corpus):
    withdraw(corpus, ["v1"], "asked for", date=DAY)
    hands_of("v1").save(corpus / HAND_ANNOTATIONS / "copied.npz")
    replace(hands_of("v0"), uid="v9").save(corpus / HAND_ANNOTATIONS / "fine.npz")
    (problem,) = verify(corpus).problems
    assert (problem.path, problem.status) == (f"{HAND_ANNOTATIONS}/copied.npz", "extra")
    assert "'v1' is withdrawn" in problem.detail
    (corpus / CHANGELOG).write_text("[")
    assert CHANGELOG in [p.path for p in verify(corpus).problems]
