"""The card of the model is a fresh rendering, and the hub's classes read what it says."""

import json
import shutil
from pathlib import Path

import pytest
from huggingface_hub import ModelCard

from mint_hub.cards.__main__ import main
from mint_hub.cards.model import (
    NO_RESULTS,
    card_head,
    check_model_card,
    keep_results,
    load_results,
    render,
)
from mint_hub.cards.sources import CardError
from mint_hub.evaluation.clips import Source
from mint_hub.evaluation.evaluate import evaluate
from mint_hub.evaluation.predictor import Predictor
from tests.evaluation_data import noisy, save_all, true_episode

FOLDER = Path(__file__).parents[2] / "model_card"


@pytest.fixture
def folder(tmp_path):
    """The card's sources without the results that are kept."""
    ignore = shutil.ignore_patterns("results")
    return shutil.copytree(FOLDER, tmp_path / "model_card", ignore=ignore)


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
    values["rows"][0]["name"] = "mint-small"
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
    assert "learned from synthetic clips only" in screen


def test_without_results_no_number_is_claimed():
    models = [
        r for r in load_results(FOLDER) if (r["prediction"] or {}).get("kind") == "checkpoint"
    ]
    assert (NO_RESULTS in render(FOLDER)) == (not models)
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
    assert "| **mint-small** | mean hand | always present | zero camera motion |" in text
    line = next(x for x in text.splitlines() if x.startswith("| MPJPE-p (mm) |"))
    low, high = next(r for r in results["rows"] if r["row"] == "prediction")["hands"]["published"][
        "MPJPE-p"
    ][1:]
    assert f"{value:.2f} [{low:.2f}, {high:.2f}]" in line


def test_evaluations_of_the_same_clips_share_a_table(folder, results):
    """Labels and rows without a model have columns, but no place in the model-index."""
    labels = json.loads(json.dumps(results))
    labels["prediction"] = {"name": "by hand", "kind": "labels", "episodes": 3}
    labels["rows"][0]["name"] = "by hand"
    bare = {**results, "prediction": None, "rows": results["rows"][1:]}
    (folder / "results").mkdir()
    for name, values in (("c", bare), ("b", labels), ("a", results)):
        (folder / "results" / f"{name}.json").write_text(json.dumps(values))
    text = render(folder)
    assert text.count("| MPJPE-p (mm) |") == 1
    assert "| **mint-small** | **by hand** | mean hand |" in text
    assert "**by hand**: labels, not a model of this repository" in text
    assert NO_RESULTS not in text
    head = card_head(load_results(folder))
    assert [entry["name"] for entry in head["model-index"]] == ["mint-small"]
    names = [m["name"] for m in head["model-index"][0]["results"][0]["metrics"]]
    assert names.count("MPJPE-p (mm)") == 1
    (folder / "results" / "a.json").unlink()
    assert NO_RESULTS in render(folder)
    assert "model-index" not in card_head(load_results(folder))


def test_a_card_is_of_one_checkpoint(folder, results):
    """huggingface_hub reads all entries of an index as one model's."""
    other = json.loads(json.dumps(results))
    other["prediction"]["name"] = other["rows"][0]["name"] = "mint-tiny"
    with pytest.raises(CardError, match=r"expected evaluations of one .* mint-small .* mint-tiny"):
        card_head([results, other])
    retrained = json.loads(json.dumps(results))
    retrained["prediction"]["weights"] = "f" * 16
    with pytest.raises(CardError, match=r"got 2: mint-small .0123456789abcdef., mint-small .ffff"):
        render_two(folder, results, retrained)
    elsewhere = json.loads(json.dumps(results))
    elsewhere["benchmark"].update(name="bench", hash="1" * 16)
    index = card_head([results, elsewhere])["model-index"]
    assert [entry["name"] for entry in index] == ["mint-small"]


def render_two(folder, one, other):
    (folder / "results").mkdir(exist_ok=True)
    for name, values in (("one", one), ("other", other)):
        (folder / "results" / f"{name}.json").write_text(json.dumps(values))
    return render(folder)


@pytest.mark.parametrize(
    ("facts", "name"),
    [
        ({"name": "shards", "config": "ego4d", "split": "validation"}, "shards-ego4d-validation"),
        ({"name": "arctic", "protocol": "p1", "split": "val"}, "arctic-val-p1"),
        ({"name": "hot3d", "clip_frames": 81}, "hot3d-81-frames"),
    ],
)
def test_evaluations_of_other_clips_do_not_replace_each_other(
    folder, results, tmp_path, facts, name
):
    made = tmp_path / "evaluation"
    made.mkdir()
    values = {**results, "benchmark": {**results["benchmark"], **facts}}
    (made / "results.json").write_text(json.dumps(values))
    (made / "tables.md").write_text("# all\n")
    assert keep_results(made, folder).name == f"{name}-mint-small.json"


def test_results_are_kept_without_their_clips(folder, results, tmp_path):
    made = tmp_path / "evaluation"
    made.mkdir()
    (made / "results.json").write_text(json.dumps({**results, "clips": [{"key": "a"}]}))
    with pytest.raises(CardError, match=r"tables\.md: expected this file"):
        keep_results(made, folder)
    (made / "tables.md").write_text("# all\n")
    kept = keep_results(made, folder)
    assert kept == folder / "results" / "labels-mint-small.json"
    assert kept.with_suffix(".md").read_text() == "# all\n"
    assert load_results(folder) == [results]
    assert keep_results(made, folder) == kept
    with pytest.raises(CardError, match=r"results\.json: expected results .* got no file"):
        keep_results(tmp_path, folder)


def test_command_keeps_results_and_names_what_is_none(folder, results, tmp_path, monkeypatch):
    made = tmp_path / "evaluation"
    made.mkdir()
    (made / "results.json").write_text(json.dumps(results))
    (made / "tables.md").write_text("# all\n")
    shutil.copytree(FOLDER.parent / "dataset_card", folder.parent / "dataset_card")
    call = ["cards", str(folder.parent), "--keep", str(made)]
    monkeypatch.setattr("sys.argv", [*call, str(tmp_path / "none")])
    with pytest.raises(SystemExit, match=r"none/results\.json: expected results"):
        main()
    monkeypatch.setattr("sys.argv", call)
    main()
    assert "**mint-small**" in (folder / "README.md").read_text()


def test_a_changed_result_makes_the_card_stale(folder, results):
    before = render(with_results(folder, results))
    for row in results["rows"]:
        if row["row"] == "prediction":
            row = json.loads(json.dumps(row))
            row["hands"]["published"]["FAcc"] = [0.123, None, None]
            changed = {**results, "rows": [row, *results["rows"][1:]]}
    assert render(with_results(folder, changed)) != before


def test_errors_teach(folder, results):
    lost = {k: v for k, v in results.items() if k != "rows"}
    with pytest.raises(CardError, match="expected mint-hub evaluation with rows, got none"):
        render(with_results(folder, lost))
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
