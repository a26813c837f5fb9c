"""The losses against the golden numbers, by hand, by their gradients, and under masks."""

import json
import math
from dataclasses import replace

import pytest
import torch
from safetensors.torch import load_file

from mint_hub.geometry.hand_model import HandModel
from mint_hub.geometry.rotations import rotvec_to_matrix
from mint_hub.model.losses_mint import (
    ATTENTION_TERM,
    GUIDE,
    RELEASE_STAGE_1,
    RELEASE_STAGE_2,
    TERMS,
    WORLD,
    LossCase,
    LossSettings,
    rotation_distance,
    total,
)
from tests.model.losses import SIZE_HW, random_case
from tests.small_model import small_model
from tests.transformers_common.tiny import tiny_labels

OUTPUT_TERMS = [name for name in TERMS if name != ATTENTION_TERM]
ALL = LossSettings(dict.fromkeys(OUTPUT_TERMS, 1.0))
HAND_TERMS = sorted(n for n in OUTPUT_TERMS if n.split("/")[0] in ("hand", "world", "image"))


@pytest.fixture(scope="module")
def expected(golden_dir):
    return json.loads((golden_dir / "losses_expected.json").read_text())


@pytest.fixture(scope="module")
def golden(golden_dir) -> LossCase:
    data = load_file(golden_dir / "losses_inputs.safetensors")
    batch, frames = data["pred.hand"].shape[:2]
    prediction = {
        "pose_encoding": data["pred.pose_enc"],
        "hand_state": data["pred.hand"].view(batch, frames, 2, 109),
        "presence_logits": data["pred.hand_presence_logits"],
    }
    labels = {
        "pose_encoding": data["batch.gt_pose_enc"],
        "hand_state": data["batch.hand_gt"].view(batch, frames, 2, 109),
        "presence": data["batch.hand_kept"],
        "hands_known": data["batch.mano_gt_valid"],
        "translation_std": data["batch.camera_trans_position_std"],
        "velocity_std": data["batch.camera_trans_velocity_std"],
        "acceleration_std": data["batch.camera_trans_acceleration_std"],
    }
    return LossCase(prediction, labels, LossSettings(RELEASE_STAGE_1))


# --- golden ---------------------------------------------------------------------------------------


def test_every_golden_term(golden, expected):
    names = {f"hand/{name}": value for name, value in expected["mano_terms"].items()}
    for name, value in expected["camera_terms"].items():
        names[f"{'fov' if name.startswith('fov') else 'camera'}/{name}"] = value
    names["presence/bce"] = expected["stage1"]["loss/hand_presence/bce"]
    assert len(names) == 28
    for name, value in names.items():
        assert TERMS[name](golden).item() == pytest.approx(value, rel=1e-6), name


@pytest.mark.parametrize(
    ("stage", "weights"), [("stage1", RELEASE_STAGE_1), ("stage2", RELEASE_STAGE_2)]
)
def test_golden_totals(golden, expected, stage, weights):
    settings = LossSettings(weights).without("image")
    loss, terms = total(replace(golden, settings=settings))
    assert loss.item() == pytest.approx(expected[stage]["loss"], rel=1e-6)
    assert loss.item() == pytest.approx(sum(weights[n] * v.item() for n, v in terms.items()))
    groups = {"camera": "camera", "fov": "fov", "hand": "mano_param", "presence": "hand_presence"}
    for ours, theirs in groups.items():
        if (value := expected[stage].get(f"contrib/{theirs}")) is not None:
            mine = sum(weights[n] * v for n, v in terms.items() if n.split("/")[0] == ours)
            assert mine.item() == pytest.approx(value, rel=1e-6), ours


# --- by hand --------------------------------------------------------------------------------------


def still_case(frames: int = 4, **settings) -> LossCase:
    """A prediction that equals its truth: camera at rest, hands before it, both seen."""
    labels = {k: v.double() for k, v in tiny_labels(1, frames).items()}
    labels["presence"] = labels["presence"].bool()
    labels["hand_state"] = labels["hand_state"].clone()
    labels["pose_encoding"] = labels["pose_encoding"].clone()
    prediction = {
        "pose_encoding": labels["pose_encoding"].clone(),
        "hand_state": labels["hand_state"].clone(),
        "presence_logits": torch.full((1, frames, 2), 3.0, dtype=torch.float64),
    }
    return LossCase(prediction, labels, replace(ALL, **settings), image_size_hw=SIZE_HW)


def test_a_perfect_prediction_costs_nothing():
    _, terms = total(still_case())
    for name, value in terms.items():
        limit = math.atan2(1e-4 / (2 * math.sqrt(2)), 1)  # of rotation_distance
        assert value.item() <= (0.05 if name == "presence/bce" else limit + 1e-9), name


def test_rotation_distance_is_the_angle():
    generator = torch.Generator().manual_seed(0)
    axis = torch.nn.functional.normalize(torch.randn(50, 3, generator=generator).double(), dim=-1)
    angle = torch.linspace(0.01, math.pi - 0.01, 50, dtype=torch.float64)
    R = rotvec_to_matrix(axis * angle[:, None])
    A = rotvec_to_matrix(torch.randn(50, 3, generator=generator).double())
    torch.testing.assert_close(rotation_distance(R @ A, A), angle, atol=1e-6, rtol=0)


def test_image_term_of_a_shift_along_the_image():
    case = still_case()
    height, _ = SIZE_HW
    focal = height / (2 * math.tan(0.5))  # vertical field of view of 1 rad
    case.prediction["hand_state"][..., 1] += 0.02
    moved = TERMS["image/reprojection"](case).item()
    joints = HandModel.template().keypoints(case.labels["hand_state"])
    uv = joints[..., 1] / joints[..., 2] * focal + height / 2
    seen = (uv >= 0) & (uv < height)
    assert seen.all()
    assert moved == pytest.approx((focal * 0.02 / joints[..., 2]).mean().item(), rel=1e-6)


def test_image_term_caps_misses_and_hands_called_absent():
    diagonal = math.hypot(*SIZE_HW)
    behind, missed, far = still_case(), still_case(), still_case()
    behind.prediction["hand_state"][..., 2] = -0.4
    missed.prediction["presence_logits"][:, :, 0] = -1.0
    far.prediction["hand_state"][..., 0] += 50.0
    for case, share in ((behind, 1.0), (missed, 0.5), (far, 1.0)):
        for value in case.prediction.values():
            value.requires_grad_()
        value = TERMS["image/reprojection"](case)
        assert value.item() == pytest.approx(share * diagonal, rel=1e-9)
    value = TERMS["image/reprojection"](behind)
    value.backward()
    assert not behind.prediction["hand_state"].grad.any()
    TERMS["image/reprojection"](missed).backward()
    assert not missed.prediction["hand_state"].grad[:, :, 0].any()


def test_image_term_counts_true_joints_on_screen_only():
    case = still_case()
    case.labels["hand_state"][:, :, 0, 0] = 30.0  # the left hand is far outside
    case.prediction["hand_state"][:, :, 0, 0] = -30.0
    assert TERMS["image/reprojection"](case).item() == pytest.approx(0.0, abs=1e-9)


def test_attention_term_by_hand():
    """Attention spread evenly over 8 x 10 patches of 14 pixels, then all on patches with joints."""
    case = replace(still_case(), grid_hw=(8, 10))
    uv, _ = case.joints_on_screen
    cells = (uv // 14).long()
    numbers = cells[..., 1] * 10 + cells[..., 0]  # (B, T, 2, 21)
    holds = torch.nn.functional.one_hot(numbers, 80).amax(-2).double()
    even = torch.full((*holds.shape[:-1], 3, 80), 1 / 80, dtype=torch.float64)
    case.prediction["patch_attention"] = even
    expected = -(holds.sum(-1) / 80 + 1e-4).log().mean()
    assert TERMS[ATTENTION_TERM](case).item() == pytest.approx(expected.item(), rel=1e-9)
    first = torch.nn.functional.one_hot(numbers[..., 7], 80).double()
    case.prediction["patch_attention"] = first[..., None, :].expand_as(even)
    assert TERMS[ATTENTION_TERM](case).item() == pytest.approx(0.0, abs=2e-4)


def test_attention_term_leaves_absent_hands_alone_and_asks_for_attention():
    case = replace(still_case(), grid_hw=(8, 10))
    with pytest.raises(ValueError, match="expected patch_attention in the prediction, got none"):
        TERMS[ATTENTION_TERM](case)
    given = torch.rand(*case.labels["presence"].shape, 2, 80, dtype=torch.float64)
    case.labels["presence"][:, :, 1] = False
    case.prediction["patch_attention"] = given.requires_grad_()
    TERMS[ATTENTION_TERM](case).backward()
    assert given.grad[:, :, 0].any()
    assert not given.grad[:, :, 1].any()


def test_a_network_gives_its_loss_what_it_attends_to():
    model = small_model()
    settings = model.loss_settings
    model.loss_settings = replace(settings, weights={**settings.weights, **GUIDE})
    seen = {}
    plain = model._loss_case

    def keep(*given):
        seen["case"] = plain(*given)
        return seen["case"]

    model._loss_case = keep
    output = model(torch.rand(2, 3, 3, 28, 42), labels=tiny_labels(2, 3))
    given = seen["case"].prediction["patch_attention"]
    assert given.shape == (2, 3, 2, 2 * 4 + 1, 6)  # two iterations of four queries, one of presence
    assert (given.sum(-1) <= 1 + 1e-5).all()
    torch.testing.assert_close(given[..., -1, :].sum(-1), torch.ones(2, 3, 2))
    without = small_model()(torch.rand(2, 3, 3, 28, 42), labels=tiny_labels(2, 3))
    assert set(output.losses) - set(without.losses) == {ATTENTION_TERM}


def test_world_terms_by_hand():
    """A camera that stands 0.3 m further along x puts hands 0.3 m away; turned, they turn."""
    case = still_case()
    case.prediction["pose_encoding"][..., 0] = -0.3  # t = -R c
    assert TERMS["world/transl_l1"](case).item() == pytest.approx(0.3 / 3, rel=1e-9)
    assert TERMS["world/transl_vel_l1"](case).item() == pytest.approx(0.0, abs=1e-12)
    assert TERMS["world/orient_geo"](case).item() < 1e-4
    case = still_case()
    half = 0.2 / 2  # turned by 0.2 rad about y
    quat = torch.tensor([0.0, math.sin(half), 0.0, math.cos(half)], dtype=torch.float64)
    case.prediction["pose_encoding"][..., 3:7] = quat
    assert TERMS["world/orient_geo"](case).item() == pytest.approx(0.2, abs=1e-6)
    # p_w = R^T p: 0.4 m ahead swings to (-sin, 0, cos) of it
    moved = 0.4 * (math.sin(0.2) + 1 - math.cos(0.2)) / 3
    assert TERMS["world/transl_l1"](case).item() == pytest.approx(moved, rel=1e-6)
    case = still_case(frames=3)
    case.prediction["pose_encoding"][0, :, 0] = torch.tensor([0.0, -0.1, -0.3])
    assert TERMS["world/transl_vel_l1"](case).item() == pytest.approx((0.1 + 0.2) / 2 / 3)


def test_presence_learns_from_its_target():
    case = still_case()
    case.labels["presence_target"] = torch.full((1, 4, 2), 0.25)
    p = 1 / (1 + math.exp(-3.0))
    value = -(0.25 * math.log(p) + 0.75 * math.log(1 - p))
    assert TERMS["presence/bce"](case).item() == pytest.approx(value, rel=1e-6)


# --- gradients ------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", sorted(OUTPUT_TERMS))
@pytest.mark.parametrize("observability", [False, True])
def test_gradients_are_those_of_the_values(name, observability):
    settings = LossSettings({name: 1.0}, observability=observability)
    case = random_case(settings, seed=3, batch=1, frames=4)
    names = sorted(case.prediction)
    moving = [n for n in names if not (observability and n == "presence_logits")]

    def value(*tensors: torch.Tensor) -> torch.Tensor:
        prediction = case.prediction | dict(zip(moving, tensors, strict=True))
        return TERMS[name](replace(case, prediction=prediction))

    inputs = [case.prediction[n].clone().requires_grad_() for n in moving]
    assert torch.autograd.gradcheck(value, inputs, fast_mode=True, atol=1e-5)


# --- masks ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", HAND_TERMS)
def test_a_masked_hand_changes_nothing(name):
    case = random_case(LossSettings({name: 1.0}), seed=1)
    gone = ~case.labels["presence"]
    assert gone.any()
    before = TERMS[name](case)
    other = random_case(LossSettings({name: 1.0}), seed=2)
    hands = {
        source: torch.where(gone[..., None], getattr(other, source)["hand_state"], x["hand_state"])
        for source, x in (("prediction", case.prediction), ("labels", case.labels))
    }
    hands["labels"] = hands["labels"].masked_fill(gone[..., None], float("nan"))
    changed = replace(
        case,
        prediction=case.prediction | {"hand_state": hands["prediction"].requires_grad_()},
        labels=case.labels | {"hand_state": hands["labels"]},
    )
    after = TERMS[name](changed)
    assert after.item() == before.item()
    if after.requires_grad:
        after.backward()
        grad = changed.prediction["hand_state"].grad
        assert torch.isfinite(grad).all()
        assert not grad[gone].any()


def test_a_record_without_hands_trains_the_camera_alone():
    case = random_case(ALL)
    labels = case.labels | {"hands_known": torch.zeros(2, dtype=torch.bool)}
    labels["hand_state"] = torch.full_like(labels["hand_state"], float("nan"))
    _, terms = total(replace(case, labels=labels))
    for name, value in terms.items():
        if name.split("/")[0] in ("hand", "world", "image", "presence"):
            smooth = name == "hand/transl_acc_smooth_charbonnier"
            assert value.item() == 0.0 or smooth, name
        else:
            assert value.item() > 0, name


def test_observability_decides_which_hands_contribute():
    settings = LossSettings({"hand/transl_l1": 1.0}, observability=True)
    case = still_case()
    case.prediction["hand_state"][:, :, 0, :3] += 0.3
    case.prediction["presence_logits"][:, :, 0] = -40.0
    value = TERMS["hand/transl_l1"](replace(case, settings=settings))
    assert value.item() == pytest.approx(0.0, abs=1e-9)


def test_per_window_does_not_depend_on_the_batch():
    settings = replace(ALL, per_window=True)
    case = random_case(settings, batch=3)
    together, _ = total(case)
    apart = []
    for b in range(3):
        one = replace(
            case,
            prediction={k: v[b : b + 1] for k, v in case.prediction.items()},
            labels={k: v[b : b + 1] for k, v in case.labels.items()},
        )
        apart.append(total(one)[0])
    torch.testing.assert_close(together, torch.stack(apart).mean())


@pytest.mark.parametrize("frames", [1, 2])
def test_short_windows_have_finite_losses(frames):
    case = random_case(replace(ALL, per_window=True), frames=frames)
    loss, terms = total(case)
    assert torch.isfinite(loss)
    assert terms["hand/transl_acc_l1"].item() == 0.0


# --- in the model ---------------------------------------------------------------------------------


def test_forward_returns_the_loss_and_its_terms():
    model = small_model()
    pixels = torch.rand(2, 3, 3, *model.config.image_size, generator=torch.Generator())
    output = model(pixel_values=pixels, labels=tiny_labels(2, 3))
    assert set(output.losses) == set(RELEASE_STAGE_1)
    expected = sum(RELEASE_STAGE_1[n] * v for n, v in output.losses.items())
    torch.testing.assert_close(output.loss, expected)
    model.loss_settings = LossSettings(WORLD)
    assert set(model(pixel_values=pixels, labels=tiny_labels(2, 3)).losses) == set(WORLD)
    assert model(pixel_values=pixels).loss is None


def broken(**change) -> dict[str, torch.Tensor]:
    return {k: v for k, v in (tiny_labels(1, 2) | change).items() if v is not None}


@pytest.mark.parametrize(
    ("labels", "message"),
    [
        (broken(presence=None), r"labels\['presence'\]: expected a tensor"),
        (broken(presence=torch.ones(1, 3, 2)), r"expected shape \(1, 2, 2\), got \(1, 3, 2\)"),
        (broken(hand_state=torch.full((1, 2, 2, 109), torch.nan)), "expected finite numbers"),
        (broken(pose_encoding=torch.full((1, 2, 9), torch.inf)), "expected finite numbers"),
        (broken(colour=torch.ones(1)), "got 'colour'"),
    ],
)
def test_labels_that_cannot_be_used(labels, message):
    model = small_model()
    with pytest.raises(ValueError, match=message):
        model(pixel_values=torch.rand(1, 2, 3, *model.config.image_size), labels=labels)


def test_settings_that_cannot_be_used():
    with pytest.raises(ValueError, match="'hand/colour'"):
        LossSettings({"hand/colour": 1.0})
    with pytest.raises(ValueError, match=r"fov/fov_l1.*got -1"):
        LossSettings({"fov/fov_l1": -1.0})
