"""The card of mint-ego: ``template.md`` filled from schema, statistics, sources and changelog.

The template holds words, and names a value as ``$name``; every number comes from where it is kept.
Head and tables are those of `loaders.card`, which writes the card of any corpus folder.
"""

from collections.abc import Sequence
from pathlib import Path
from string import Template
from typing import Any, Final

from mint_hub import conventions
from mint_hub.assets import asset_path
from mint_hub.cards.head import check_head, size_category
from mint_hub.cards.sources import CardError, Source, Sources
from mint_hub.loaders.card import (
    card_config,
    card_text,
    splits_table,
    stats_table,
    withdrawn_table,
)
from mint_hub.loaders.changelog import Changelog
from mint_hub.loaders.derived import CardConfig, card_data, markdown_table, schema_table
from mint_hub.loaders.location import ALL, CONFIGS, PARTS, SAMPLE
from mint_hub.loaders.manifest import Manifest, read_manifest, split_folders
from mint_hub.loaders.resolvers import GET_EGO4D, GET_EGODEX, GET_EPIC
from mint_hub.loaders.schema import SCHEMA_VERSION
from mint_hub.loaders.shards import VALIDATION

TEMPLATE: Final = "template.md"
NOT_STATED: Final = "not stated"

_GET: Final = {"ego4d": GET_EGO4D, "epic": GET_EPIC, "egodex": GET_EGODEX}
_HOLDS: Final = {
    SAMPLE: "three synthetic clips with their pictures, embedded in mint-hub",
    ALL: "the shards of all sources",
    "lossless": "all 109 numbers a hand a frame in float32, for sources whose hand shape varies",
}


def render(folder: Path) -> str:
    """Return the card of mint-ego from the sources in a folder.

    Raises:
        CardError: a source is missing or wrong, or the head is not what the hub documents.
        CorpusError: the changelog or the embedded sample is damaged.

    """
    sources, changelog = Sources.load(folder), Changelog.load(folder)
    sample = asset_path("sample_corpus")
    manifests = [read_manifest(path) for path in split_folders(sample)]
    head = card_head(sources, manifests)
    check_head(head)
    values = {
        **_release(sources),
        **_tables(sources, sample, manifests),
        **_conventions(),
        "withdrawn": withdrawn_table(changelog) if changelog.withdrawn else "None so far.\n",
        "changes": _list(f"{c.date}, {c.version}: {c.text}" for c in changelog.changes),
    }
    path = folder / TEMPLATE
    try:
        text = path.read_text(encoding="utf-8")
        return card_text(head, Template(text).substitute(values))
    except FileNotFoundError:
        raise CardError(f"{path}: expected this file, got none") from None
    except (KeyError, ValueError) as error:
        raise CardError(f"{path}: expected $names of {sorted(values)}, got {error}") from None


def card_head(sources: Sources, sample: Sequence[Manifest]) -> dict[str, Any]:
    """Return the metadata of the card, with every published config and the access form.

    Args:
        sources: the release and the data sets that it is made of.
        sample: manifests of the embedded sample.

    """
    from huggingface_hub import DatasetCardData

    data = DatasetCardData(
        pretty_name="mint-ego",
        language=["en"],
        license="other",
        license_name="terms-of-each-source",
        annotations_creators=["machine-generated"],
        source_datasets=["extended"],
        size_categories=[size_category(sources.release.episodes)],
        task_categories=["robotics"],
        tags=["egocentric", "hand-pose", "camera-pose", "pseudo-labels", "webdataset"],
        extra_gated_prompt=(
            "These are pseudo-labels with enlarged camera scale, made from video of others. Each "
            "source keeps its own terms: use only the configs whose terms you have accepted, and "
            "do not try to find out who participants are."
        ),
        extra_gated_fields=_form(sources.sources),
        extra_gated_button_content="Agree and ask for access",
        **card_data(card_configs(sample)),
    )
    return data.to_dict()


def card_configs(sample: Sequence[Manifest]) -> list[CardConfig]:
    """Return the published configs as the card declares them; the sample is the default."""
    made = {
        SAMPLE: card_config(SAMPLE, sample, default=True),
        ALL: CardConfig(ALL, folders=PARTS),
        "lossless": CardConfig("lossless", format="lossless"),
    }
    return [made.get(name, CardConfig(name)) for name in CONFIGS]


def _form(sources: Sequence[Source]) -> dict[str, Any]:
    """The access form: who asks, and for each source that its terms are met, or it is not used."""
    terms = {
        source.name: {
            "type": "select",
            "options": [source.agreement, f"I will not use labels from {source.name}"],
        }
        for source in sources
    }
    seen = "I know that these are pseudo-labels and no metric ground truth"
    return {"Name": "text", "Affiliation": "text", "Country": "country", **terms, seen: "checkbox"}


def _release(sources: Sources) -> dict[str, str]:
    release = sources.release
    return {
        "cited": release.cited,
        "hours": f"{release.hours:,.1f}",
        "raw_hours": f"{release.raw_hours:,.0f}",
        "kept": f"{release.hours / release.raw_hours:.1%}",
        "episodes": f"{release.episodes:,}",
        "frames": f"{release.frames:,}",
        "fps": f"{release.fps:g}",
        "labels_licence": release.labels_licence,
    }


def _tables(sources: Sources, sample: Path, manifests: Sequence[Manifest]) -> dict[str, str]:
    frames = sum(m.num_frames for m in manifests)
    return {
        "sources_table": _sources_table(sources),
        "licences_table": markdown_table(
            ("source", "terms of the video", "terms of the labels"),
            [(s.name, s.video_licence, s.labels_licence) for s in sources.sources],
        ),
        "access": "".join(
            f"- **{s.name}** (<{s.home}>). {s.access} To get the video: "
            f"{_GET[s.config].format(uid='UID', participant='PARTICIPANT')}.\n"
            for s in sources.sources
        ),
        "unknowns": _list(f"{s.name}: {text}" for s in sources.sources for text in s.unknown),
        "configs_table": _configs_table(sources, manifests),
        "validation": f"{VALIDATION:.0%}",
        "sample_hours": f"{frames / conventions.MODEL_FPS / 3600:.4f}",
        "sample_episodes": f"{sum(m.num_episodes for m in manifests):,}",
        "sample_frames": f"{frames:,}",
        "sample_splits": splits_table(manifests),
        "sample_stats": stats_table(sample, manifests),
        "schema_version": str(SCHEMA_VERSION),
        "members_table": schema_table("members"),
        "json_table": schema_table("json"),
        "episode_table": schema_table("episode"),
    }


def _sources_table(sources: Sources) -> str:
    rows: list[tuple[str, ...]] = []
    for s in sources.sources:
        count = NOT_STATED if s.episodes is None else f"{s.episodes:,}"
        share = f"{s.hours / sources.release.hours:.1%}"
        rows.append((f"`{s.config}`", s.name, f"{s.hours:,.1f}", share, count, " ".join(s.known)))
    header = ("config", "source", "hours", "of all", "episodes", "what to know")
    return markdown_table(header, rows)


def _configs_table(sources: Sources, sample: Sequence[Manifest]) -> str:
    names = {s.config: f"labels of {s.name}" for s in sources.sources}
    rows = [
        (f"`{c.name}`", ", ".join(c.splits), c.format, {**_HOLDS, **names}[c.name])
        for c in card_configs(sample)
    ]
    return markdown_table(("config", "splits", "format", "holds"), rows)


def _conventions() -> dict[str, str]:
    assert conventions.__doc__ is not None
    return {
        "conventions": conventions.__doc__.strip(),
        "sides": ", ".join(conventions.SIDES),
        "joints": ", ".join(conventions.JOINT_NAMES),
        "keypoints": ", ".join(conventions.KEYPOINT_NAMES),
    }


def _list(lines: Any) -> str:
    return "".join(f"- {line}\n" for line in lines)
