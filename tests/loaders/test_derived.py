import doctest
import io
import json
import re
import tarfile
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from datasets import Dataset, Features, load_dataset

from mint_hub.loaders import derived, lerobot_columns, member_table
from mint_hub.loaders.derived import (
    CardConfig,
    card_data,
    card_yaml,
    dataset_features,
    episode_features,
    lerobot_features,
    meta_json_schema,
    schema_table,
)
from mint_hub.loaders.member_table import MEMBERS, META, ROT6D, TRAJ, Member, member_names
from mint_hub.loaders.members import arrays_of, encode
from mint_hub.loaders.meta_member import META_FIELDS, canonical_json
from mint_hub.loaders.schema import ARRAY_FIELDS, Episode, EpisodeError, TextSegment
from tests.episodes import make_episode

FORMATS = [(f, x, p) for f in ("compact", "lossless") for x in (False, True) for p in (False, True)]


def declared(name: str) -> Member:
    return next(m for m in member_table.MEMBERS if m.name == name)


def rounded(value: Any) -> Any:
    """Return a JSON value with 9 decimals: the library's Json columns keep 10."""
    if isinstance(value, dict):
        return {name: rounded(item) for name, item in value.items()}
    if isinstance(value, list):
        return [rounded(item) for item in value]
    return round(value, 9) if isinstance(value, float) else value


# ------------------------------------------------------------------------------- datasets


@pytest.mark.parametrize(("format", "extra", "packed"), FORMATS)
def test_features_are_the_members(format, extra, packed):
    features = dataset_features(format, extra, packed).to_dict()
    names = [*member_names(format, extra), *(["mp4"] if packed else []), "__key__"]
    assert list(features) == names
    assert features[META] == {"_type": "Json"}
    for name in names:
        if name.endswith(".npy"):
            spec = declared(name)
            shape = (None, sum(c.width for c in spec.columns))
            assert features[name] == {"shape": shape, "dtype": spec.dtype, "_type": "Array2D"}
    if packed:
        assert features["mp4"] == {"decode": False, "_type": "Video"}


@pytest.mark.parametrize("packed", [False, True])
def test_public_features_are_the_fields_of_an_episode(packed):
    features = episode_features(packed).to_dict()
    public = {f.name for f in fields(Episode)} | ({"video"} if packed else set())
    assert features.keys() == public
    for spec in ARRAY_FIELDS:
        feature = features[spec.name]
        if len(spec.shape) == 1:
            assert feature["feature"]["dtype"] == spec.dtype
        else:
            sizes = tuple(None if n == "T" else n for n in spec.shape)
            assert (feature["shape"], feature["dtype"]) == (sizes, spec.dtype)
    assert list(features["text"]["feature"]) == [f.name for f in fields(TextSegment)]


def test_an_episode_is_a_row_of_the_public_features():
    made = make_episode(9)
    made = replace(made, filled=made.presence & (np.arange(9) % 2 == 0)[:, None])
    row = made.to_dict()
    del row["schema_version"]
    plain = Dataset.from_list([row], features=episode_features())[0]
    for spec in ARRAY_FIELDS:
        back = np.asarray(plain[spec.name], spec.dtype)
        np.testing.assert_array_equal(back, row[spec.name])
    assert plain["text"] == row["text"]
    assert rounded(plain["meta"]) == rounded(row["meta"])


# ----------------------------------------------------------------------------------- card


CONFIGS = [
    CardConfig("ego4d", default=True, splits=("train",)),
    CardConfig("lossless", format="lossless", extra=True),
    CardConfig("pixels", packed=True),
    CardConfig("all", folders=("ego4d", "pixels")),
]


def test_card_features_are_the_dataset_features():
    data = yaml.safe_load(card_yaml(CONFIGS))
    assert data == card_data(CONFIGS)
    for config, info in zip(CONFIGS, data["dataset_info"], strict=True):
        assert info["config_name"] == config.name
        features = Features._from_yaml_list(info["features"])
        assert features == dataset_features(config.format, config.extra, config.packed)
    assert [c.get("default", False) for c in data["configs"]] == [True, False, False, False]
    assert data["configs"][3]["data_files"][1] == {
        "split": "validation",
        "path": ["ego4d/validation/*.tar", "pixels/validation/*.tar"],
    }


def test_cards_that_contradict_themselves_are_refused():
    with pytest.raises(EpisodeError, match="expected every name once, got 'a' twice"):
        card_data([CardConfig("a"), CardConfig("a")])
    with pytest.raises(EpisodeError, match=r"at most one default, got \['a', 'b'\]"):
        card_data([CardConfig("a", default=True), CardConfig("b", default=True)])


def write_tar(path: Path, samples: dict[str, dict[str, bytes]]) -> None:
    path.parent.mkdir(parents=True)
    with tarfile.open(path, "w") as archive:
        for key, parts in samples.items():
            for name, data in parts.items():
                entry = tarfile.TarInfo(f"{key}.{name}")
                entry.size = len(data)
                archive.addfile(entry, io.BytesIO(data))


@pytest.mark.parametrize("streaming", [False, True])
@pytest.mark.parametrize(("format", "extra", "packed"), [FORMATS[0], FORMATS[7]])
def test_stock_datasets_reads_a_folder_with_the_card(tmp_path, format, extra, packed, streaming):
    samples = {}
    for k in range(3):
        made = make_episode(5 + k, k, key=f"episode-{k}")
        clip = {"mp4": b"clip %d" % k} if packed else {}
        samples[made.key] = {**encode(made, format, extra), **clip}
    write_tar(tmp_path / "corpus" / "mine" / "train" / "mine-train-00000.tar", samples)
    config = CardConfig("mine", format, extra, packed, splits=("train",), default=True)
    (tmp_path / "corpus" / "README.md").write_text(f"---\n{card_yaml([config])}---\n# card\n")
    rows = load_dataset(
        str(tmp_path / "corpus"), split="train", streaming=streaming, cache_dir=str(tmp_path / "c")
    )
    assert rows.features == dataset_features(format, extra, packed)
    seen = list(rows)
    assert [row["__key__"] for row in seen] == list(samples)
    for row in seen:
        parts = samples[row["__key__"]]
        assert rounded(row[META]) == rounded(json.loads(parts[META]))
        for name, array in arrays_of(parts).items():
            np.testing.assert_array_equal(np.asarray(row[name], array.dtype), array)
        if packed:
            assert row["mp4"]["bytes"] == parts["mp4"]


# ---------------------------------------------------------------------------- JSON schema


def complaints(value: Any, schema: dict[str, Any], place: str = "") -> list[str]:
    """What a JSON schema (the part of it that ours uses) says against a value."""
    known = {"$schema", "title", "description", "type", "enum", "pattern", "minimum", "maximum"}
    known |= {"exclusiveMinimum", "items", "minItems", "maxItems", "properties", "required"}
    assert schema.keys() <= known | {"additionalProperties"}
    number = isinstance(value, int | float) and not isinstance(value, bool)
    types = {
        "string": isinstance(value, str),
        "number": number,
        "integer": number and value == int(value),
        "array": isinstance(value, list),
        "object": isinstance(value, dict),
        "null": value is None,
    }
    wanted = schema.get("type", list(types))
    wanted = [wanted] if isinstance(wanted, str) else wanted
    if "type" in schema and not any(types[name] for name in wanted):
        return [f"{place}: not {wanted}"]
    found = []
    found += [f"{place}: enum"] if "enum" in schema and value not in schema["enum"] else []
    ends = schema.get("pattern", "").replace("$", r"\Z")  # as in ECMAScript, whose $ is strict
    if isinstance(value, str) and not re.search(ends, value):
        found.append(f"{place}: pattern")
    if number:
        inside = schema.get("minimum", value) <= value <= schema.get("maximum", value)
        found += [] if inside else [f"{place}: range"]
        if "exclusiveMinimum" in schema and value <= schema["exclusiveMinimum"]:
            found.append(f"{place}: range")
    if isinstance(value, list):
        size = schema.get("minItems", 0) <= len(value) <= schema.get("maxItems", len(value))
        found += [] if size else [f"{place}: length"]
        for item in value:
            found += complaints(item, schema.get("items", {}), f"{place}[]")
    if isinstance(value, dict) and "properties" in schema:
        properties = schema["properties"]
        found += [f"{place}: lacks {n}" for n in schema["required"] if n not in value]
        found += [f"{place}: has {n}" for n in value if n not in properties]
        for name in value.keys() & properties.keys():
            found += complaints(value[name], properties[name], f"{place}.{name}")
    return found


def test_the_json_schema_has_the_declared_entries():
    schema = meta_json_schema()
    names = [field.name for field in META_FIELDS]
    assert list(schema["properties"]) == schema["required"] == names
    assert schema["additionalProperties"] is False
    for field in META_FIELDS:
        kind = schema["properties"][field.name].get("type")
        if field.kind == "any":
            assert kind is None
        else:
            assert kind == ([field.kind, "null"] if field.optional else field.kind)
    segment = schema["properties"]["text"]["items"]
    assert list(segment["properties"]) == [f.name for f in fields(TextSegment)]
    assert json.loads(json.dumps(schema)) == schema


@pytest.mark.parametrize("format", ["compact", "lossless"])
def test_real_members_satisfy_the_json_schema(format):
    for seed in range(3):
        data = encode(make_episode(12, seed), format)[META]
        assert complaints(json.loads(data), meta_json_schema()) == []


@pytest.mark.parametrize(
    ("entries", "expected"),
    [
        ({"key": "a.b"}, ".key: pattern"),
        ({"key": "a\n"}, ".key: pattern"),
        ({"schema_version": 99}, ".schema_version: range"),
        ({"schema_version": 0}, ".schema_version: range"),
        ({"format": "zip"}, ".format: enum"),
        ({"num_frames": 0}, ".num_frames: range"),
        ({"fps": 0.0}, ".fps: range"),
        ({"fps": None}, ".fps: not ['number']"),
        ({"image_size_hw": [480]}, ".image_size_hw: length"),
        ({"shape": [[0.0] * 9, [0.0] * 10]}, ".shape[]: length"),
        ({"text": [{"id": "x"}]}, ".text[]: lacks text"),
        ({"uid": 7}, ".uid: not ['string', 'null']"),
        ({"surprise": 1}, ": has surprise"),
    ],
)
def test_the_json_schema_refuses_what_the_reader_refuses(entries, expected):
    from mint_hub.loaders.members import decode_meta

    values = {**json.loads(encode(make_episode(4))[META]), **entries}
    assert expected in complaints(values, meta_json_schema())
    with pytest.raises(EpisodeError):
        decode_meta(canonical_json(values))


# ------------------------------------------------------------------------ LeRobot, tables


def test_the_lerobot_table_is_that_of_the_converter():
    columns = lerobot_columns.LABELS["camera"]
    assert lerobot_features() == {c.name: c.feature() for c in columns}


def test_the_lerobot_table_holds_every_number_of_a_lossless_sample():
    widths = {name: f["shape"][0] for name, f in lerobot_features().items()}
    hand = sum(width for name, width in widths.items() if "_mano_" in name)
    camera = sum(width for name, width in widths.items() if name.startswith("cam_"))
    assert hand == declared("state.npy").width
    assert camera == declared(TRAJ).slices["fov_vh"].stop


def cells(table: str) -> list[list[str]]:
    lines = [line.strip("|\n ").split(" | ") for line in table.splitlines()]
    return [[cell.strip() for cell in line] for line in lines[2:]]


def test_the_tables_list_every_declaration_once():
    rows = cells(schema_table())
    assert sorted((row[0], row[2]) for row in rows) == sorted(
        (f"`{m.name}`", f"`{c.name}`") for m in MEMBERS for c in m.columns
    )
    for m in MEMBERS:
        last = [row for row in rows if row[0] == f"`{m.name}`"][-1]
        assert last[1] == m.dtype
        assert last[3].endswith(f":{m.width}")
    assert {row[0] for row in cells(schema_table(format="compact"))} == {
        "`traj.npy`",
        "`rot6d.npy`",
        "`extra.npy`",
    }
    assert [row[0] for row in cells(schema_table("json"))] == [f"`{f.name}`" for f in META_FIELDS]
    arrays = cells(schema_table("episode"))
    assert [row[0] for row in arrays] == [f"`{f.name}`" for f in ARRAY_FIELDS]
    assert arrays[3][2] == "(T, 2, 109)"


def test_everything_follows_a_changed_width(monkeypatch):
    """Were a width said twice, one of these would keep the old one."""
    before = (dataset_features(), card_yaml(CONFIGS), schema_table(), lerobot_features())
    for name, column in ((ROT6D, "left_joints"), (TRAJ, "fov_vh")):
        spec = declared(name)
        wider = tuple(
            replace(c, width=c.width + 1) if c.name == column else c for c in spec.columns
        )
        monkeypatch.setitem(member_table._BY_NAME, name, replace(spec, columns=wider))
    after = (dataset_features(), card_yaml(CONFIGS), schema_table(), lerobot_features())
    for old, new in zip(before, after, strict=True):
        assert old != new
    assert after[0][ROT6D].shape == (None, 193)
    assert "- 18\n" in after[1]
    assert "| 6:97 |" in after[2]
    assert after[3]["cam_fov"]["shape"] == [3]


def test_the_examples_in_the_docs_hold():
    assert doctest.testmod(derived).failed == 0
