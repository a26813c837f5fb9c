"""The trainer: freezing, clipping, scores, checkpoints, and a run that goes on."""

import errno
import json
import shutil
from dataclasses import replace

import pytest
import torch

from mint_hub.model.modeling_mint import MintModel
from mint_hub.model.processing_mint import MintProcessor
from mint_hub.synth.teacher_noise import TeacherNoise
from mint_hub.training.clips import DataError
from mint_hub.training.recipes import PARTS, recipe_named
from mint_hub.training.run import Request, train
from mint_hub.training.trainer import ClipByValue, Pace, make_optimizer, training_arguments
from tests.training.corpus import WINDOW, config, training_episode, write_packed

STEPS = 4


def small(name: str, **changes):
    """A recipe for windows of four frames, without warm-up."""
    made = recipe_named(name)
    settings = replace(made.optimisation, warmup_steps=0)
    return replace(made, window=WINDOW, stride=WINDOW, optimisation=settings, **changes)


@pytest.fixture(scope="module")
def corpus(tmp_path_factory):
    folder = tmp_path_factory.mktemp("training")
    write_packed(folder, [training_episode(f"e{i}") for i in range(3)])
    write_packed(folder, [training_episode("v0")], split="validation")
    return folder


def request(corpus, out, **changes) -> Request:
    given = {
        "recipe": small("stage1", batch=2),
        "data": [corpus],
        "out": out,
        "pace": Pace(STEPS, log_every=1, save_every=2),
        "config": config(),
        "cpu": True,
    }
    return Request(**(given | changes))


@pytest.fixture(scope="module")
def trained(corpus, tmp_path_factory):
    """A whole stage 1 run, with scores."""
    pace = Pace(STEPS, log_every=1, save_every=2, evaluate_every=4, evaluate_windows=1)
    return train(request(corpus, tmp_path_factory.mktemp("run") / "run", pace=pace))


def losses(report) -> list[float]:
    return [line["loss"] for line in report.log if "loss" in line]


def weights(folder) -> dict[str, torch.Tensor]:
    return MintModel.from_pretrained(folder).state_dict()


# --- a run ----------------------------------------------------------------------------------------


def test_a_run_leaves_a_network_that_loads(trained, corpus):
    assert trained.steps == STEPS
    assert len(losses(trained)) == STEPS
    files = {path.name for path in trained.model.iterdir()}
    assert files == {"README.md", "config.json", "model.safetensors", "processor_config.json"}
    model = MintModel.from_pretrained(trained.model)
    assert model.config.hidden_size == 32
    assert model.config.window == WINDOW != config().window
    size = MintProcessor.from_pretrained(trained.model).video_processor.size
    assert (size["height"], size["width"]) == (28, 42)
    card = (trained.model / "README.md").read_text()
    assert f"{STEPS} of {STEPS}" in card
    assert str(corpus) not in card
    out = trained.model.parent
    assert sorted(p.name for p in out.glob("checkpoint-*")) == ["checkpoint-2", "checkpoint-4"]
    assert not (out / ".saving").exists()
    assert not list(out.rglob("training_args.bin"))
    assert [
        json.loads(line) for line in (out / "log.jsonl").read_text().splitlines()
    ] == trained.log


def test_without_a_gpu_a_run_goes_to_the_cpu_unasked(tmp_path):
    arguments = training_arguments(tmp_path, small("stage1", batch=2), Pace(STEPS))
    assert arguments.use_cpu == (not torch.accelerator.is_available())
    assert training_arguments(tmp_path, small("stage1"), Pace(STEPS), cpu=True).use_cpu


def test_the_log_has_terms_scores_and_frames(trained):
    lines = [line for line in trained.log if "loss" in line]
    assert {"hand/transl_l1", "camera/rot_geo", "image/reprojection"} <= set(lines[0])
    assert [line["frames"] for line in lines] == [2 * WINDOW * k for k in range(1, STEPS + 1)]
    (scores,) = [line for line in trained.log if "eval_MPJPE-p" in line]
    assert {"eval_RPE-T", "eval_loss", "eval_fov-error", "eval_Recall"} <= set(scores)
    assert scores["step"] == 4


def test_a_finished_run_is_left_alone(trained, corpus):
    before = (trained.model / "model.safetensors").stat().st_mtime_ns
    pace = Pace(STEPS, log_every=1, save_every=2, evaluate_every=4, evaluate_windows=1)
    again = train(request(corpus, trained.model.parent, pace=pace))
    assert again.resumed_from == STEPS
    assert again.log == trained.log
    assert (trained.model / "model.safetensors").stat().st_mtime_ns == before


def test_another_run_in_the_same_folder_is_refused(trained, corpus):
    with pytest.raises(ValueError, match="another run lies here: batch was 2, now 1"):
        train(request(corpus, trained.model.parent, recipe=small("stage1", batch=1)))


def test_going_on_is_bit_equal(trained, corpus, tmp_path):
    """A run that went on from its second step has the losses and weights of one that ran on."""
    out = shutil.copytree(trained.model.parent, tmp_path / "run")
    for name in ("model", "checkpoint-4"):
        shutil.rmtree(out / name)
    report = train(request(corpus, out))
    assert report.resumed_from == 2
    assert losses(report) == losses(trained)
    before, after = weights(trained.model), weights(report.model)
    assert all(torch.equal(before[name], after[name]) for name in before)


def test_accumulation_changes_nothing_but_rounding(corpus, tmp_path):
    reports = [
        train(
            request(
                corpus,
                tmp_path / str(micro),
                recipe=small("stage1+fp32", batch=2),
                pace=Pace(2, log_every=1, micro_batch=micro),
            )
        )
        for micro in (1, 2)
    ]
    assert losses(reports[0]) == pytest.approx(losses(reports[1]), rel=1e-5)


# --- stage 2 --------------------------------------------------------------------------------------


def test_stage_2_leaves_every_other_tensor_bit_equal(trained, corpus, tmp_path):
    report = train(
        request(
            corpus,
            tmp_path / "run",
            recipe=small("stage2", batch=2),
            init=str(trained.model),
            config=None,
            pace=Pace(2, log_every=1),
        )
    )
    before, after = weights(trained.model), weights(report.model)
    changed = {name for name in before if not torch.equal(before[name], after[name])}
    assert changed
    assert all(name.startswith("camera_head.") for name in changed)
    assert set(report.log[0]) >= {"camera/trans_vel_l1"}
    assert not any(name.startswith("hand/") for name in report.log[0])


def test_stage_2_refines_by_pictures_from_here_on(trained, corpus, tmp_path):
    """What refines is new, trained, saved and gone on with; the rest of stage 2 is as ever."""
    seeing = {"patch_size": 8, "image_size": (32, 48), "motion_radius": 2}
    sizes = type(config())(**(config().to_dict() | seeing))
    one = {"pace": Pace(1, log_every=1), "config": sizes}
    first = train(request(corpus, tmp_path / "one", **one))
    second = {"recipe": small("stage2+refine", batch=2), "init": str(first.model), "config": None}
    whole = train(request(corpus, tmp_path / "two", **second))
    loaded = MintModel.from_pretrained(whole.model)
    assert loaded.config.camera_refinement == "pictures"
    before, after = weights(first.model), loaded.state_dict()
    new = set(after) - set(before)
    assert new
    assert all(name.startswith("camera_head.refinement.") for name in new)
    assert after["camera_head.refinement.belief.bias"].any()
    changed = {name for name in before if not torch.equal(before[name], after[name])}
    assert changed
    assert all(name.startswith("camera_head.") for name in changed)
    for name in ("model", f"checkpoint-{STEPS}"):
        shutil.rmtree(tmp_path / "two" / name)
    again = train(request(corpus, tmp_path / "two", **second))
    assert again.resumed_from == 2
    assert losses(again) == losses(whole)
    assert "unrefined/camera/trans_l1" in whole.log[0]
    third = {"pace": Pace(1, log_every=1), "init": str(whole.model), "config": None}
    for name, refined in (("stage2", "pictures"), ("stage1", "none")):
        more = train(request(corpus, tmp_path / name, recipe=small(name, batch=2), **third))
        assert MintModel.from_pretrained(more.model).config.camera_refinement == refined
        assert set(weights(more.model)) == set(after if refined == "pictures" else before)
        assert any("left out" in note for note in more.warnings) == (refined == "none")
    blind = second | {"init": str(trained.model)}
    with pytest.raises(ValueError, match="motion_radius: expected at least 1"):
        train(request(corpus, tmp_path / "blind", **blind))
    assert not (tmp_path / "blind").exists()


def test_stage_2_needs_a_stage_1_network(corpus, tmp_path):
    with pytest.raises(ValueError, match=r"stage 1 network.*got 'random'"):
        train(request(corpus, tmp_path / "run", recipe=small("stage2")))
    assert not (tmp_path / "run").exists()


# --- learning -------------------------------------------------------------------------------------


def test_one_window_is_learnt_by_heart(tmp_path):
    """To under 2 mm of every joint and 1 mm of every camera step, in 300 steps."""
    corpus = write_packed(tmp_path / "corpus", [training_episode("e0", WINDOW, gaps=False)])
    write_packed(corpus, [training_episode("e0", WINDOW, gaps=False)], split="validation")
    made = small("stage1+fp32+no-image", batch=1, learning_rates=dict.fromkeys(PARTS, 3e-3))
    settings = replace(made.optimisation, warmup_steps=20, weight_decay=0.0)
    sizes = {"aggregator_layer_scale": 1.0}  # a wider door than for a network of 24 pairs
    report = train(
        request(
            corpus,
            tmp_path / "run",
            recipe=replace(made, optimisation=settings),
            config=type(config())(**(config().to_dict() | sizes)),
            pace=Pace(300, log_every=50, save_every=300, evaluate_every=300),
        )
    )
    (scores,) = [line for line in report.log if "eval_MPJPE-p" in line]
    assert scores["eval_MPJPE-p"] < 2.0
    assert scores["eval_RPE-T"] < 1.0
    assert scores["eval_Recall"] == 1.0


# --- steps ----------------------------------------------------------------------------------------


def test_every_part_has_its_learning_rate_and_no_parameter_is_forgotten():
    model, made = MintModel(config()), recipe_named("stage1")
    optimizer = make_optimizer(model, made)
    assert [group["name"] for group in optimizer.param_groups] == list(PARTS)
    for group in optimizer.param_groups:
        assert group["lr"] == made.learning_rates[group["name"]]
        assert group["weight_decay"] == 0.05
        assert group["betas"] == (0.9, 0.95)
    taken = sum(len(group["params"]) for group in optimizer.param_groups)
    assert taken == sum(p.requires_grad for p in model.parameters())


def test_gradients_are_clipped_by_value():
    layer = torch.nn.Linear(2, 1, bias=False)
    layer.weight.grad = torch.tensor([[30.0, -0.5]])
    ClipByValue(1.0).on_pre_optimizer_step(None, None, None, model=layer)
    assert layer.weight.grad.tolist() == [[1.0, -0.5]]


def test_clipping_happens_in_the_run(corpus, tmp_path, monkeypatch):
    seen = []
    own = torch.optim.AdamW.step

    def step(self, *args, **kwargs):
        grads = [p.grad.abs().max() for g in self.param_groups for p in g["params"]]
        seen.append(float(torch.stack(grads).max()))
        return own(self, *args, **kwargs)

    monkeypatch.setattr(torch.optim.AdamW, "step", step)
    train(request(corpus, tmp_path / "run", pace=Pace(2, log_every=1)))
    assert len(seen) == 2
    assert max(seen) == 1.0


def test_a_loss_that_is_not_finite_stops_the_run(corpus, tmp_path, monkeypatch):
    from mint_hub.model import losses_mint

    monkeypatch.setitem(
        losses_mint.TERMS, "fov/fov_l1", lambda case: case.fov.mine.sum() * torch.nan
    )
    with pytest.raises(RuntimeError, match=r"step 1: the loss is nan \(fov/fov_l1\)"):
        train(request(corpus, tmp_path / "run"))


@pytest.mark.parametrize("world", [1, 2])
def test_batches_that_cannot_be_split(tmp_path, world):
    pace = Pace(2, micro_batch=2 if world == 1 else 1)
    with pytest.raises(ValueError, match="batch: expected a multiple"):
        training_arguments(tmp_path, small("stage1", batch=3), pace, world_size=world)


# --- refused, nothing half-written ----------------------------------------------------------------


def test_requests_that_contradict_themselves(corpus, tmp_path):
    out = tmp_path / "run"
    for changes, message in (
        ({"recipe": small("stage1+pretrained")}, "expected a checkpoint as --init"),
        ({"recipe": small("stage1+random"), "init": "x.pt"}, "expected --init random"),
        ({"init": str(tmp_path / "nowhere")}, "no such folder"),
        ({"init": str(tmp_path / "lingbot-map.pt")}, "no such file"),
        ({"recipe": recipe_named("stage1")}, "more than the 2000 steps of warm-up"),
        ({"data": [tmp_path]}, "expected a corpus with a train split"),
        ({"validation": [corpus]}, "validation: expected with evaluate_every"),
        ({"recipe": small("stage2"), "init": "x", "noise": TeacherNoise()}, "no teacher noise"),
        ({"pace": Pace(2, evaluate_every=1), "validation": [tmp_path]}, "with a validation split"),
        ({"config": type(config())(**(config().to_dict() | {"shape_space": "mano"}))}, "'mint'"),
    ):
        with pytest.raises(ValueError, match=message):
            train(request(corpus, out, **changes))
        assert not (out / "run.json").exists()
        assert not list(out.glob("checkpoint-*"))


def test_one_source_is_kept_to(tmp_path):
    metas = ({}, {"source": "other"})
    episodes = [training_episode(f"e{i}", meta=meta) for i, meta in enumerate(metas)]
    corpus = write_packed(tmp_path / "corpus", episodes)
    with pytest.raises(DataError, match="expected data of one source, got made, other"):
        train(request(corpus, tmp_path / "run", recipe=small("stage1+one-source")))


def test_a_checkpoint_of_another_size(trained, corpus, tmp_path):
    other = type(config())(**(config().to_dict() | {"hidden_size": 48}))
    with pytest.raises(ValueError, match="do not fit"):
        train(request(corpus, tmp_path / "run", init=str(trained.model), config=other))
    assert not (tmp_path / "run" / "run.json").exists()  # the mended command may have the folder
    assert other.window == config().window
    out = shutil.copytree(trained.model.parent, tmp_path / "trained")
    for name in ("model", "checkpoint-4"):
        shutil.rmtree(out / name)
    with pytest.raises(ValueError, match="another run lies here: config was"):
        train(request(corpus, out, config=other))


@pytest.mark.parametrize("at", [2, 4])
def test_out_of_disk_while_saving(corpus, tmp_path, monkeypatch, at):
    own, calls = MintModel.save_pretrained, []

    def save(self, folder, *args, **kwargs):
        calls.append(folder)
        if len(calls) == at // 2:
            own(self, folder, *args, **kwargs)
            raise OSError(errno.ENOSPC, "No space left on device")
        return own(self, folder, *args, **kwargs)

    monkeypatch.setattr(MintModel, "save_pretrained", save)
    out = tmp_path / "run"
    with pytest.raises(OSError, match=rf"checkpoint-{at}: could not be saved.*No space left"):
        train(request(corpus, out))
    assert not (out / ".saving").exists()
    assert [p.name for p in out.glob("checkpoint-*")] == (["checkpoint-2"] if at == 4 else [])
    monkeypatch.undo()
    report = train(request(corpus, out))  # the same command goes on
    assert report.resumed_from == at - 2
    assert report.steps == STEPS
