"""A network small enough for every test, with weights that make its outputs vary."""

from pathlib import Path

import torch

from mint_hub.model.configuration_mint import MintConfig
from mint_hub.model.modeling_mint import MintModel

SIZES = {
    "image_size": (28, 42),
    "patch_size": 14,
    "patch_stem": "linear",
    "position_grid": 3,
    "hidden_size": 32,
    "num_attention_heads": 2,
    "encoder_layers": 1,
    "aggregator_layers": 1,
    "camera_layers": 1,
    "camera_heads": 4,
    "camera_relative_to": "first",
    "camera_output_scale": 1.0,
    "initializer": "release",
    "motion_radius": 0,
    "hand_crop_size": 0,
    "fov_hidden_size": 16,
    "fov_heads": 2,
    "hand_hidden_size": 32,
    "hand_heads": 2,
    "presence_hidden_size": 16,
}


def small_config(**overrides) -> MintConfig:
    return MintConfig.tiny(**(SIZES | overrides))


def small_model(seed: int = 0, **overrides) -> MintModel:
    """A random network whose presence logits take both signs over random frames."""
    torch.manual_seed(seed)
    model = MintModel(small_config(**overrides)).eval()
    with torch.no_grad():
        for parameter in model.presence_head.parameters():
            parameter.mul_(8)
    return model


def assert_loads_as_saved(model: MintModel, frames: torch.Tensor, folder: Path) -> None:
    """A network that is saved and loaded sees the same, bit for bit."""
    model.save_pretrained(folder)
    loaded = MintModel.from_pretrained(folder).eval()
    with torch.no_grad():
        mine, other = (m(frames).pose_encoding for m in (model, loaded))
    torch.testing.assert_close(other, mine, rtol=0, atol=0)
