"""Weights load strictly; what does not fit is listed, from a folder or a LingBot-Map file."""

import json
import logging
import os

import pytest
import torch
from huggingface_hub.errors import StrictDataclassError
from safetensors.torch import load_file, save_file

from mint_hub.model.configuration_mint import MintConfig
from mint_hub.model.conversion_mint import config_from_layout, convert_checkpoint, load_lingbot
from mint_hub.model.modeling_mint import MintModel
from tests.model.golden import golden_config, release_folder


@pytest.fixture
def folder(golden_dir, tmp_path):
    return release_folder(golden_dir, tmp_path / "release")


def edit(folder, change):
    file = folder / "model.safetensors"
    tensors = load_file(file)
    change(tensors)
    save_file(tensors, file, metadata={"format": "pt"})


def test_missing_tensor_is_named(folder):
    edit(folder, lambda t: t.pop("hand_head.query"))
    with pytest.raises(ValueError, match=r"release.*1 missing: hand_head\.queries"):
        MintModel.from_pretrained(folder)


def test_unexpected_tensor_is_named(folder):
    edit(folder, lambda t: t.update(surplus=torch.zeros(1)))
    with pytest.raises(ValueError, match="1 unexpected: surplus"):
        MintModel.from_pretrained(folder)


def test_wrong_shape_is_named_with_both_shapes(folder):
    edit(folder, lambda t: t.update({"hand_head.query": torch.zeros(1, 8, 33)}))
    wanted = r"hand_head\.queries \(expected \(1, 8, 32\), got \(1, 8, 33\)\)"
    with pytest.raises(ValueError, match=wanted):
        MintModel.from_pretrained(folder)


def test_all_faults_are_listed_together(folder):
    def change(tensors):
        tensors.pop("hand_head.query")
        tensors["surplus"] = torch.zeros(1)

    edit(folder, change)
    with pytest.raises(ValueError, match=r"1 missing: .*1 unexpected"):
        MintModel.from_pretrained(folder)


@pytest.mark.parametrize("strict", [True, False])
def test_what_fits_loads_without_a_word(folder, strict, caplog):
    """Nor does transformers tell which layers are not spread over devices that nobody asked for."""
    for name in ("transformers", "mint_hub"):
        logging.getLogger(name).addHandler(caplog.handler)
    try:
        MintModel.from_pretrained(folder, strict=strict)
    finally:
        for name in ("transformers", "mint_hub"):
            logging.getLogger(name).removeHandler(caplog.handler)
    assert not caplog.records


def test_strict_can_be_waived(folder):
    edit(folder, lambda t: t.pop("hand_head.query"))
    model, info = MintModel.from_pretrained(folder, strict=False, output_loading_info=True)
    assert set(info["missing_keys"]) == {"hand_head.queries"}
    assert torch.isfinite(model.hand_head.queries).all()


@pytest.mark.parametrize("value", [float("nan"), float("inf")])
def test_broken_weights_are_refused(folder, value):
    def change(tensors):
        tensors["hand_head.query"][0, 3, 5] = value

    edit(folder, change)
    with pytest.raises(
        ValueError, match=r"release.*NaN or infinity in 1 tensors: hand_head\.queries"
    ):
        MintModel.from_pretrained(folder)


def test_wrong_config_is_refused_by_field(folder):
    config = json.loads((folder / "config.json").read_text())
    config["hidden_size"] = 33
    (folder / "config.json").write_text(json.dumps(config))
    with pytest.raises(ValueError, match="hidden_size"):
        MintModel.from_pretrained(folder)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("image_size", (379, 518)),
        ("image_size", (378,)),
        ("hand_hidden_size", 30),
        ("camera_heads", 5),
        ("camera_iterations", 0),
        ("window", 0),
        ("patch_size", 0),
        ("num_register_tokens", -1),
    ],
)
def test_sizes_that_do_not_fit_are_named(field, value):
    with pytest.raises(StrictDataclassError, match=field):
        MintConfig(**{field: value})


def test_config_of_another_project_is_not_ours(folder):
    (folder / "config.json").write_text('{"model_type": "llama", "hidden_size": 192}')
    with pytest.raises(ValueError, match=r"no config\.json of ours"):
        MintModel.from_pretrained(folder)


def test_file_cut_short_is_named(folder):
    weights = folder / "model.safetensors"
    weights.write_bytes(weights.read_bytes()[:5000])
    with pytest.raises(ValueError, match=r"release.*damaged or cut short"):
        MintModel.from_pretrained(folder)


def test_config_of_another_network_is_refused(folder):
    golden = MintConfig.from_pretrained(folder)
    golden.hand_hidden_size = 64
    with pytest.raises(ValueError, match="of another shape"):
        MintModel.from_pretrained(folder, config=golden)


def test_without_config_only_the_release_is_recognised(golden_dir, tmp_path):
    folder = release_folder(golden_dir, tmp_path / "bare", with_config=False)
    with pytest.raises(ValueError, match=r"bare.*pass config="):
        MintModel.from_pretrained(folder)
    model = MintModel.from_pretrained(folder, config=golden_config(golden_dir))
    assert model.config.hidden_size == 32
    layout = json.loads((golden_dir / "original_layout.json").read_text())
    assert config_from_layout(layout, "x").hidden_size == 1024


def test_folder_without_weights(tmp_path):
    with pytest.raises(FileNotFoundError, match="safetensors"):
        MintModel.from_pretrained(tmp_path)


def test_bf16_keeps_the_camera_head_in_fp32(folder):
    model = MintModel.from_pretrained(folder, dtype=torch.bfloat16).eval()
    assert {p.dtype for p in model.camera_head.parameters()} == {torch.float32}
    assert {p.dtype for p in model.aggregator.parameters()} == {torch.bfloat16}
    with torch.no_grad():
        output = model(pixel_values=torch.rand(1, 4, 3, 56, 70))
    assert output.pose_encoding.dtype == torch.float32
    assert torch.isfinite(output.hand_state).all()


def test_convert_can_change_precision(folder, tmp_path):
    convert_checkpoint(folder, tmp_path / "half", dtype="bfloat16")
    stored = load_file(tmp_path / "half/model.safetensors")
    assert stored["hand_head.queries"].dtype == torch.bfloat16
    assert stored["camera_head.empty_pose"].dtype == torch.float32
    with pytest.raises(ValueError, match="new or empty folder"):
        convert_checkpoint(folder, tmp_path / "half")


# --- LingBot-Map ----------------------------------------------------------------------------------


@pytest.fixture
def lingbot(golden_dir, tmp_path):
    """A checkpoint as LingBot-Map stores it: no `backbone.` prefix, a camera head of its own."""
    released = load_file(golden_dir / "original_checkpoint.safetensors")
    state = {
        k.removeprefix("backbone."): v
        for k, v in released.items()
        if k.startswith(("backbone.aggregator", "backbone.camera_head"))
    }
    path = tmp_path / "lingbot-map.pt"
    torch.save(state, path)
    return path, released


def test_lingbot_starts_encoder_and_aggregator(golden_dir, lingbot):
    path, released = lingbot
    model = MintModel(golden_config(golden_dir))
    before = {k: v.clone() for k, v in model.camera_head.state_dict().items()}
    report = load_lingbot(model, path)
    assert torch.equal(
        model.aggregator.frame_layers[0].attention.qkv.weight,
        released["backbone.aggregator.frame_blocks.0.attn.qkv.weight"],
    )
    assert all(torch.equal(v, before[k]) for k, v in model.camera_head.state_dict().items())
    assert all(k.startswith(("encoder.", "aggregator.")) for k in report["loaded"])
    assert report["unused"] == []
    assert len(report["loaded"]) + len(report["kept"]) == len(model.state_dict())


def test_lingbot_that_does_not_fit_is_refused(golden_dir, lingbot):
    path, _ = lingbot
    config = golden_config(golden_dir)
    config.aggregator_layers = 3
    with pytest.raises(ValueError, match=r"lingbot-map\.pt: \d+ tensors missing"):
        MintModel.from_lingbot_map(path, config)


def test_lingbot_runs_no_code(tmp_path):
    class Hostile:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "executed"),)

    torch.save({"aggregator.camera_token": Hostile()}, tmp_path / "evil.pt")
    with pytest.raises(ValueError, match=r"evil\.pt"):
        load_lingbot(MintModel(MintConfig.tiny(encoder_layers=1)), tmp_path / "evil.pt")
    assert not (tmp_path / "executed").exists()


def test_convert_lingbot(golden_dir, lingbot, tmp_path):
    golden_config(golden_dir).save_pretrained(tmp_path / "sizes")
    lines = convert_checkpoint(lingbot[0], tmp_path / "start", config=tmp_path / "sizes")
    assert lines[0].startswith("loaded: ")
    model = MintModel.from_pretrained(tmp_path / "start")
    assert torch.isfinite(model.hand_head.queries).all()
