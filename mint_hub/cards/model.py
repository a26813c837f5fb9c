"""The card of the model: ``template.md`` filled from configurations, results and changelog.

Results are what ``mint-hub evaluate`` wrote (``results/*.json``, schema 1), kept without ``clips``
by ``python -m mint_hub.cards --keep``. Those of the same clips share a table, the rows that need no
model once at its end. The checkpoint also gives the entries of the ``model-index`` in the head;
without one the card says so. A card is of one model: huggingface_hub puts all entries of an index
under one name, so that another's numbers would become this one's.
"""

import json
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from string import Template
from typing import Any, Final, cast

from mint_hub.cards.sources import CardError
from mint_hub.geometry.metrics import NOTHING, interval, measure_of, number
from mint_hub.loaders.atomic import replacing
from mint_hub.loaders.card import card_text
from mint_hub.loaders.changelog import Changelog
from mint_hub.loaders.derived import markdown_table

TEMPLATE: Final = "template.md"
RESULTS: Final = "results"
KIND, SCHEMA = "mint-hub evaluation", 1
TASK: Final = "keypoint-detection"
SHOWN: Final = (
    ("hands", "published", "FAcc"),
    ("hands", "published", "Presence-BA"),
    ("hands", "published", "MPJPE-p"),
    ("hands", "published", "PA-MPJPE-p"),
    ("hands", "published", "EPE-p"),
    ("hands", "published", "CT-p"),
    ("hands", "published", "Jitter"),
    ("camera", None, "RPE-T mean"),
    ("camera", None, "RPE-R mean"),
    ("camera", None, "ATE % mean"),
    ("world", "SE(3)", "W-MPJPE"),
)
"""Numbers of the card: group, reading or alignment, name."""

NO_RESULTS: Final = (
    "**No trained checkpoint has been evaluated yet**: there is no number of a model here.\n"
)


def render(folder: Path) -> str:
    """Return the card of the model from the sources in a folder.

    Raises:
        CardError: a source is missing or wrong, or the head is not what huggingface_hub reads.
        CorpusError: the changelog is damaged.

    """
    results = load_results(folder)
    changes = Changelog.load(folder).changes
    head = card_head(results)
    values = {
        "results": "\n".join(results_sections(results)),
        "changes": "".join(f"- {c.date}, {c.version}: {c.text}\n" for c in changes),
        **_configurations(),
    }
    path = folder / TEMPLATE
    try:
        body = Template(path.read_text(encoding="utf-8")).substitute(values)
    except FileNotFoundError:
        raise CardError(f"{path}: expected this file, got none") from None
    except (KeyError, ValueError) as error:
        raise CardError(f"{path}: expected $names of {sorted(values)}, got {error}") from None
    card = card_text(head, body)
    check_model_card(card)
    return card


def keep_results(evaluation: Path, folder: Path) -> Path:
    """Copy an evaluation's results to where the card finds them: tables, and numbers without clips.

    The file's name is that of benchmark (config, split, protocol and length of cut clips, too) and
    prediction; an older one of that name is replaced.

    Args:
        evaluation: folder that ``mint-hub evaluate`` wrote.
        folder: the card's.

    Raises:
        CardError: it holds no results, or no tables.

    """
    values = read_results(evaluation / "results.json")
    tables = evaluation / "tables.md"
    if not tables.is_file():
        raise CardError(f"{tables}: expected this file beside results.json, got none")
    values.pop("clips", None)
    who = values["prediction"]["name"] if values["prediction"] else "trivial"
    facts = values["benchmark"]
    parts = [facts["name"], *(facts.get(part) for part in ("config", "split", "protocol"))]
    parts.append(f"{facts['clip_frames']} frames" if facts.get("clip_frames") else None)
    words = "-".join(str(part) for part in (*parts, who) if part)
    name = re.sub(r"[^a-z0-9.]+", "-", words.lower()).strip("-.")
    kept = folder / RESULTS / f"{name}.json"
    with replacing(kept.with_suffix(".md")) as temporary:
        temporary.write_text(tables.read_text(encoding="utf-8"), encoding="utf-8")
    with replacing(kept) as temporary:
        text = json.dumps(values, indent=1, ensure_ascii=False, allow_nan=False)
        temporary.write_text(text + "\n", encoding="utf-8")
    return kept


def load_results(folder: Path) -> list[dict[str, Any]]:
    """Read ``results/*.json`` of a folder, in the order of their names; none is fine.

    Raises:
        CardError: a file is no result of an evaluation.

    """
    return [read_results(path) for path in sorted((folder / RESULTS).glob("*.json"))]


def read_results(path: Path) -> dict[str, Any]:
    """Read one file of results.

    Raises:
        CardError: no such file, or not what ``mint-hub evaluate`` writes.

    """
    try:
        values: Any = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise CardError(f"{path}: expected results of `mint-hub evaluate`, got no file") from None
    except ValueError as error:
        raise CardError(f"{path}: expected JSON, got {error}") from None
    if not isinstance(values, dict):
        raise CardError(f"{path}: expected results of `mint-hub evaluate`, got other JSON")
    given = cast("dict[str, Any]", values)
    if given.get("kind") != KIND or given.get("schema") != SCHEMA:
        raise CardError(f"{path}: expected {KIND}, schema {SCHEMA}, got {given.get('kind')!r}")
    if lost := [name for name in ("benchmark", "prediction", "rows") if name not in given]:
        raise CardError(f"{path}: expected {KIND} with {lost[0]}, got none")
    return given


def card_head(results: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the metadata of the card, with a model-index where there are results.

    Raises:
        CardError: results of checkpoints of several names, or of several weights under one.

    """
    from huggingface_hub import ModelCardData

    models = [result for result in results if _kind(result) == "checkpoint"]
    who = {f"{r['prediction']['name']} ({r['prediction'].get('weights')})": r for r in models}
    if len(who) > 1:
        raise CardError(
            f"{RESULTS}: expected evaluations of one checkpoint, for a card is of one model, got "
            f"{len(who)}: {', '.join(sorted(who))}; keep one of them here"
        )
    evaluated = [entry for result in models for entry in _eval_results(result)]
    data = ModelCardData(
        language="en",
        license="apache-2.0",
        library_name="transformers",
        pipeline_tag=TASK,
        tags=["egocentric", "hand-pose", "camera-pose", "mint"],
        model_name=str(models[0]["prediction"]["name"]) if models else None,
        eval_results=evaluated or None,
    )
    return data.to_dict()


def check_model_card(card: str) -> None:
    """Read a card as huggingface_hub does.

    Raises:
        CardError: it reads other results than were written.

    """
    from huggingface_hub import ModelCard
    from huggingface_hub.repocard_data import eval_results_to_model_index

    try:
        data: Any = ModelCard(card, ignore_metadata_errors=False).data
    except (TypeError, ValueError) as error:
        raise CardError(f"head: expected what huggingface_hub reads, got {error}") from None
    results = data.eval_results
    if results:
        index = eval_results_to_model_index(str(data.model_name), results)
        if index != data.to_dict()["model-index"]:
            raise CardError("model-index: expected to read what was written, got other results")


def results_sections(results: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return a table for each set of clips that something was evaluated on."""
    by_clips: dict[str, list[Mapping[str, Any]]] = {}
    for result in results:
        by_clips.setdefault(str(result["benchmark"]["hash"]), []).append(result)
    sections = [_section(group) for group in by_clips.values()]
    unknown = not any(_kind(result) == "checkpoint" for result in results)
    return [NO_RESULTS, *sections] if unknown else sections


def _section(results: Sequence[Mapping[str, Any]]) -> str:
    """Return the evaluations of the same clips as one table, a column each."""
    columns: list[tuple[str, Mapping[str, Any]]] = []
    about: list[str] = []
    for result in results:
        own = [row for row in result["rows"] if row["row"] == "prediction"]
        columns += [(f"**{row['name']}**", row) for row in own]
        about += [f"**{row['name']}**: {_facts(result)}." for row in own]
    columns += [(str(r["name"]), r) for r in results[-1]["rows"] if r["row"] != "prediction"]
    rows = [
        (measure_of(place[2]).title, *(_text(row, *place) for _, row in columns)) for place in SHOWN
    ]
    benchmark, last = results[-1]["benchmark"], results[-1]
    about.append(
        f"{benchmark['clips']} clips, {benchmark['frames']} frames, hash {benchmark['hash']}; "
        f"mint-hub {last['mint_hub']}, {last['date'][:10]}. In brackets: 95 % of a bootstrap over "
        f"recordings. Mean hand: of {last['trained_on']}."
    )
    table = markdown_table(("", *(name for name, _ in columns)), rows)
    return f"### {benchmark['title']}\n\n{' '.join(about)}\n\n{table}"


def _facts(result: Mapping[str, Any]) -> str:
    prediction, date = result["prediction"], result["date"][:10]
    if prediction["kind"] == "checkpoint":
        return f"weights {prediction['weights']}, mint-hub {result['mint_hub']}, {date}"
    return f"labels, not a model of this repository, mint-hub {result['mint_hub']}, {date}"


def _kind(result: Mapping[str, Any]) -> str | None:
    """Return "checkpoint" or "labels"; None where only the rows without a model were asked for."""
    return result["prediction"]["kind"] if result["prediction"] else None


def _eval_results(result: Mapping[str, Any]) -> list[Any]:
    from huggingface_hub import EvalResult

    benchmark = result["benchmark"]
    own = next(row for row in result["rows"] if row["row"] == "prediction")
    made: list[Any] = []
    for place in SHOWN:
        triple, name = _triple(own, *place), place[2]
        if triple is None:
            continue
        made.append(
            EvalResult(
                task_type=TASK,
                task_name="camera and two-hand motion from egocentric video",
                dataset_type=str(benchmark["name"]),
                dataset_name=str(benchmark["title"]),
                dataset_split=benchmark["split"],
                dataset_revision=str(benchmark["hash"]),
                metric_type=name.lower().replace(" ", "_"),
                metric_name=measure_of(name).title,
                metric_value=round(triple[0], 4),
                verified=False,
            )
        )
    return made


def _triple(
    row: Mapping[str, Any], group: str, part: str | None, name: str
) -> tuple[float, float, float] | None:
    """A number and its interval (NaN where there is none); None where nothing was counted."""
    found = row[group] if part is None else row[group].get(part, {})
    triple = found.get(name)
    if triple is None or triple[0] is None:
        return None
    value, low, high = (math.nan if v is None else float(v) for v in triple)
    return value, low, high


def _text(row: Mapping[str, Any], group: str, part: str | None, name: str) -> str:
    triple, unit = _triple(row, group, part, name), measure_of(name).unit
    if triple is None:
        return NOTHING
    return f"{number(triple[0], unit)} {interval(*triple[1:], unit)}".strip()


def _configurations() -> dict[str, str]:
    """Facts of the classes: sizes, windows, images."""
    import torch

    from mint_hub.model.configuration_mint import MintConfig
    from mint_hub.model.modeling_mint import MintModel

    values: dict[str, str] = {}
    for name, config in (("full", MintConfig.full()), ("tiny", MintConfig.tiny())):
        with torch.device("meta"):
            model = MintModel(config)
        count = sum(parameter.numel() for parameter in model.parameters())
        values[f"{name}_parameters"] = f"{count:,}"
    full = MintConfig.full()
    height, width = full.image_size
    return {**values, "window": str(full.window), "image_size": f"{height} x {width}"}
