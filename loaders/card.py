"""The card of a corpus folder: what stock `load_dataset(folder)` reads, and what people read.

The head is made from what is there: every config with its files and declared features. The text is
only written where there is none, so that a person's own words stay.
"""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

from mint_hub.conventions import MODEL_FPS
from mint_hub.loaders.atomic import replacing
from mint_hub.loaders.derived import VIDEO_MEMBER, CardConfig, card_data
from mint_hub.loaders.manifest import Manifest, read_manifest, split_folders
from mint_hub.loaders.member_table import EXTRA
from mint_hub.loaders.tar_layout import CorpusError

CARD: Final = "README.md"
_FENCE: Final = "---\n"


def write_card(folder: str | os.PathLike[str], default: str | None = None) -> Path:
    """Write or renew ``README.md`` of a corpus; return its path.

    Args:
        folder: the corpus, with ``<config>/<split>`` below it.
        default: the config that ``load_dataset(folder)`` takes; the only one, where there is one.

    Raises:
        CorpusError: no finished split is there, or no config of the name ``default``.

    """
    import yaml

    root = Path(folder)
    manifests = [read_manifest(path) for path in split_folders(root)]
    names = sorted({manifest.config for manifest in manifests})
    if not names:
        raise CorpusError(f"{root}: expected a corpus with finished splits, found none")
    chosen = names[0] if default is None and len(names) == 1 else default
    if chosen is not None and chosen not in names:
        raise CorpusError(f"default: expected one of {names}, got {chosen!r}")
    head, text = _parts(root / CARD)
    head |= card_data([_config(name, manifests, name == chosen) for name in names])
    body = text or _text(manifests)
    written = yaml.safe_dump(head, sort_keys=False, allow_unicode=True)
    with replacing(root / CARD) as temporary:
        temporary.write_text(f"{_FENCE}{written}{_FENCE}{body}", encoding="utf-8")
    return root / CARD


def _config(name: str, manifests: Sequence[Manifest], default: bool) -> CardConfig:
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


def _text(manifests: Sequence[Manifest]) -> str:
    rows = [
        f"| {m.config} | {m.split} | {m.format} | {sum(s.samples for s in m.shards):,} | "
        f"{m.num_frames:,} | {m.num_frames / MODEL_FPS / 3600:.3f} |"
        for m in manifests
    ]
    return "\n".join(
        (
            "",
            "# A corpus of egocentric trajectories",
            "",
            "Camera and two-hand trajectories with text, as WebDataset shards written by mint-hub. "
            "Every episode says in `scale_status` whose metres its lengths are. Read it with "
            "`mint_hub.load_dataset(CONFIG, location=FOLDER)`, `datasets.load_dataset(FOLDER, "
            "CONFIG)` or `webdataset`; check it with `mint-hub verify FOLDER --full`.",
            "",
            "| config | split | format | episodes | frames | hours at 30 frames/s |",
            "| --- | --- | --- | ---: | ---: | ---: |",
            *rows,
            "",
        )
    )
