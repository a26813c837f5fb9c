"""The card of a corpus folder: what stock `load_dataset(folder)` reads, and what people read.

The head is made from what is there: every config with its files and declared features. Of the text
only the facts are ours, between two comments: counts, statistics and withdrawn videos, renewed by
every call. A person's own words around them stay, and so does a text without those comments.
The card of mint-ego itself (`mint_hub.cards`) is made of the same head and tables.
"""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from mint_hub.conventions import MODEL_FPS, SIDES
from mint_hub.loaders.atomic import replacing
from mint_hub.loaders.changelog import Changelog
from mint_hub.loaders.derived import VIDEO_MEMBER, CardConfig, card_data, markdown_table
from mint_hub.loaders.manifest import Manifest, read_manifest, split_folders
from mint_hub.loaders.member_table import EXTRA
from mint_hub.loaders.stats import read_stats
from mint_hub.loaders.tar_layout import CorpusError

CARD: Final = "README.md"
FACTS_BEGIN: Final = "<!-- facts: renewed by mint-hub, write outside of them -->\n"
FACTS_END: Final = "<!-- end of facts -->\n"
_FENCE: Final = "---\n"


def write_card(folder: str | os.PathLike[str], default: str | None = None) -> Path:
    """Write or renew ``README.md`` of a corpus; return its path.

    Args:
        folder: the corpus, with ``<config>/<split>`` below it.
        default: the config that ``load_dataset(folder)`` takes; None keeps the card's own choice,
            and is the only config, where there is one.

    Raises:
        CorpusError: no finished split is there, or no config of the name ``default``; statistics
            are missing or not of these shards; ``changelog.json`` is damaged.

    """
    root = Path(folder)
    manifests = [read_manifest(path) for path in split_folders(root)]
    names = sorted({manifest.config for manifest in manifests})
    if not names:
        raise CorpusError(f"{root}: expected a corpus with finished splits, found none")
    head, text = _parts(root / CARD)
    chosen = default or _chosen(head, names)
    if chosen is not None and chosen not in names:
        raise CorpusError(f"default: expected one of {names}, got {chosen!r}")
    head |= card_data([card_config(name, manifests, name == chosen) for name in names])
    facts = _facts(root, manifests)
    with replacing(root / CARD) as temporary:
        temporary.write_text(card_text(head, _renewed(text, *facts)), encoding="utf-8")
    return root / CARD


def card_text(head: Mapping[str, Any], body: str) -> str:
    """Return a card: its head as YAML between two lines of dashes, then its body."""
    import yaml

    written = yaml.safe_dump(dict(head), sort_keys=False, allow_unicode=True)
    return f"{_FENCE}{written}{_FENCE}{body}"


def card_config(name: str, manifests: Sequence[Manifest], default: bool = False) -> CardConfig:
    """Return how a card declares the config of this name, whose splits are among ``manifests``.

    Raises:
        CorpusError: its splits differ in their members.

    """
    own = [manifest for manifest in manifests if manifest.config == name]
    members = {manifest.members for manifest in own}
    if len(members) > 1:
        raise CorpusError(f"{name}: expected the same members in every split, got {members}")
    return CardConfig(
        name,
        format=own[0].format,  # pyright: ignore[reportArgumentType]
        extra=EXTRA in own[0].members,
        packed=VIDEO_MEMBER in own[0].members,
        splits=tuple(manifest.split for manifest in own),
        default=default,
    )


# -------------------------------------------------------------------------------- tables


def splits_table(manifests: Sequence[Manifest]) -> str:
    """Return what each split holds as a markdown table."""
    header = ("config", "split", "format", "episodes", "frames", "hours at 30 frames/s", "bytes")
    rows: list[tuple[str, ...]] = []
    for m in manifests:
        counts = (f"{m.num_episodes:,}", f"{m.num_frames:,}")
        sizes = (f"{m.num_frames / MODEL_FPS / 3600:.3f}", f"{m.num_bytes:,}")
        rows.append((m.config, m.split, m.format, *counts, *sizes))
    return markdown_table(header, rows)


def stats_table(folder: Path, manifests: Sequence[Manifest]) -> str:
    """Return where and how often hands are, by split and source, as a markdown table.

    Raises:
        CorpusError: a ``stats.json`` is missing, damaged or of other shards.

    """
    header = ("config", "split", "source", "hand", "present in", "wrist depth 1 / 50 / 99 %, m")
    rows: list[tuple[str, ...]] = []
    for m in manifests:
        sources = read_stats(folder / m.config, m.split, m.content)
        for source, parts in sources.items():
            frames = parts["camera"]["camera_translation"]["count"]
            for side in SIDES:
                cells = _hand_cells(parts[side]["translation"], frames)
                rows.append((m.config, m.split, source, side, *cells))
    return markdown_table(header, rows)


def withdrawn_table(changelog: Changelog) -> str:
    """Return the withdrawn videos as a markdown table."""
    header = ("date", "source", "video uid", "episodes taken out", "reason")
    rows = [
        (t.date, t.source, t.uid, ", ".join(f"{k}: {n}" for k, n in t.episodes.items()), t.reason)
        for t in changelog.withdrawn
    ]
    return markdown_table(header, rows)


def _hand_cells(translation: Mapping[str, Any], frames: int) -> tuple[str, str]:
    """Share of frames with the hand, and quantiles of z, which is the third number."""
    if not translation["count"]:
        return "0.0 %", ""
    depths = [translation["quantiles"][q][2] for q in ("0.01", "0.5", "0.99")]
    return f"{translation['count'] / frames:.1%}", " / ".join(f"{z:.2f}" for z in depths)


# ---------------------------------------------------------------------------------- text


def _facts(root: Path, manifests: Sequence[Manifest]) -> tuple[str, bool]:
    """Return the facts of a folder, and whether they must be in the card."""
    changelog = Changelog.load(root)
    parts = [
        splits_table(manifests),
        "Camera frame; a hand counts in frames where it is present.\n",
        stats_table(root, manifests),
    ]
    if changelog.withdrawn:
        asked = "Withdrawn: delete copies of these labels that you have.\n"
        parts += [asked, withdrawn_table(changelog)]
    return "\n".join((FACTS_BEGIN, *parts, FACTS_END)), bool(changelog.withdrawn)


def _renewed(text: str, facts: str, needed: bool) -> str:
    """Put facts into a card's text; into a person's own only in their place, or where needed."""
    if not text:
        return f"{_INTRODUCTION}\n{facts}"
    before, begin, rest = text.partition(FACTS_BEGIN)
    _, end, after = rest.partition(FACTS_END)
    if begin and end:
        return f"{before}{facts}{after}"
    return f"{text.rstrip()}\n\n{facts}" if needed else text


def _chosen(head: Mapping[str, Any], names: Sequence[str]) -> str | None:
    """Return the default config of a card that is there, or the only one of the folder."""
    was = [c["config_name"] for c in head.get("configs", []) if c.get("default")]
    if was and was[0] in names:
        return str(was[0])
    return names[0] if len(names) == 1 else None


def _parts(path: Path) -> tuple[dict[str, Any], str]:
    """The head and the text of a card; both empty where there is none."""
    import yaml

    if not path.exists():
        return {}, ""
    content = path.read_text(encoding="utf-8")
    if not content.startswith(_FENCE) or _FENCE not in content[len(_FENCE) :]:
        return {}, content
    head, text = content[len(_FENCE) :].split(_FENCE, 1)
    values = yaml.safe_load(head)
    if not isinstance(values, dict):
        raise CorpusError(f"{path}: expected YAML keys between the first two lines of dashes")
    return values, text  # pyright: ignore[reportUnknownVariableType]


_INTRODUCTION: Final = """
# A corpus of egocentric trajectories

Camera and two-hand trajectories with text, as WebDataset shards written by mint-hub. Every episode
says in `scale_status` whose metres its lengths are. Read it with
`mint_hub.load_dataset(CONFIG, location=FOLDER)`, `datasets.load_dataset(FOLDER, CONFIG)` or
`webdataset`; check it with `mint-hub verify FOLDER --full`.
"""
