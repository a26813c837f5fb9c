"""How a picture lies over another one: a smooth field of shifts, found by comparing pixels.

Shifts are down and right, in pixels: what is at (y, x) was at (y, x) + shift in the frame before. A
field is a polynomial of the second degree of the place, which is how a camera that turns shifts a
picture, and one that moves before a plane (Longuet-Higgins and Prazdny 1980): coefficients
(F, 6, 2) of 1, x, y, xx, xy, yy; x and y run from -1 to 1 from border to border.

Shape letters: F pictures, N patches of one, H W its size.
"""

import torch
from torch import Tensor, nn

from .layers_mint import patch_centres

POWERS = ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))
"""Of x and y in the six terms."""

OUTLIER_PX = 1.0
OUTLIER_GREY = 0.5
"""Differences from which a patch, or a pixel, counts for less: hands move on their own."""
FARTHEST_PX = 60.0
DAMPING = 1e-3
LOCAL_DAMPING = 2.0
"""Added to sums of squared slopes: flat patches stay where the field has them."""


def terms_at(x: Tensor, y: Tensor) -> Tensor:
    """Six terms (..., 6) of places."""
    return torch.stack([x**i * y**j for i, j in POWERS], -1)


def peaks(costs: Tensor, radius: int) -> tuple[Tensor, Tensor]:
    """Least of each patch's costs, between whole shifts too, and how sharp it is.

    (F, N, shifts), row by row -> shifts (F, N, 2) in steps of the costs, and
    weights (F, N): 0 where the least is at the border of what was tried.
    """
    side = 2 * radius + 1
    best = costs.argmin(-1)
    y, x = best.div(side, rounding_mode="floor"), best % side
    inside = (y > 0) & (y < side - 1) & (x > 0) & (x < side - 1)
    y, x = y.clamp(1, side - 2), x.clamp(1, side - 2)

    def cost(dy: int, dx: int) -> Tensor:
        return costs.gather(-1, ((y + dy) * side + x + dx)[..., None])[..., 0]

    middle = cost(0, 0)
    bends = [cost(-1, 0) + cost(1, 0) - 2 * middle, cost(0, -1) + cost(0, 1) - 2 * middle]
    down = (cost(-1, 0) - cost(1, 0)) / (2 * bends[0].clamp_min(1e-4))
    right = (cost(0, -1) - cost(0, 1)) / (2 * bends[1].clamp_min(1e-4))
    parts = torch.stack([down, right], -1).clamp(-0.5, 0.5)
    shifts = torch.stack([y, x], -1) - radius + parts
    return shifts, inside * torch.minimum(*bends).clamp_min(0) / (middle + 0.1)


def fit_field(shifts: Tensor, weights: Tensor, places: tuple[Tensor, Tensor]) -> Tensor:
    """Field nearest to the shifts (F, N, 2) of patches; those that disagree count for less."""
    terms = terms_at(*places)
    ridge = DAMPING * torch.eye(6, device=shifts.device)
    field = shifts.new_zeros(len(shifts), 6, 2)
    trust = weights
    for _ in range(3):
        weighted = (trust[..., None] * terms).mT
        field = torch.linalg.solve(weighted @ terms + ridge, weighted @ shifts)
        off = (shifts - terms @ field).norm(dim=-1)
        trust = weights / (1 + (off / OUTLIER_PX).square())
    return field


def with_slopes(pictures: Tensor) -> Tensor:
    """Grey (..., 1, H, W) -> grey, and its slopes down and right a pixel, (..., 3, H, W)."""
    down = nn.functional.pad((pictures[..., 2:, :] - pictures[..., :-2, :]) / 2, (0, 0, 1, 1))
    right = nn.functional.pad((pictures[..., 2:] - pictures[..., :-2]) / 2, (1, 1, 0, 0))
    return torch.cat([pictures, down, right], -3)


def robust_weight(off: Tensor, outlier: float) -> Tensor:
    """How much pixels count that differ by so much (Geman and McClure 1987)."""
    return 1 / (1 + (off / outlier).square()).square()


class Alignment:
    """Pictures (F, 1, H, W) over those before them, and the field between, in their pixels.

    Gauss-Newton over all pixels (Lucas and Kanade 1981; Bergen et al. 1992), with outliers
    weighted down.
    """

    def __init__(self, now: Tensor, before: Tensor):
        self.size_hw = (now.shape[-2], now.shape[-1])
        self.now = now.flatten(1)
        self.before = with_slopes(before)
        x, y = patch_centres(self.size_hw, now.device)
        self.places = torch.stack([x, y], -1)
        self.terms = terms_at(x, y)
        powers = [(i, j) for i in range(5) for j in range(5 - i)]
        self.products = torch.stack([x**i * y**j for i, j in powers], -1)
        self.product_of = torch.tensor(
            [[powers.index((a + c, b + d)) for c, d in POWERS] for a, b in POWERS],
            device=now.device,
        )

    def look(self, field: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Differences, slopes down and right, and weights under a field: (F, H * W) each."""
        height, width = self.size_hw
        shifts = self.terms @ field
        grid = self.places + torch.stack(
            [shifts[..., 1] * 2 / width, shifts[..., 0] * 2 / height], -1
        )
        seen = nn.functional.grid_sample(
            self.before, grid.unflatten(1, self.size_hw), align_corners=False
        )
        grey, down, right = seen.flatten(2).unbind(1)
        off = grey - self.now
        inside = (grid.abs() < 1 - 2 / width).all(-1)
        return off, down, right, inside * robust_weight(off, OUTLIER_GREY)

    def refine(self, field: Tensor, steps: int) -> Tensor:
        """Walk from a field (F, 6, 2) to a better one."""
        for _ in range(steps):
            off, down, right, weight = self.look(field)
            slopes = torch.stack([down * down, down * right, right * right], 1) * weight[:, None]
            dd, dr, rr = (slopes @ self.products)[..., self.product_of].unbind(1)
            square = torch.cat([torch.cat([dd, dr], -1), torch.cat([dr, rr], -1)], -2)
            mean = square.diagonal(dim1=-2, dim2=-1).mean(-1)[:, None, None]
            square = square + (DAMPING * mean + 1e-6) * torch.eye(12, device=mean.device)
            pull = torch.stack([down, right], 1) * (weight * off)[:, None] @ self.terms
            step = torch.linalg.solve(square, pull.flatten(1))
            better = field - step.unflatten(1, (2, 6)).mT
            fine = better.isfinite().all((1, 2)) & (better.abs().amax((1, 2)) < FARTHEST_PX)
            field = torch.where(fine[:, None, None], better, field)
        return field

    def local(self, field: Tensor, patch: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """What a field leaves.

        Returns:
            What each patch shifts beyond it (F, N, 2), how well that is seen (F, N); the mean
            difference under it, and the share of pixels that it explains, (F,).
        """
        off, down, right, weight = self.look(field)
        parts = [down * down, down * right, right * right, down * off, right * off]
        sums = (torch.stack(parts, 1) * weight[:, None].sqrt()).unflatten(2, self.size_hw)
        pooled = nn.functional.avg_pool2d(sums, patch).flatten(2) * patch**2
        dd, dr, rr, pull_down, pull_right = pooled.unbind(1)
        dd, rr = dd + LOCAL_DAMPING, rr + LOCAL_DAMPING
        area = dd * rr - dr * dr
        shifts = [dr * pull_right - rr * pull_down, dr * pull_down - dd * pull_right]
        beyond = torch.stack(shifts, -1) / area[..., None]
        seen = torch.log1p(area.clamp_min(0).sqrt() / LOCAL_DAMPING)
        difference = (weight * off.abs()).sum(1) / weight.sum(1).clamp_min(1e-6)
        return beyond, seen, difference, weight.mean(1)
