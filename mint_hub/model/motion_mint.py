"""A cue of motion for small networks: where each patch was in the frame before.

Shape letters: B windows, T frames, N patches of a frame, C width, s the side of a patch.
"""

import torch
from torch import Tensor, nn

from .alignment_mint import Alignment, fit_field, peaks, terms_at
from .layers_mint import MintMLP, patch_centres

box_mean = nn.functional.avg_pool2d

SURROUND = 15
"""Side of the square whose mean and spread each pixel is measured by."""
SHARPNESS = 8.0
GAIN = 4.0
"""Of the softmax over differences, and of what it gives."""
SHIFT_UNIT = 8.0
"""Pixels that count as 1 in what layers are given; no more than MOST of these."""
MOST = 4.0
STEPS = (3, 2)
"""Of the walk to the best field of shifts, at half and at full size."""
CAMERA_FACTS = 14
"""Twelve coefficients of the field, how far pixels differ under it, and how many it explains."""
PATCH_FACTS = 5
"""The field's shift, what is beyond it, and how well that is seen."""


def around(pictures: Tensor, side: int) -> Tensor:
    """Mean of the square about each pixel, of what of it is in the picture."""
    for size, edge in (((side, 1), (side // 2, 0)), ((1, side), (0, side // 2))):
        pictures = box_mean(pictures, size, 1, edge, count_include_pad=False)
    return pictures


def describe(frames: Tensor, patch: int) -> Tensor:
    """Grey pixels without local brightness and contrast, patch by patch.

    (F, 3, H, W) in [0, 1] -> (F, N, s * s), float32, row by row.
    """
    grey = around(frames.float().mean(1, keepdim=True), 3)
    grey = grey - around(grey, SURROUND)
    grey = grey / (around(grey.square(), SURROUND) + 1e-3).sqrt()
    return nn.functional.unfold(grey, patch, stride=patch).mT


class MintMotionCue(nn.Module):
    """Tells patches and the camera token what moved since the frame before.

    Each patch learns how alike it is to each nearby place of the frame before: the correlation
    layer of FlowNet (Dosovitskiy et al. 2015), on pictures instead of features; and how far it
    moved, more exactly. The camera token learns the field of shifts of the whole picture, see
    `alignment_mint`.
    """

    def __init__(self, width: int, patch: int, radius: int):
        super().__init__()
        self.width, self.side, self.radius = width, patch, radius
        self.embed = nn.Linear((2 * radius + 1) ** 2, width)
        self.embed_shift = nn.Linear(PATCH_FACTS, width)
        self.mlp = MintMLP(width, 2 * width, width)
        self.camera_mlp = MintMLP(CAMERA_FACTS, 2 * width, width)

    def forward(self, described: Tensor, grid_hw: tuple[int, int]) -> tuple[Tensor, Tensor]:
        """(B, T, N, C + s * s), tokens and what `describe` says of them.

        Returns:
            Tokens (B, T, N, C) with their cue, and what to add to camera tokens (B, T, 1, C).
        """
        tokens, pixels = described.split([self.width, self.side**2], -1)
        with torch.no_grad(), torch.autocast(tokens.device.type, enabled=False):
            pictures = self.pictures(pixels, grid_hw)
            # The first frame of a window is its own predecessor.
            before = torch.cat([pictures[:, :1], pictures[:, :-1]], 1)
            whole = pictures.flatten(0, 1), before.flatten(0, 1)
            half = (box_mean(whole[0], 2), box_mean(whole[1], 2))
            costs = self.costs(*half)
            moved, patches = self.shifts(Alignment(*whole), Alignment(*half), costs, grid_hw)
        alike = (GAIN * (-SHARPNESS * costs).softmax(-1)).to(tokens.dtype)
        batch = tokens.shape[:2]
        cue = self.embed(alike) + self.embed_shift(patches.to(tokens.dtype))
        cue = cue.unflatten(0, batch)
        camera = self.camera_mlp(moved.to(tokens.dtype)).unflatten(0, batch)
        return tokens + cue + self.mlp(cue), camera[:, :, None]

    def pictures(self, pixels: Tensor, grid_hw: tuple[int, int]) -> Tensor:
        """What `describe` said of patches, (B, T, N, s * s) -> as pictures (B, T, 1, H, W)."""
        size = (grid_hw[0] * self.side, grid_hw[1] * self.side)
        patches = pixels.float().flatten(0, 1).mT
        now = nn.functional.fold(patches, size, self.side, stride=self.side)
        return now.unflatten(0, pixels.shape[:2])

    def costs(self, now: Tensor, before: Tensor) -> Tensor:
        """How each patch differs from each place near it in the frame before: (F, N, shifts).

        Shifts (dy, dx) row by row, each from -radius to radius, in the pixels of the pictures:
        those at half size.
        """
        (rows, columns), radius, half = now.shape[-2:], self.radius, self.side // 4
        wide = nn.functional.pad(before, (radius,) * 4, mode="replicate")
        steps = range(2 * radius + 1)
        differences = [
            box_mean((now - wide[..., y : y + rows, x : x + columns]).abs(), half)
            for y in steps
            for x in steps
        ]
        # A square of twice the patch's side about its middle, which is four halves wide.
        differences = box_mean(torch.cat(differences, 1), 4, 2, 1, count_include_pad=False)
        return differences.flatten(2).mT

    def shifts(
        self, whole: Alignment, half: Alignment, costs: Tensor, grid_hw: tuple[int, int]
    ) -> tuple[Tensor, Tensor]:
        """Facts for the camera token (F, CAMERA_FACTS), and for patches (F, N, PATCH_FACTS)."""
        places = patch_centres(grid_hw, costs.device)
        field = fit_field(*peaks(costs, self.radius), places)
        field = whole.refine(2 * half.refine(field, STEPS[0]), STEPS[1])
        beyond, seen, off, explained = whole.local(field, self.side)
        smooth = terms_at(*places) @ field
        patches = [_bounded(smooth), _bounded(beyond), seen[..., None] / MOST]
        moved = [_bounded(field.flatten(1)), torch.stack([off, explained], -1)]
        return torch.cat(moved, -1), torch.cat(patches, -1)


def _bounded(shifts_px: Tensor) -> Tensor:
    return (shifts_px / SHIFT_UNIT).clamp(-MOST, MOST)
