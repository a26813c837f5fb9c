"""The card of the model: ``template.md`` filled from configurations, results and changelog.

Results are what ``mint-hub evaluate`` wrote (``results/*.json``, schema 1; ``clips`` may be left
out). Each gives a table, trivial rows beside the model's, and entries of the ``model-index``
in the head. Without results the card says that there are no numbers.
"""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from string import Template
from typing import Any, Final, cast

from mint_hub.cards.sources import CardError
from mint_hub.loaders.card import card_text
from mint_hub.loaders.changelog import Changelog
from mint_hub.loaders.derived import markdown_table

TEMPLATE: Final = "template.md"
RESULTS: Final = "results"
KIND, SCHEMA = "mint-hub evaluation", 1
TASK: Final = "keypoint-detection"
SHOWN: Final = (
    ("hands", "published", "FAcc", ""),
    ("hands", "published", "Presence-BA", ""),
    ("hands", "published", "MPJPE-p", "mm"),
    ("hands", "published", "PA-MPJPE-p", "mm"),
    ("hands", "published", "EPE-p", "px"),
    ("hands", "published", "CT-p", "m"),
    ("hands", "published", "Jitter", "mm/frame^2"),
    ("camera", None, "RPE-T mean", "mm"),
    ("camera", None, "RPE-R mean", "deg"),
    ("camera", None, "ATE % mean", "% of path"),
    ("world", "SE(3)", "W-MPJPE", "mm"),
)
"""Numbers of the card: group, reading or alignment, name, unit."""

NO_RESULTS: Final = (
    "**No trained checkpoint has been evaluated yet**, so there is no number to print here.\n"
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
        "results": "\n".join(map(results_section, results)) if results else NO_RESULTS,
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


def load_results(folder: Path) -> list[dict[str, Any]]:
    """Read ``results/*.json`` of a folder, in the order of their names; none is fine.

    Raises:
        CardError: a file is no result of an evaluation, or of no checkpoint.

    """
    found: list[dict[str, Any]] = []
    for path in sorted((folder / RESULTS).glob("*.json")):
        try:
            values: Any = json.loads(path.read_text(encoding="utf-8"))
        except ValueError as error:
            raise CardError(f"{path}: expected JSON, got {error}") from None
        if not isinstance(values, dict):
            raise CardError(f"{path}: expected results of `mint-hub evaluate`, got other JSON")
        given = cast("dict[str, Any]", values)
        if given.get("kind") != KIND or given.get("schema") != SCHEMA:
            raise CardError(f"{path}: expected {KIND}, schema {SCHEMA}, got {given.get('kind')!r}")
        prediction = given.get("prediction")
        if not isinstance(prediction, dict) or prediction.get("kind") != "checkpoint":
            raise CardError(f"{path}: expected results of a checkpoint, got of {prediction!r:.80}")
        found.append(given)
    return found


def card_head(results: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the metadata of the card, with a model-index where there are results."""
    from huggingface_hub import ModelCardData

    evaluated = [entry for result in results for entry in _eval_results(result)]
    data = ModelCardData(
        language="en",
        license="apache-2.0",
        library_name="transformers",
        pipeline_tag=TASK,
        tags=["egocentric", "hand-pose", "camera-pose", "mint"],
        model_name=str(results[0]["prediction"]["name"]) if results else None,
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


def results_section(result: Mapping[str, Any]) -> str:
    """Return one evaluation as a table, the trivial rows with it."""
    benchmark, prediction = result["benchmark"], result["prediction"]
    rows: list[tuple[str, ...]] = []
    for row in result["rows"]:
        cells = [_text(_value(row, *place[:3]), place[3]) for place in SHOWN]
        name = f"**{row['name']}**" if row["row"] == "prediction" else str(row["name"])
        rows.append((name, *cells))
    heads = ("", *(f"{name} ({unit})" if unit else name for _, _, name, unit in SHOWN))
    about = (
        f"{benchmark['clips']} clips, {benchmark['frames']} frames, hash {benchmark['hash']}; "
        f"weights {prediction['weights']}, mint-hub {result['mint_hub']}, {result['date'][:10]}. "
        f"Mean hand: of {result['trained_on']}."
    )
    return f"### {benchmark['title']}\n\n{about}\n\n{markdown_table(heads, rows)}"


def _eval_results(result: Mapping[str, Any]) -> list[Any]:
    from huggingface_hub import EvalResult

    benchmark = result["benchmark"]
    own = next(row for row in result["rows"] if row["row"] == "prediction")
    made: list[Any] = []
    for group, part, name, unit in SHOWN:
        value = _value(own, group, part, name)
        if value is None:
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
                metric_name=f"{name} ({unit})" if unit else name,
                metric_value=round(value, 4),
                verified=False,
            )
        )
    return made


def _value(row: Mapping[str, Any], group: str, part: str | None, name: str) -> float | None:
    found = row[group] if part is None else row[group].get(part, {})
    triple = found.get(name)
    return None if triple is None or triple[0] is None else float(triple[0])


def _text(value: float | None, unit: str) -> str:
    if value is None:
        return "—"
    return f"{value:.3f}" if unit in ("", "m") else f"{value:.2f}"


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
