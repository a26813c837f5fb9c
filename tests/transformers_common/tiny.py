"""The network under test: one pair of layers, two windows of three frames."""

import torch

from mint_hub.geometry import hand_state
from mint_hub.model.configuration_mint import MintConfig


def tiny_config() -> MintConfig:
    return MintConfig(
        image_size=(28, 42),
        position_grid=3,
        hidden_size=32,
        num_attention_heads=2,
        encoder_layers=2,
        aggregator_layers=1,
        camera_layers=1,
        camera_heads=4,
        camera_iterations=2,
        fov_hidden_size=16,
        fov_heads=2,
        fov_layers=1,
        hand_hidden_size=32,
        hand_heads=2,
        presence_hidden_size=16,
        presence_heads=2,
        window=4,
    )


def tiny_input(config: MintConfig, seed: int = 0) -> torch.Tensor:
    """(B, T, 3, H, W) in [0, 1]."""
    return torch.rand(2, 3, 3, *config.image_size, generator=torch.Generator().manual_seed(seed))


def tiny_labels(batch: int, frames: int) -> dict[str, torch.Tensor]:
    """A camera that stands still, with both hands an arm's length before it."""
    camera = torch.tensor([0.0, 0, 0, 0, 0, 0, 1, 1.0, 1.3])
    hands = hand_state.absent((batch, frames, 2), like=camera)
    hands[..., 2] = 0.4
    return {
        "pose_encoding": camera.expand(batch, frames, -1),
        "hand_state": hands,
        "presence": torch.ones(batch, frames, 2, dtype=torch.bool),
    }
