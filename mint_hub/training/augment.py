"""Colours of a window changed at random, alike in all its frames: other cameras, other rooms.

Nothing moves, so labels stay as they are. A hook like this takes pictures and a generator and gives
pictures; `ColourAugmentation` is the one that comes with mint-hub.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

Augmentation = Callable[[torch.Tensor, np.random.Generator], torch.Tensor]
"""Pictures (T, 3, H, W) in [0, 1], and where the randomness comes from; pictures alike."""

_LUMA = (0.299, 0.587, 0.114)


@dataclass(frozen=True)
class ColourAugmentation:
    """Exposure, contrast, gamma, white balance, saturation and noise, drawn once a window.

    Attributes:
        exposure: largest change of brightness, as a factor's logarithm.
        contrast: largest change of contrast about the window's mean, alike.
        gamma: largest change of gamma, alike.
        white: largest change of each channel, alike.
        saturation: largest change of saturation, alike.
        noise: largest standard deviation of pixel noise.
        grey: share of windows without colour.

    """

    exposure: float = 0.35
    contrast: float = 0.25
    gamma: float = 0.25
    white: float = 0.12
    saturation: float = 0.4
    noise: float = 0.02
    grey: float = 0.05

    def __call__(self, pixels: torch.Tensor, rng: np.random.Generator) -> torch.Tensor:
        """Change pictures (T, 3, H, W) in [0, 1]; they stay in [0, 1]."""

        def factor(size: float, count: int = 1) -> torch.Tensor:
            return torch.from_numpy(np.exp(rng.uniform(-size, size, count)).astype(np.float32))

        x = pixels.clamp(0, 1) ** factor(self.gamma)
        light = factor(self.exposure) * factor(self.white, 3)
        mean = (x.mean((0, 2, 3)) * light).mean()
        contrast = factor(self.contrast)
        colour = torch.zeros(1) if rng.random() < self.grey else factor(self.saturation)
        # Contrast about the mean and saturation about the luma, in one matrix of colours.
        mixed = colour * torch.eye(3) + (1 - colour) * torch.tensor(_LUMA)
        x = (contrast * mixed * light) @ x.flatten(2)
        size, seed = float(rng.uniform(0, self.noise)), int(rng.integers(2**31))
        noise = torch.randn(x.shape, generator=torch.Generator().manual_seed(seed))
        x = x.add_((1 - contrast) * mean).add_(noise, alpha=size).clamp_(0, 1)
        return x.view(pixels.shape)
