"""Recipes: what their names say, and the table of the specification."""

import pytest

from mint_hub.model.losses_mint import MOTION, WORLD
from mint_hub.training.recipes import (
    OPTIONS,
    PARTS,
    Recipe,
    paper_stage1,
    recipe_named,
    release_stage1,
    release_stage2,
)


def test_release_stage_1_trains_everything_on_the_table_of_weights():
    made = release_stage1()
    assert made.trained == PARTS
    assert made.loss.weights["camera/trans_l1"] == 0.025
    assert made.loss.weights["fov/fov_vel_l1"] == pytest.approx(0.1)
    assert not any(name.startswith("world/") for name in made.loss.weights)
    assert made.learning_rates["encoder"] == made.learning_rates["aggregator"] == 5e-5
    assert made.learning_rates["camera_head"] == made.learning_rates["fov_head"] == 1e-4
    assert made.learning_rates["hand_head"] == made.learning_rates["presence_head"] == 5e-4
    assert (made.batch, made.window, made.stride) == (1, 32, 32)
    step = made.optimisation
    assert (step.betas, step.weight_decay, step.clip_value) == ((0.9, 0.95), 0.05, 1.0)
    assert (step.warmup_steps, step.seed, step.bf16) == (2000, 42, True)


def test_release_stage_2_trains_the_camera_head_alone():
    made = release_stage2()
    assert made.trained == ("camera_head",)
    assert {name.split("/")[0] for name in made.loss.weights} == {"camera"}
    assert made.batch == 4


def test_the_paper_adds_the_world_and_observability():
    made = paper_stage1()
    assert made.loss.observability
    assert {n: made.loss.weights[n] for n in WORLD} == WORLD


def test_motion_weighs_the_camera_and_nothing_else():
    before, after = recipe_named("stage1").loss.weights, recipe_named("stage1+motion").loss.weights
    assert {n: after[n] for n in MOTION} == MOTION
    assert {n: w for n, w in after.items() if n not in MOTION} == {
        n: w for n, w in before.items() if n not in MOTION
    }


def test_every_option_changes_a_recipe():
    for option in OPTIONS:
        name = "paper-stage2" if option == "refine" else "paper-stage1"
        base, changed = recipe_named(name), recipe_named(f"{name}+{option}")
        fields = ("loss", "init", "sources", "presence", "augment", "views", "optimisation")
        fields += ("learning_rates", "refine")
        same = all(getattr(changed, f) == getattr(base, f) for f in fields)
        assert same == (option == "world"), option  # the paper's has the world already


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("stage3", "expected stage1, stage2, paper-stage1"),
        ("stage1+colour", "expected options .*got 'colour'"),
        ("stage2+world", "hands are frozen in stage 2"),
        ("stage1+refine", r"expected \+refine after stage2 alone"),
    ],
)
def test_names_that_mean_nothing(name, message):
    with pytest.raises(ValueError, match=message):
        recipe_named(name)


def test_recipes_that_train_nothing_are_refused():
    loss = release_stage1().loss
    with pytest.raises(ValueError, match="expected a part to train"):
        Recipe("none", 1, loss, {"encoder": 0.0}, batch=1)
    with pytest.raises(ValueError, match="'body'"):
        Recipe("none", 1, loss, {"body": 1.0}, batch=1)  # type: ignore[dict-item]


def test_learning_rates_scale_together():
    made = release_stage1().scaled(10)
    assert made.learning_rates["encoder"] == pytest.approx(5e-4)
    assert made.learning_rates["hand_head"] == pytest.approx(5e-3)
