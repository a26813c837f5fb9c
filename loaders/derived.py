"""What follows from the schema: dataset features, card YAML, JSON schema, LeRobot table, tables.

Widths, dtypes and names are not said again here: arrays of an episode come from ARRAY_FIELDS,
members of a sample from MEMBERS, entries of ``json`` from META_FIELDS.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, Final, Literal

from mint_hub.conventions import SIDES
from mint_hub.geometry import hand_state as hands
from mint_hub.loaders.fields import ARRAY_FIELDS, KEY_PATTERN, EpisodeError, TextSegment
from mint_hub.loaders.member_table import META, STATE, TRAJ, Column, Format, member, member_names
from mint_hub.loaders.meta_member import META_FIELDS, MetaField
from mint_hub.loaders.schema import SCHEMA_VERSION

if TYPE_CHECKING:
    from datasets import Features

KEY_COLUMN: Final = "__key__"
"""What stock ``datasets`` calls the key of a sample."""

VIDEO_MEMBER: Final = "mp4"
VIDEO_COLUMN: Final = "video"
"""The clip of a packed config: its member, and its column among the public ones."""

SPLITS: Final = ("train", "validation")


# ------------------------------------------------------------------------------ datasets


def dataset_features(
    format: Format = "compact", extra: bool = False, packed: bool = False
) -> "Features":
    """Return the features under which stock ``datasets`` reads the tars, one column a member.

    Declared arrays are read several times faster than inferred ones, and no member is lost. With
    ``packed`` the clip is a column of undecoded bytes.

    Raises:
        EpisodeError: another format.

    """
    from datasets import Array2D, Features, Json, Value, Video

    columns: dict[str, Any] = {}
    for name in member_names(format, extra):
        if name == META:
            columns[name] = Json()
        else:
            spec = member(name)
            columns[name] = Array2D((None, spec.width), spec.dtype)
    if packed:
        columns[VIDEO_MEMBER] = Video(decode=False)
    return Features({**columns, KEY_COLUMN: Value("string")})


def episode_features(packed: bool = False) -> "Features":
    """Return the features of rows whose columns are the public fields of ``Episode``.

    An array that an episode does not have is a (0, 2) array. With ``packed`` the clip is "video".
    """
    from datasets import Array2D, Array3D, Features, Json, List, Value, Video

    columns: dict[str, Any] = {"key": Value("string")}
    for spec in ARRAY_FIELDS:
        sizes = tuple(None if size == "T" else size for size in spec.shape)
        if len(sizes) == 1:
            columns[spec.name] = List(Value(spec.dtype))
        else:
            columns[spec.name] = {2: Array2D, 3: Array3D}[len(sizes)](sizes, spec.dtype)
    columns["image_size_hw"] = List(Value("int32"), length=2)
    columns["text"] = List({f.name: Value(_SEGMENT_DTYPES[f.name]) for f in fields(TextSegment)})
    columns["meta"] = Json()
    if packed:
        columns[VIDEO_COLUMN] = Video(decode=False)
    return Features(columns)


_SEGMENT_DTYPES: Final = {
    "id": "string",
    "text": "string",
    "side": "string",
    "start": "int32",
    "end": "int32",
}


# ---------------------------------------------------------------------------------- card


@dataclass(frozen=True)
class CardConfig:
    """One config as the card declares it.

    Attributes:
        name: of the config.
        format: of its shards.
        extra: whether its samples have ``extra.npy``.
        packed: whether its samples have a clip.
        splits: those that it has.
        folders: configs whose shards it is made of; default: itself.
        default: whether ``load_dataset`` takes it when none is named.

    """

    name: str
    format: Format = "compact"
    extra: bool = False
    packed: bool = False
    splits: tuple[str, ...] = SPLITS
    folders: tuple[str, ...] = ()
    default: bool = False


def card_data(configs: Sequence[CardConfig]) -> dict[str, Any]:
    """Return the part of a card's YAML that stock ``load_dataset`` reads: files and features.

    >>> card_data([CardConfig("ego4d", splits=("train",))])["configs"][0]["data_files"]
    [{'split': 'train', 'path': 'ego4d/train/*.tar'}]

    Raises:
        EpisodeError: a name comes twice, or more than one config is the default.

    """
    names = [config.name for config in configs]
    if repeated := sorted({name for name in names if names.count(name) > 1}):
        raise EpisodeError(f"configs: expected every name once, got {repeated[0]!r} twice")
    if len(defaults := [config.name for config in configs if config.default]) > 1:
        raise EpisodeError(f"configs: expected at most one default, got {defaults}")
    return {
        "configs": [_config_entry(config) for config in configs],
        "dataset_info": [
            {"config_name": config.name, "features": _feature_entries(config)} for config in configs
        ],
    }


def card_yaml(configs: Sequence[CardConfig]) -> str:
    """Return ``card_data`` as YAML text, without the dashes around a card's head."""
    import yaml

    return yaml.safe_dump(card_data(configs), sort_keys=False, allow_unicode=True)


def _config_entry(config: CardConfig) -> dict[str, Any]:
    files: list[dict[str, Any]] = []
    for split in config.splits:
        paths = [f"{folder}/{split}/*.tar" for folder in config.folders or (config.name,)]
        files.append({"split": split, "path": paths[0] if len(paths) == 1 else paths})
    entry: dict[str, Any] = {"config_name": config.name, "data_files": files}
    return {**entry, "default": True} if config.default else entry


def _feature_entries(config: CardConfig) -> list[dict[str, Any]]:
    entries: list[dict[str, Any]] = []
    for name in member_names(config.format, config.extra):
        dtype: Any = "json"
        if name != META:
            spec = member(name)
            dtype = {"array2_d": {"shape": [None, spec.width], "dtype": spec.dtype}}
        entries.append({"name": name, "dtype": dtype})
    if config.packed:
        entries.append({"name": VIDEO_MEMBER, "dtype": {"video": {"decode": False}}})
    return [*entries, {"name": KEY_COLUMN, "dtype": "string"}]


# --------------------------------------------------------------------------- JSON schema


def meta_json_schema() -> dict[str, Any]:
    """Return the JSON schema (draft 2020-12) of the ``json`` member.

    >>> meta_json_schema()["properties"]["uid"]["type"]
    ['string', 'null']
    """
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": f"{META} member of a sample, schema version {SCHEMA_VERSION}",
        "type": "object",
        "properties": {field.name: _entry_schema(field) for field in META_FIELDS},
        "required": [field.name for field in META_FIELDS],
        "additionalProperties": False,
    }


def _entry_schema(field: MetaField) -> dict[str, Any]:
    unit = f" ({field.unit})" if field.unit else ""
    schema: dict[str, Any] = {"description": f"{field.description}{unit}"}
    if field.kind != "any":
        schema["type"] = [field.kind, "null"] if field.optional else field.kind
    return {**schema, **_constraints().get(field.name, {})}


def _constraints() -> dict[str, dict[str, Any]]:
    """What the entries must satisfy beyond their type, as ``decode_meta`` checks it."""
    return {
        "key": {"pattern": f"^(?:{KEY_PATTERN.pattern})$"},
        "schema_version": {"minimum": 1, "maximum": SCHEMA_VERSION},
        "format": {"enum": ["compact", "lossless"]},
        "num_frames": {"minimum": 1},
        "fps": {"exclusiveMinimum": 0},
        "image_size_hw": _array_of({"type": "integer", "minimum": 1}, 2),
        "shape": _array_of(
            {"type": "array", **_array_of({"type": "number"}, hands.NUM_SHAPE_PARAMS)}, len(SIDES)
        ),
        "text": {"items": _segment_schema()},
    }


def _array_of(items: dict[str, Any], length: int) -> dict[str, Any]:
    return {"items": items, "minItems": length, "maxItems": length}


def _segment_schema() -> dict[str, Any]:
    properties: dict[str, dict[str, Any]] = {
        "id": {"type": "string"},
        "text": {"type": "string"},
        "side": {"enum": [*SIDES, "both", None]},
        "start": {"type": "integer", "minimum": 0},
        "end": {"type": "integer", "minimum": 1},
    }
    return {
        "type": "object",
        "properties": properties,
        "required": [f.name for f in fields(TextSegment)],
        "additionalProperties": False,
    }


# ------------------------------------------------------------------------------- LeRobot


def lerobot_features() -> dict[str, dict[str, Any]]:
    """Return the label columns of the camera dialect of LeRobot v3, as ``features`` of info.json.

    Counters such as ``episode_index`` are not labels: ``loaders.lerobot_columns`` adds them.

    >>> lerobot_features()["left_mano_pose6d"]
    {'dtype': 'float32', 'shape': [90], 'names': None}
    """
    traj, state = member(TRAJ), member(STATE)
    columns = {column.name: column for column in traj.columns}
    kept = sum(columns[f"{side}_presence"].width for side in SIDES)
    features = {
        "hand_kept": _lerobot_feature("bool", kept, list(SIDES)),
        "cam_trans": _lerobot_feature(traj.dtype, columns["camera_translation"].width, list("xyz")),
        "cam_quat": _lerobot_feature(traj.dtype, columns["camera_quat_xyzw"].width, list("xyzw")),
        "cam_fov": _lerobot_feature(
            traj.dtype, columns["fov_vh"].width, ["vertical", "horizontal"]
        ),
    }
    for side in SIDES:
        for name, part in _LEROBOT_HAND.items():
            width = part.stop - part.start
            features[f"{side}_mano_{name}"] = _lerobot_feature(state.dtype, width)
    return features


_LEROBOT_HAND: Final = {
    "transl_cam": hands.TRANSLATION,
    "orient6d": hands.ORIENTATION,
    "pose6d": hands.JOINT_ROTATIONS,
    "betas": hands.SHAPE,
}


def _lerobot_feature(dtype: str, width: int, names: list[str] | None = None) -> dict[str, Any]:
    return {"dtype": dtype, "shape": [width], "names": names}


# -------------------------------------------------------------------------------- tables


def schema_table(
    part: Literal["members", "json", "episode"] = "members",
    format: Format | None = None,
) -> str:
    """Return a markdown table of the members' columns, the ``json`` entries or Episode's arrays.

    Args:
        part: which of the three.
        format: of "members", those of this format only, ``extra.npy`` included; default: all.

    """
    if part == "json":
        header = ("entry", "type", "unit", "content")
        rows = [
            (f"`{f.name}`", f"{f.kind} or null" if f.optional else f.kind, f.unit, f.description)
            for f in META_FIELDS
        ]
        return markdown_table(header, rows)
    if part == "episode":
        header = ("field", "dtype", "shape", "unit", "frame", "content")
        arrays = [
            (f"`{f.name}`", f.dtype, _shape(f.shape), f.unit, f.frame, f.description)
            for f in ARRAY_FIELDS
        ]
        return markdown_table(header, arrays)
    header = ("member", "dtype", "column", "numbers", "unit", "frame", "content")
    return markdown_table(header, _member_rows(format))


def _member_rows(format: Format | None) -> list[tuple[str, ...]]:
    formats: tuple[Format, ...] = ("compact", "lossless") if format is None else (format,)
    names = dict.fromkeys(name for f in formats for name in member_names(f, extra=True))
    rows: list[tuple[str, ...]] = []
    for spec in (member(name) for name in names if name != META):
        for column in spec.columns:
            cells = _column_cells(spec.slices[column.name], column)
            rows.append((f"`{spec.name}`", spec.dtype, f"`{column.name}`", *cells))
    return rows


def _column_cells(place: slice, column: Column) -> tuple[str, ...]:
    return (f"{place.start}:{place.stop}", column.unit, column.frame, column.description)


def _shape(sizes: Iterable[int | str]) -> str:
    named = [str(size) for size in sizes]
    return f"({', '.join(named)}{',' if len(named) == 1 else ''})"


def markdown_table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a markdown table, a line a row; bars and line breaks within cells are made harmless.

    >>> print(markdown_table(("side", "frames"), [("left", "90")]), end="")
    | side | frames |
    | --- | --- |
    | left | 90 |
    """
    lines = [header, ["---"] * len(header), *rows]
    cells = ([" ".join(cell.replace("|", "\\|").split()) for cell in line] for line in lines)
    return "".join(f"| {' | '.join(line)} |\n" for line in cells)
