"""Windows with a prediction and its truth, for tests of the losses."""

import torch

from mint_hub.geometry import hand_state
from mint_hub.geometry.rotations import rotvec_to_matrix
from mint_hub.model.losses_mint import LossCase, LossSettings

SIZE_HW = (112, 140)


def random_hands(generator: torch.Generator, batch: int, frames: int) -> torch.Tensor:
    """Hands about 0.4 m before the camera, float64."""

    def draw(*tail: int) -> torch.Tensor:
        shape = (batch, frames, 2, *tail)
        return torch.randn(shape, generator=generator, dtype=torch.float64)

    return hand_state.HandState.from_matrices(
        0.05 * draw(3) + torch.tensor([0.0, 0.0, 0.4]),
        rotvec_to_matrix(draw(3)),
        rotvec_to_matrix(0.3 * draw(15, 3)),
        0.5 * draw(10),
    ).pack()


def random_camera(generator: torch.Generator, batch: int, frames: int) -> torch.Tensor:
    noise = torch.randn((batch, frames, 9), generator=generator, dtype=torch.float64)
    rest = torch.tensor([0.0, 0, 0, 0, 0, 0, 1, 1.0, 1.2], dtype=torch.float64)
    return rest + 0.05 * noise


def random_case(settings: LossSettings, seed: int = 0, batch: int = 2, frames: int = 5) -> LossCase:
    """Everything random, in float64; about two thirds of the hands are there."""
    generator = torch.Generator().manual_seed(seed)
    presence = torch.rand((batch, frames, 2), generator=generator) < 0.65
    presence[:, :3] = True
    prediction = {
        "pose_encoding": random_camera(generator, batch, frames),
        "hand_state": random_hands(generator, batch, frames),
        "presence_logits": torch.randn((batch, frames, 2), generator=generator).double(),
    }
    labels = {
        "pose_encoding": random_camera(generator, batch, frames),
        "hand_state": random_hands(generator, batch, frames),
        "presence": presence,
    }
    return LossCase(prediction, labels, settings, image_size_hw=SIZE_HW)
