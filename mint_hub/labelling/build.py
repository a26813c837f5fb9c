"""From choices to a cascade: which backend does which stage, with which settings."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mint_hub.labelling.backends import OPTIONAL, STAGES, make
from mint_hub.labelling.cascade import Cascade


def build_cascade(
    work: Path,
    *,
    chosen: Mapping[str, str] | None = None,
    settings: Mapping[str, Mapping[str, Any]] | None = None,
) -> Cascade:
    """Make the stages in their order.

    Args:
        work: folder of the run's files; normalised videos go there.
        chosen: backend by stage, where it is not the default.
        settings: by stage, settings by name.

    Raises:
        ValueError: an unknown stage, backend or setting; the message names the known ones.

    """
    chosen = dict(chosen or {})
    given = {stage: dict(values) for stage, values in (settings or {}).items()}
    for stage in (*chosen, *given):
        if stage not in STAGES:
            raise ValueError(f"stage: expected one of {', '.join(STAGES)}, got {stage!r}")
    given.setdefault("normalise", {}).setdefault("work_dir", str(work))
    return Cascade(
        [
            make(stage, chosen.get(stage), given.get(stage))
            for stage in STAGES
            if stage not in OPTIONAL or stage in chosen
        ]
    )
