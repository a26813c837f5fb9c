"""The card of the model is a fresh rendering, and the hub's classes read what it says."""

import json
import shutil
from pathlib import Path

import pytest
from huggingface_hub import ModelCard

from mint_hub.cards.model import NO_RESULTS, card_head, check_model_card, load_results, render
from mint_hub.cards.sources import CardError
from mint_hub.evaluation.clips import Source
from mint_hub.evaluation.evaluate import evaluate
from mint_hub.evaluation.predictor import Predictor
from tests.evaluation_data import noisy, save_all, true_episode

FOLDER = Path(__file__).parents[2] / "model_card"


@pytest.fixture
def folder(tmp_path):
    return shutil.copytree(FOLDER, tmp_path / "model_card")


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    """Results of labels, rewritten as if a checkpoint had made them."""
    folder = tmp_path_factory.mktemp("results")
    truth = [true_episode(i, 30) for i in range(3)]
    source = Source("labels", str(save_all(truth, folder / "truth")))
    labels = save_all([noisy(e, 0.01) for e in truth], folder / "labels")
    values = evaluate(source, Predictor.of(str(labels))).to_dict()
    del values["clips"]
    facts = {"name": "mint-small", "kind": "checkpoint", "weights": "0123456789abcdef"}
    return {**values, "prediction": facts}


def with_results(folder, results):
    (folder / "results").mkdir(exist_ok=True)
    (folder / "results" / "made.json").write_text(json.dumps(results))
    return folder


def test_committed_card_is_a_fresh_rendering():
    text = (FOLDER / "README.md").read_text(encoding="utf-8")
    assert text == render(FOLDER), "run: python -m mint_hub.cards"


def test_hub_loads_it_and_writes_the_same():
    card = ModelCard.load(FOLDER / "README.md")
    assert str(card) == (FOLDER / "README.md").read_text(encoding="utf-8")
    assert card.data.to_dict()["license"] == "apache-2.0"


def test_limits_and_licences_are_on_the_first_screen():
    body = (FOLDER / "README.md").read_text(encoding="utf-8").split("---\n", 2)[2]
    screen = "\n".join(body.splitlines()[:30])
    assert "## Limits, before anything else" in screen
    assert "**Licences.**" in screen
    assert "No trained weights are embedded" in screen


def test_without_results_no_number_is_claimed():
    if not load_results(FOLDER):
        assert NO_RESULTS in render(FOLDER)
        assert "model-index" not in card_head([])


def test_results_become_a_table_and_a_model_index(folder, results):
    text = render(with_results(folder, results))
    (folder / "README.md").write_text(text)
    card = ModelCard.load(folder / "README.md")
    assert str(card) == text
    found = {r.metric_name: r for r in card.data.eval_results}
    row = next(r for r in results["rows"] if r["row"] == "prediction")
    value = row["hands"]["published"]["MPJPE-p"][0]
    assert found["MPJPE-p (mm)"].metric_value == pytest.approx(value, abs=1e-3)
    assert found["MPJPE-p (mm)"].dataset_revision == results["benchmark"]["hash"]
    assert card.data.model_name == "mint-small"
    assert "| mean hand |" in text
    assert "zero camera motion" in text


def test_a_changed_result_makes_the_card_stale(folder, results):
    before = render(with_results(folder, results))
    for row in results["rows"]:
        if row["row"] == "prediction":
            row = json.loads(json.dumps(row))
            row["hands"]["published"]["FAcc"] = [0.123, None, None]
            changed = {**results, "rows": [row, *results["rows"][1:]]}
    assert render(with_results(folder, changed)) != before


def test_errors_teach(folder, results):
    with pytest.raises(CardError, match="expected results of a checkpoint"):
        render(with_results(folder, {**results, "prediction": {"kind": "labels"}}))
    with pytest.raises(CardError, match="expected mint-hub evaluation, schema 1"):
        render(with_results(folder, {"kind": "other"}))
    (folder / "results" / "made.json").write_text("no")
    with pytest.raises(CardError, match=r"made\.json: expected JSON"):
        render(folder)
    shutil.rmtree(folder / "results")
    (folder / "template.md").write_text("$nothing")
    with pytest.raises(CardError, match=r"expected \$names"):
        render(folder)
    (folder / "template.md").unlink()
    with pytest.raises(CardError, match=r"template\.md: expected this file"):
        render(folder)
    with pytest.raises(CardError, match="expected what huggingface_hub reads"):
        check_model_card("---\nmodel-index: 3\n---\n# x\n")
