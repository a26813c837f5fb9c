"""A cue of motion for small networks: where each patch was in the frame before.

Shape letters: B windows, T frames, N patches of a frame, C width, s half the side of a patch, in
which patches are compared: pictures at half size.
"""

import torch
from torch import Tensor, nn

from .layers_mint import MintMLP, patch_centres

box_mean = nn.functional.avg_pool2d

SURROUND = 7
"""Side of the square whose mean and spread each pixel is measured by, pixels at half size."""
SHARPNESS = 8.0
GAIN = 4.0
"""Of the softmax over differences, and of what it gives."""
MOMENTS = 18
"""Six polynomials of two shifts and of how sure they are."""


def describe(frames: Tensor, patch: int) -> Tensor:
    """Grey pixels at half size, without local brightness and contrast, patch by patch.

    (F, 3, H, W) in [0, 1] -> (F, N, s * s), float32, row by row, s = patch / 2.
    """
    around = {"stride": 1, "padding": SURROUND // 2, "count_include_pad": False}
    grey = box_mean(frames.float().mean(1, keepdim=True), 2)
    grey = grey - box_mean(grey, SURROUND, **around)
    grey = grey / (box_mean(grey.square(), SURROUND, **around) + 1e-4).sqrt()
    return nn.functional.unfold(grey, patch // 2, stride=patch // 2).mT


class MintMotionCue(nn.Module):
    """Tells patches and the camera token what moved since the frame before.

    Each patch learns how alike it is to each nearby place of the frame before: the correlation
    layer of FlowNet (Dosovitskiy et al. 2015), on pictures instead of features. The camera token
    learns the moments of the shifts over the picture up to second degree, as the picture of a scene
    shifts by polynomials of the second degree when a camera turns (Longuet-Higgins and Prazdny
    1980).
    """

    def __init__(self, width: int, patch: int, radius: int):
        super().__init__()
        self.width, self.side, self.radius = width, patch // 2, radius
        self.embed = nn.Linear((2 * radius + 1) ** 2, width)
        self.mlp = MintMLP(width, 2 * width, width)
        self.camera_mlp = MintMLP(MOMENTS, 2 * width, width)

    def forward(self, described: Tensor, grid_hw: tuple[int, int]) -> tuple[Tensor, Tensor]:
        """(B, T, N, C + s * s), tokens and what `describe` says of them.

        Returns:
            Tokens (B, T, N, C) with their cue, and what to add to camera tokens (B, T, 1, C).
        """
        tokens, pixels = described.split([self.width, self.side**2], -1)
        alike = self.likeness(pixels.float(), grid_hw)
        cue = self.embed((GAIN * alike).to(tokens.dtype))
        camera = self.camera_mlp((GAIN * self.moments(alike, grid_hw)).to(tokens.dtype))
        return tokens + cue + self.mlp(cue), camera[:, :, None]

    @torch.no_grad()
    def likeness(self, pixels: Tensor, grid_hw: tuple[int, int]) -> Tensor:
        """(B, T, N, s * s) -> (B, T, N, shifts), a distribution over shifts.

        Shift (dy, dx) of the frame before, row by row, each from -radius to radius, at half size.
        The first frame of a window is its own predecessor.
        """
        batch, frames = pixels.shape[:2]
        (rows, columns), side, radius = grid_hw, self.side, self.radius
        size = (rows * side, columns * side)
        now = nn.functional.fold(pixels.flatten(0, 1).mT, size, side, stride=side)
        now = now.unflatten(0, (batch, frames))  # (B, T, 1, h, w)
        before = torch.cat([now[:, :1], now[:, :-1]], 1).flatten(0, 1)
        now = now.flatten(0, 1)
        wide = nn.functional.pad(before, (radius,) * 4, mode="replicate")
        steps, half = range(2 * radius + 1), side // 2
        differences = [
            box_mean((now - wide[..., y : y + size[0], x : x + size[1]]).abs(), half)
            for y in steps
            for x in steps
        ]
        # A square of twice the patch's side about its middle, which is four halves wide.
        differences = box_mean(torch.cat(differences, 1), 4, 2, 1, count_include_pad=False)
        alike = (-SHARPNESS * differences).softmax(1).flatten(2).mT  # (BT, N, shifts)
        return alike.unflatten(0, (batch, frames))

    @torch.no_grad()
    def moments(self, alike: Tensor, grid_hw: tuple[int, int]) -> Tensor:
        """Moments (B, T, MOMENTS) of mean shifts, and of how sure they are, over the picture."""
        steps = torch.linspace(-1, 1, 2 * self.radius + 1, device=alike.device)
        shifts = torch.cartesian_prod(steps, steps)  # (shifts, 2), down and right
        x, y = patch_centres(grid_hw, alike.device)
        places = torch.stack([torch.ones_like(x), x, y, x * x, x * y, y * y], -1)  # (N, 6)
        sure = alike.square().sum(-1, keepdim=True)
        seen = torch.cat([sure * (alike @ shifts), sure], -1)  # (B, T, N, 3)
        total = sure.sum(-2, keepdim=True).clamp_min(1e-6)
        return (seen.mT @ places / total).flatten(-2)
