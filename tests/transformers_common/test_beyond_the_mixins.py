"""What one expects of a model in transformers, and its common tests check on GPUs or not at all."""

import copy
import importlib.util
from pathlib import Path

import pytest
import torch

from mint_hub.model.configuration_mint import MintConfig
from mint_hub.model.modeling_mint import MintModel, MintOutput
from tests.transformers_common.tiny import tiny_config, tiny_input

TENSORS = ("last_hidden_state", "pose_encoding", "hand_state", "initial_hand_state")


@pytest.fixture
def model() -> MintModel:
    """A network whose increments and tokens are not at zero, where much would be hidden."""
    torch.manual_seed(0)
    model = MintModel(tiny_config()).eval()
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.02 * torch.randn_like(parameter))
    return model


@pytest.fixture
def pixels(model: MintModel) -> torch.Tensor:
    return tiny_input(model.config)


@pytest.fixture
def folder(model: MintModel, tmp_path: Path) -> Path:
    model.save_pretrained(tmp_path)
    return tmp_path


def assert_close(got: MintOutput, expected: MintOutput, tolerance: float = 1e-5) -> None:
    for name in (*TENSORS, "presence_logits"):
        torch.testing.assert_close(
            got[name].float(), expected[name].float(), atol=tolerance, rtol=tolerance, msg=name
        )


@pytest.mark.parametrize("implementation", ["sdpa", "eager"])
def test_compiled_without_graph_breaks_it_computes_the_same(model, pixels, implementation):
    model.set_attn_implementation(implementation)
    torch.compiler.reset()
    compiled = torch.compile(model, fullgraph=True, backend="eager")
    with torch.no_grad():
        assert_close(compiled(pixel_values=pixels), model(pixel_values=pixels))
        longer = torch.cat([pixels, pixels], 1)
        assert_close(compiled(pixel_values=longer), model(pixel_values=longer))


def test_compiled_without_graph_breaks_it_has_the_same_gradients(model, pixels):
    torch.compiler.reset()
    expected = gradients(copy.deepcopy(model), pixels)
    compiled = torch.compile(model, fullgraph=True, backend="aot_eager")
    compare_gradients(gradients(compiled, pixels, of=model), expected)


def test_exported_it_computes_the_same(model, pixels):
    program = torch.export.export(model, (), {"pixel_values": pixels}, strict=False)
    with torch.no_grad():
        assert_close(program.module()(pixel_values=pixels), model(pixel_values=pixels))


def gradients(model, pixels: torch.Tensor, of=None) -> dict[str, torch.Tensor]:
    output = model(pixel_values=pixels)
    names = ("pose_encoding", "hand_state", "presence_logits")
    sum(output[name].float().square().mean() for name in names).backward()
    return {n: p.grad for n, p in (of or model).named_parameters() if p.requires_grad}


def compare_gradients(got: dict[str, torch.Tensor], expected: dict[str, torch.Tensor]) -> None:
    assert got.keys() == expected.keys()
    for name, gradient in expected.items():
        assert gradient is not None, name
        torch.testing.assert_close(got[name], gradient, atol=1e-6, rtol=1e-4, msg=name)


@pytest.mark.parametrize("use_reentrant", [False, True])
def test_checkpointed_gradients_are_the_plain_ones(model, pixels, use_reentrant):
    plain = copy.deepcopy(model).train()
    model.train().activation_checkpointing_enable({"use_reentrant": use_reentrant})
    compare_gradients(gradients(model, pixels), gradients(plain, pixels))


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_at_half_precision_the_camera_head_stays_in_float32(model, pixels, folder, dtype):
    half = MintModel.from_pretrained(folder, dtype=dtype).eval()
    for name, tensor in half.state_dict().items():
        assert tensor.dtype == (torch.float32 if name.startswith("camera_head.") else dtype), name
    with torch.no_grad():
        output, expected = half(pixel_values=pixels), model(pixel_values=pixels)
    assert output.last_hidden_state.dtype == dtype
    assert output.pose_encoding.dtype == output.hand_state.dtype == torch.float32
    assert all(output[name].isfinite().all() for name in (*TENSORS, "presence_logits"))
    assert_close(output, expected, tolerance=0.1)


def test_under_autocast_the_camera_head_stays_in_float32(model, pixels):
    with torch.no_grad(), torch.autocast("cpu", torch.bfloat16):
        output = model(pixel_values=pixels)
    assert output.pose_encoding.dtype == output.hand_state.dtype == torch.float32
    with torch.no_grad():
        assert_close(output, model(pixel_values=pixels), tolerance=0.1)


def test_hidden_states_and_attentions_are_the_ones_inside(model, pixels):
    model.set_attn_implementation("eager")
    with torch.no_grad():
        output = model(pixel_values=pixels, output_hidden_states=True, output_attentions=True)
    before, frame, whole = output.hidden_states
    batch, frames, tokens, width = before.shape
    assert output.last_hidden_state.shape == (batch, frames, tokens, 2 * width)
    torch.testing.assert_close(torch.cat([frame, whole], -1), output.last_hidden_state)
    within, across = output.attentions
    heads = model.config.num_attention_heads
    assert within.shape == (batch * frames, heads, tokens, tokens)
    assert across.shape == (batch, heads, frames * tokens, frames * tokens)
    for weights in (within, across):
        torch.testing.assert_close(weights.sum(-1), torch.ones(weights.shape[:-1]))


def test_a_tuple_holds_what_the_output_holds(model, pixels):
    with torch.no_grad():
        as_tuple = model(pixel_values=pixels, return_dict=False)
        output = model(pixel_values=pixels)
    assert isinstance(as_tuple, tuple)
    assert len(as_tuple) == len(output.to_tuple())
    assert torch.equal(as_tuple[0], output.last_hidden_state)


@pytest.mark.parametrize("device_map", ["cpu", "auto", {"": "cpu"}])
def test_loads_by_device_map(model, pixels, folder, device_map):
    if importlib.util.find_spec("accelerate") is None:
        with pytest.raises(ValueError, match="accelerate"):
            MintModel.from_pretrained(folder, device_map=device_map)
        return
    if device_map == "auto" and torch.cuda.is_available():
        pytest.skip("auto would choose the GPU")
    loaded = MintModel.from_pretrained(folder, device_map=device_map).eval()
    with torch.no_grad():
        assert_close(loaded(pixel_values=pixels), model(pixel_values=pixels))


def test_loads_onto_a_device(model, pixels, folder):
    with torch.device("cpu"):
        loaded = MintModel.from_pretrained(folder).eval()
    with torch.no_grad():
        assert_close(loaded(pixel_values=pixels), model(pixel_values=pixels), tolerance=0)


def test_given_tensors_are_not_checked_for_completeness(model):
    name = "camera_head.embed_pose.weight"
    given = {name: model.state_dict()[name], "no.such.tensor": torch.zeros(1)}
    loaded, info = MintModel.from_pretrained(
        None, config=model.config, state_dict=given, output_loading_info=True
    )
    assert torch.equal(loaded.state_dict()[name], given[name])
    assert set(info["missing_keys"]) == set(model.state_dict()) - {name}
    assert set(info["unexpected_keys"]) == {"no.such.tensor"}


def test_files_are_checked_for_completeness(model, folder):
    wider = MintConfig.from_pretrained(folder, presence_hidden_size=32)
    with pytest.raises(ValueError, match="of another shape: presence_head"):
        MintModel.from_pretrained(folder, config=wider)
    forgiving = {"ignore_mismatched_sizes": True}
    loaded = MintModel.from_pretrained(folder, config=wider, **forgiving)
    assert loaded.presence_head.queries.shape[-1] == 32
    deeper = MintConfig.from_pretrained(folder, fov_layers=2)
    with pytest.raises(ValueError, match=r"missing: fov_head\.layers\.1"):
        MintModel.from_pretrained(folder, config=deeper, **forgiving)
    loaded = MintModel.from_pretrained(folder, config=deeper, strict=False)
    for name, tensor in loaded.state_dict().items():
        if not name.startswith("fov_head.layers.1"):
            assert torch.equal(tensor, model.state_dict()[name]), name
