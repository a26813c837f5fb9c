"""A second, closer look at each hand for small networks, whose patches are as large as a hand.

Shape letters: F frames, N patches of a frame, C width, S side of a crop in pixels.
"""

from typing import NamedTuple

import torch
from torch import Tensor, nn

from ..geometry.hand_state import HAND_STATE_SIZE
from .configuration_mint import CROP_PATCH
from .layers_mint import MintConvolutionalStem, patch_centres

SIDES = 2


class Crops(NamedTuple):
    """What was seen of hands: tokens (F, 2, C), and where they were looked for (F, 2, N)."""

    tokens: Tensor
    where: Tensor


class MintHandCrops(nn.Module):
    """Looks for both hands among the patches, cuts them out, and describes what it sees.

    Cutting is that of spatial transformers (Jaderberg et al. 2015), at one size and without a
    gradient to the place, which only the attention term of the loss teaches. The left hand is cut
    out mirrored, so that both look like right hands.
    """

    def __init__(self, width: int, side: int):
        super().__init__()
        self.side = side
        self.locate = nn.Linear(width, SIDES)
        self.stem = MintConvolutionalStem(width, CROP_PATCH, 2)
        self.join = nn.Linear((side // CROP_PATCH) ** 2 * width, width)
        self.place = nn.Linear(2, width)

    def forward(self, images: Tensor, tokens: Tensor, grid_hw: tuple[int, int]) -> Crops:
        """Normalised images (F, 3, H, W) and their patch tokens (F, N, C)."""
        where = self.locate(tokens).float().softmax(1).mT  # (F, 2, N)
        centre = self.centre(where, grid_hw)
        crops = self.cut(images, centre)  # (F, 2, 3, S, S)
        seen = self.stem(crops.flatten(0, 1).to(self.place.weight.dtype))
        seen = self.join(seen.flatten(1)).unflatten(0, (-1, SIDES))
        mirrored = centre * centre.new_tensor([[-1, 1], [1, 1]])
        return Crops(seen + self.place(mirrored.to(self.place.weight.dtype)), where)

    @staticmethod
    @torch.no_grad()
    def centre(where: Tensor, grid_hw: tuple[int, int]) -> Tensor:
        """Means (F, 2, 2) of squared shares, x and y in -1 to 1 over the picture."""
        share = where.square()
        return (
            share
            @ torch.stack(patch_centres(grid_hw, where.device), -1)
            / share.sum(-1, keepdim=True)
        )

    @torch.no_grad()
    def cut(self, images: Tensor, centre: Tensor) -> Tensor:
        """Squares (F, 2, 3, S, S) of images (F, 3, H, W) about centres (F, 2, 2), left mirrored."""
        height, width = images.shape[-2:]
        steps = torch.arange(self.side, device=images.device) - (self.side - 1) / 2
        x, y = steps.to(centre) * 2 / width, steps.to(centre) * 2 / height
        offsets = torch.stack(torch.meshgrid(x, y, indexing="xy"), -1)  # (S, S, 2), rows first
        offsets = torch.stack([offsets * offsets.new_tensor([-1, 1]), offsets])
        grid = centre[:, :, None, None] + offsets  # (F, 2, S, S, 2)
        crops = nn.functional.grid_sample(
            images, grid.flatten(1, 2), padding_mode="border", align_corners=False
        )
        return crops.unflatten(2, (SIDES, self.side)).transpose(1, 2)


def mirror_signs() -> Tensor:
    """Signs (2, 109) that turn both hands, told as right ones, into a left and a right one.

    Mirroring across x: of the translation x changes, of orientation M R M the entries between x and
    another axis; joint rotations and shape of a left hand are told mirrored as it is.
    """
    signs = torch.ones(SIDES, HAND_STATE_SIZE)
    signs[0, [0, 4, 5, 6]] = -1  # x; then of rows (xx xy xz) (yx yy yz) those with one x
    return signs
