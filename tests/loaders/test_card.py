"""The card of a corpus: stock `load_dataset` reads the folder by it, and a person's text stays."""

import numpy as np
import pytest
import yaml

from mint_hub.loaders.card import FACTS_BEGIN, FACTS_END, write_card
from mint_hub.loaders.changelog import Changelog, Tombstone
from mint_hub.loaders.shards import write_corpus
from mint_hub.loaders.tar_layout import CorpusError
from tests.episodes import make_episode


@pytest.fixture
def corpus(tmp_path):
    episodes = [make_episode(20 + i, seed=i, key=f"e-{i}") for i in range(3)]
    write_corpus(episodes, tmp_path, "small", "train")
    write_corpus(episodes[:1], tmp_path, "small", "validation")
    write_corpus(episodes, tmp_path, "exact", "train", format="lossless", extra=True)
    return tmp_path


def test_stock_datasets_reads_the_folder(corpus, tmp_path_factory, monkeypatch):
    import datasets

    write_card(corpus, default="small")
    cache = str(tmp_path_factory.mktemp("cache"))
    table = datasets.load_dataset(str(corpus), cache_dir=cache)
    assert {name: part.num_rows for name, part in table.items()} == {"train": 3, "validation": 1}
    row = table["train"].with_format("numpy")[0]
    assert row["traj.npy"].dtype == np.float32
    assert row["rot6d.npy"].shape[1] == 192
    exact = datasets.load_dataset(str(corpus), "exact", split="train", cache_dir=cache)
    assert exact.with_format("numpy")[0]["state.npy"].shape[1] == 218


def test_text_of_a_person_stays(corpus):
    (corpus / "README.md").write_text("---\nlicense: apache-2.0\n---\n# Mine\n")
    path = write_card(corpus)
    assert path.read_text().endswith("---\n# Mine\n")
    assert "license: apache-2.0" in path.read_text()
    before = path.read_bytes()
    assert write_card(corpus).read_bytes() == before


def test_text_counts_what_is_there(corpus):
    text = write_card(corpus).read_text()
    assert "| small | train | compact | 3 | 63 | 0.001 |" in text
    assert "default: true" not in text, "with several configs none is chosen by itself"


def test_errors_teach(tmp_path, corpus):
    (tmp_path / "empty").mkdir()
    with pytest.raises(CorpusError, match="found none"):
        write_card(tmp_path / "empty")
    with pytest.raises(CorpusError, match=r"expected one of \['exact', 'small'\], got 'big'"):
        write_card(corpus, default="big")


def test_facts_are_renewed_and_words_around_them_stay(corpus):
    path = write_card(corpus)
    before, _, rest = path.read_text().partition(FACTS_BEGIN)
    path.write_text(f"{before}\nMy words.\n{FACTS_BEGIN}{rest}\nMore of mine.\n")
    write_corpus([make_episode(25, seed=9, key="e-9")], corpus, "new", "train")
    text = write_card(corpus).read_text()
    assert "| new | train | compact | 1 | 25 |" in text
    assert text.count(FACTS_BEGIN) == text.count(FACTS_END) == 1
    assert text.index("My words.") < text.index(FACTS_BEGIN) < text.index("More of mine.")


def test_default_that_was_chosen_stays(corpus):
    write_card(corpus, default="small")
    data = yaml.safe_load(write_card(corpus).read_text().split("---\n")[1])
    assert [c["config_name"] for c in data["configs"] if c.get("default")] == ["small"]


def test_statistics_say_where_hands_are(corpus):
    episodes = [make_episode(20 + i, seed=i, key=f"e-{i}") for i in range(3)]
    depth = np.concatenate([e.hand_state[e.presence[:, 0], 0, 2] for e in episodes])
    share = np.concatenate([e.presence[:, 0] for e in episodes]).mean()
    text = write_card(corpus).read_text()
    row = next(r for r in text.splitlines() if r.startswith("| small | train | synthetic | left |"))
    assert f"| {share:.1%} |" in row
    middle = float(row.split("|")[-2].split("/")[1])
    assert middle == pytest.approx(np.median(depth), abs=0.01)


def test_withdrawn_videos_are_named_in_a_persons_text_too(corpus):
    (corpus / "README.md").write_text("# Mine\n")
    Changelog((), (Tombstone("s", "u", "2026-01-31", "why", {"small/train": 1}),)).save(corpus)
    text = write_card(corpus).read_text()
    assert "# Mine\n" in text
    assert "| 2026-01-31 | s | u | small/train: 1 | why |" in text
    assert write_card(corpus).read_text() == text


def test_statistics_of_other_shards_are_refused(corpus):
    (corpus / "small/stats.json").unlink()
    with pytest.raises(CorpusError, match=r"stats\.json: expected this file, got none"):
        write_card(corpus)
