"""What sources.json says is complete, of the right types, and agrees with itself."""

import json
from pathlib import Path

import pytest

from mint_hub.cards.sources import CardError, Sources
from mint_hub.loaders.location import PARTS

FOLDER = Path(__file__).parents[2] / "dataset_card"


@pytest.fixture
def values():
    return json.loads((FOLDER / "sources.json").read_text(encoding="utf-8"))


def load(folder, values):
    (folder / "sources.json").write_text(json.dumps(values))
    return Sources.load(folder)


def test_ours_is_whole():
    made = Sources.load(FOLDER)
    assert tuple(source.config for source in made.sources) == PARTS
    assert sum(source.hours for source in made.sources) == pytest.approx(made.release.hours)
    assert made.release.frames / made.release.fps / 3600 == pytest.approx(made.release.hours, 1e-6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda v: v["release"].update(hours=1022.0), "hours: expected 1022.0 over all sources"),
        (lambda v: v["release"].update(frames=110_000_000), "frames: expected 1021.514 h"),
        (lambda v: v["release"].update(frames="many"), "release, frames: expected int, got 'many'"),
        (lambda v: v["release"].update(frames=True), "release, frames: expected int, got True"),
        (lambda v: v["release"].pop("cited"), r"release: expected an object with \['cited'"),
        (lambda v: v["sources"].pop(), r"expected configs \['ego4d', 'epic', 'egodex'\], got"),
        (lambda v: v["sources"][0].update(episodes=1.5), "expected int or NoneType, got 1.5"),
        (lambda v: v["sources"][1].update(known="x"), r"sources\[1\], known: expected a list"),
        (lambda v: v.update(sources={}), "sources: expected a list, got dict"),
        (lambda v: v.update(more=1), r"expected an object with \['release', 'sources'\], got"),
    ],
)
def test_errors_teach(tmp_path, values, change, message):
    load(tmp_path, values)
    change(values)
    with pytest.raises(CardError, match=message):
        load(tmp_path, values)


def test_no_json_and_no_file_are_named(tmp_path):
    with pytest.raises(CardError, match=r"sources\.json: expected this file, got none"):
        Sources.load(tmp_path)
    (tmp_path / "sources.json").write_text("[")
    with pytest.raises(CardError, match=r"sources\.json: expected JSON"):
        Sources.load(tmp_path)
    (tmp_path / "sources.json").write_text("[]")
    with pytest.raises(CardError, match=r"expected an object with .*, got \[\]"):
        Sources.load(tmp_path)
