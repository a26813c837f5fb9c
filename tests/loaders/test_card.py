"""The card of a corpus: stock `load_dataset` reads the folder by it, and a person's text stays."""

import numpy as np
import pytest

from mint_hub.loaders.card import write_card
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
