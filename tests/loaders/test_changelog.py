"""The changelog as data: what is saved is loaded, and what is wrong is named."""

import json

import pytest

from mint_hub.loaders.changelog import Change, Changelog, Tombstone
from mint_hub.loaders.tar_layout import CorpusError

LOG = Changelog(
    (Change("2026-01-31", "0.2", "more | text\nin two lines"),),
    (Tombstone("ego4d", "a-1", "2026-01-30", "asked for by its owner", {"ego4d/train": 3}),),
)


def test_round_trip(tmp_path):
    path = LOG.save(tmp_path)
    assert Changelog.load(tmp_path) == LOG
    before = path.read_bytes()
    Changelog.load(tmp_path).save(tmp_path)
    assert path.read_bytes() == before


def test_none_is_empty(tmp_path):
    assert Changelog.load(tmp_path) == Changelog()


def test_a_video_is_known_by_source_and_uid():
    assert LOG.has("a-1")
    assert LOG.has("a-1", "ego4d")
    assert not LOG.has("a-1", "epic")
    assert not LOG.has("a-2")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda v: v.pop("changes"), r"expected an object with \['changes', 'withdrawn'\]"),
        (lambda v: v.update(changes={}), "changes: expected a list, got dict"),
        (
            lambda v: v["changes"][0].update(date="31.1.2026"),
            r"changes\[0\], date: expected a date",
        ),
        (lambda v: v["changes"][0].update(date="20260131"), r"changes\[0\], date: expected a date"),
        (lambda v: v["changes"][0].update(text=3), r"changes\[0\], text: expected text, got 3"),
        (lambda v: v["withdrawn"][0].pop("reason"), r"withdrawn\[0\]: expected an object with"),
        (
            lambda v: v["withdrawn"][0].update(episodes={"a/b": 0}),
            r"withdrawn\[0\], episodes: expected counts by split, got \{'a/b': 0\}",
        ),
        (lambda v: v["withdrawn"][0].update(episodes=[1]), r"episodes: expected counts by split"),
    ],
)
def test_errors_teach(tmp_path, change, message):
    path = LOG.save(tmp_path)
    values = json.loads(path.read_text())
    change(values)
    path.write_text(json.dumps(values))
    with pytest.raises(CorpusError, match=message):
        Changelog.load(tmp_path)


def test_no_json_is_named(tmp_path):
    (tmp_path / "changelog.json").write_text("{")
    with pytest.raises(CorpusError, match=r"changelog\.json: expected JSON"):
        Changelog.load(tmp_path)
