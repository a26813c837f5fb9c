"""The network reproduces the public release's numbers, whichever way its weights came in."""

import json

import pytest
import torch
from safetensors.torch import load_file

from mint_hub.model.configuration_mint import MintConfig
from mint_hub.model.conversion_mint import convert_checkpoint, rename_key
from mint_hub.model.modeling_mint import MintModel
from tests.model.golden import golden_config, release_folder

TOLERANCE = 1e-4
FIELDS = {
    "tokens": lambda o: o.last_hidden_state,
    "pose_enc": lambda o: o.pose_encoding,
    "hand_first_iteration": lambda o: o.initial_hand_state.flatten(2),
    "hand": lambda o: o.hand_state.flatten(2),
    "presence_logits": lambda o: o.presence_logits,
}


@pytest.fixture(scope="module")
def expected(golden_dir):
    return load_file(golden_dir / "expected.safetensors")


@pytest.fixture(scope="module")
def released(golden_dir, tmp_path_factory):
    folder = release_folder(golden_dir, tmp_path_factory.mktemp("release"))
    return MintModel.from_pretrained(folder).eval()


def check(model, expected):
    with torch.no_grad():
        output = model(pixel_values=expected["pixel_values"])
    for name, field in FIELDS.items():
        torch.testing.assert_close(field(output), expected[name], rtol=0, atol=TOLERANCE)
    for i, pose in enumerate(output.camera_iterations):
        wanted = expected[f"pose_enc_iter{i}"][..., :7]
        torch.testing.assert_close(pose, wanted, rtol=0, atol=TOLERANCE)


@pytest.mark.parametrize("attention", ["sdpa", "eager"])
def test_release_names(released, expected, attention):
    released.set_attn_implementation(attention)
    check(released, expected)
    released.set_attn_implementation("sdpa")


def test_converted_folder(golden_dir, expected, tmp_path):
    folder = release_folder(golden_dir, tmp_path / "release")
    lines = convert_checkpoint(folder, tmp_path / "ours")
    assert "241 tensors" in lines[-1]
    assert not any(k.startswith("backbone") for k in load_file(tmp_path / "ours/model.safetensors"))
    check(MintModel.from_pretrained(tmp_path / "ours").eval(), expected)


def test_names_can_be_written_back(released, golden_dir, tmp_path):
    released.save_pretrained(tmp_path, save_original_format=True)
    written = load_file(tmp_path / "model.safetensors")
    original = load_file(golden_dir / "original_checkpoint.safetensors")
    assert written.keys() == original.keys()
    assert all(torch.equal(written[k], original[k]) for k in original)


def test_patch_tokens_can_be_given(released, expected):
    pixels = expected["pixel_values"]
    with torch.no_grad():
        tokens = torch.cat([released.encode_frames(frame[None]) for frame in pixels.flatten(0, 1)])
        output = released(patch_tokens=tokens.unflatten(0, pixels.shape[:2]))
    torch.testing.assert_close(output.hand_state.flatten(2), expected["hand"], rtol=0, atol=1e-4)


def test_full_layout(golden_dir):
    """The full configuration has the release's 1,369 tensors, shape by shape, after renaming."""
    layout = json.loads((golden_dir / "original_layout.json").read_text())
    assert len(layout) == 1369
    with torch.device("meta"):
        model = MintModel(MintConfig.full())
    own = {key: list(tensor.shape) for key, tensor in model.state_dict().items()}
    assert own == {rename_key(key): shape for key, shape in layout.items()}
    assert sum(p.numel() for p in model.parameters()) == 1_139_622_184


def test_every_rename_is_used(golden_dir):
    from mint_hub.model import conversion_mint

    layout = json.loads((golden_dir / "original_layout.json").read_text())
    used = set()
    for key in layout:
        for pattern, replacement in conversion_mint.RENAMES:
            renamed = conversion_mint.re.sub(pattern, replacement, key)
            if renamed != key:
                used.add(pattern)
            key = renamed
    assert used == {pattern for pattern, _ in conversion_mint.RENAMES}
    ours = {rename_key(key) for key in layout}
    assert {rename_key(key) for key in ours} == ours, "our own names must come back unchanged"


def test_config_of_the_golden_network(golden_dir):
    assert golden_config(golden_dir).grid_hw == (4, 5)
