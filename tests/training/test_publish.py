"""Handing out a checkpoint: half precision, the record of every run, and nothing half-written."""

import json
import math
from dataclasses import replace

import cv2
import pytest
import torch
from safetensors import safe_open

from mint_hub.cards.sources import CardError
from mint_hub.model.modeling_mint import MintModel
from mint_hub.model.processing_mint import MintProcessor
from mint_hub.training.curve import SHOWN, training_curve
from mint_hub.training.publish import publish
from mint_hub.training.recipes import recipe_named
from mint_hub.training.run import Request, train
from mint_hub.training.trainer import Pace
from tests.training.corpus import WINDOW, config, training_episode, write_packed


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """A first stage and a second one that begins there."""
    folder = tmp_path_factory.mktemp("runs")
    write_packed(folder / "clips", [training_episode(f"e{i}") for i in range(2)])
    write_packed(folder / "clips", [training_episode("v0")], split="validation")
    made = []
    for stage, steps in ((1, 3), (2, 2)):
        recipe = recipe_named(f"stage{stage}")
        recipe = replace(
            recipe,
            window=WINDOW,
            stride=WINDOW,
            batch=1,
            optimisation=replace(recipe.optimisation, warmup_steps=0),
        )
        out = folder / f"stage{stage}"
        train(
            Request(
                recipe,
                [folder / "clips"],
                out,
                Pace(steps, log_every=1, save_every=5, evaluate_every=1, evaluate_windows=1),
                init="random" if stage == 1 else str(made[0] / "model"),
                config=config() if stage == 1 else None,
                cpu=True,
                command=f"mint-hub train --recipe stage{stage}",
            )
        )
        made.append(out)
    return made


@pytest.fixture(scope="module")
def folder(runs, tmp_path_factory):
    return publish(runs, tmp_path_factory.mktemp("out") / "tiny", limits="It knows *nothing*.")


def test_the_last_runs_network_in_half_precision(runs, folder):
    trained = MintModel.from_pretrained(runs[-1] / "model", dtype=torch.float32).state_dict()
    with safe_open(folder / "model.safetensors", "pt") as file:
        names = set(file.keys())
        for name in names:
            tensor = file.get_tensor(name)
            assert tensor.dtype == torch.bfloat16, name
            assert torch.equal(tensor, trained[name].to(torch.bfloat16)), name
    assert names == set(trained)
    loaded = MintModel.from_pretrained(folder)
    assert loaded.dtype == torch.bfloat16
    assert MintProcessor.from_pretrained(folder).video_processor.size["height"] == 28


def test_the_record_of_all_runs(runs, folder):
    record = json.loads((folder / "run.json").read_text())["runs"]
    assert [r["command"] for r in record] == [f"mint-hub train --recipe stage{k}" for k in (1, 2)]
    assert [r["stage"] for r in record] == [1, 2]
    assert all(r["seed"] == 42 and len(r["data"]) == 16 for r in record)
    lines = [json.loads(line) for line in (folder / "log.jsonl").read_text().splitlines()]
    seen = [line["frames"] for line in lines if "loss" in line]
    assert seen == [WINDOW * k for k in range(1, 6)]
    card = (folder / "README.md").read_text()
    assert card.count("\n---\n") == 1
    assert "It knows *nothing*." in card
    assert "mint-hub train --recipe stage2" in card


def test_hands_are_told_from_the_wanted_visible_share_on(runs, folder, tmp_path):
    """What was a logit of a quarter is a logit of 0 now; nothing else changed."""
    shifted = publish(runs, tmp_path / "tiny", presence_share=0.25)
    before, after = (MintModel.from_pretrained(f).state_dict() for f in (folder, shifted))
    name = "presence_head.classifier.bias"
    moved = (after.pop(name) - before.pop(name)).float()
    torch.testing.assert_close(moved, torch.full((1,), math.log(3)), atol=1e-2, rtol=0)
    assert all(torch.equal(after[n], before[n]) for n in before)
    assert json.loads((shifted / "run.json").read_text())["presence_share"] == 0.25
    assert "visible share of 0.25 on" in (shifted / "README.md").read_text()
    with pytest.raises(ValueError, match="presence_share: expected more than 0"):
        publish(runs, tmp_path / "none", presence_share=1.0)


def test_the_curve_comes_along(folder):
    image = cv2.imread(str(folder / "curve.png"))
    assert image.shape[1] == 3 * 300


def test_the_curve_has_a_panel_for_every_score():
    lines = [
        {"run": k // 2, "frames": 100 * k, **{f"eval_{name}": 5.0 - k for name in SHOWN}}
        for k in range(4)
    ]
    image = training_curve(lines)
    assert image.shape == (3 * 190, 3 * 300, 3)
    for row in range(3):
        for column in range(3):
            panel = image[190 * row : 190 * (row + 1), 300 * column : 300 * (column + 1)]
            assert (panel.min(-1) < 200).mean() > 0.005  # something is drawn
    assert training_curve([{"frames": 1, "eval_GO-p": 2.0}]).shape == (190, 900, 3)
    with pytest.raises(ValueError, match="expected lines with scores"):
        training_curve([{"loss": 1.0, "frames": 3}])


def test_what_was_there_is_replaced_whole(runs, folder, tmp_path):
    out = tmp_path / "tiny"
    out.mkdir()
    (out / "old").write_text("x")
    publish(runs[:1], out)
    assert not (out / "old").exists()
    assert len(json.loads((out / "run.json").read_text())["runs"]) == 1
    assert [p.name for p in tmp_path.iterdir()] == ["tiny"]


def test_what_cannot_be_handed_out_leaves_what_was_there(runs, tmp_path):
    out = tmp_path / "tiny"
    out.mkdir()
    (out / "old").write_text("x")
    with pytest.raises(ValueError, match="at least one folder"):
        publish([], out)
    (tmp_path / "begun").mkdir()
    with pytest.raises(ValueError, match=r"begun: expected a finished run"):
        publish([tmp_path / "begun"], out)
    with pytest.raises(CardError, match="expected results of"):
        publish(runs, out, [tmp_path / "none.json"])
    assert (out / "old").read_text() == "x"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["begun", "tiny"]
