"""What is believed of a camera's path and its surroundings, before its pictures are laid over each
other, and how much that weighs (`egomotion_mint`).

Shape letters: B windows, T frames, S = T - 1 of them beside the middle one, N patches of it.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from ..geometry.rotations import matrix_to_rotvec

ACCELERATION_M = 0.003
"""Of a worn camera from frame to frame, standard deviation about 0."""


class Belief(NamedTuple):
    """What is believed of a window before its pictures are laid over each other.

    Attributes:
        R: (B, T, 3, 3), and
        t: (B, T, 3), metres: poses T_camera_from_world.
        turn_rad: (B,), and
        move_m: (B,): how far each motion from frame to frame may be off, standard deviations.
        near_per_m: (B,) mean nearness of patches, and
        near_spread_per_m: (B,): of that mean, standard deviation.
        lens_spread: (B,): of the logarithm of the focal length, standard deviation.
        trust: (B, N), 0 to 1: how much each patch of the middle frame stands still.
        fov_vh: (B, 2) radians.
    """

    R: Tensor
    t: Tensor
    turn_rad: Tensor
    move_m: Tensor
    near_per_m: Tensor
    near_spread_per_m: Tensor
    lens_spread: Tensor
    trust: Tensor
    fov_vh: Tensor


class State(NamedTuple):
    """Where a walk is: poses from the middle frame (B, S, 3, 3), (B, S, 3); nearness of patches
    (B, N); its mean, and the logarithm of how much longer the lens is than believed, (B, 2).
    """

    R: Tensor
    t: Tensor
    near: Tensor
    shared: Tensor


class Prior:
    """The weight of a belief."""

    def __init__(self, belief: Belief):
        self.middle = belief.t.shape[1] // 2
        R = belief.R @ belief.R[:, self.middle, None].mT
        t = belief.t - (R @ belief.t[:, self.middle, None, :, None])[..., 0]
        self.R, self.t = without(R, self.middle), without(t, self.middle)
        steps = without(torch.eye(t.shape[1], device=t.device).diff(dim=0), self.middle)
        moves, bends = (d.mT @ d for d in (steps, steps.diff(dim=0)))
        self.turns = moves / belief.turn_rad.square()[:, None, None]  # (B, S, S)
        self.moves = moves / belief.move_m.square()[:, None, None]
        self.bends = bends / ACCELERATION_M**2
        self.shared = torch.stack([belief.near_per_m, torch.zeros_like(belief.near_per_m)], -1)
        self.firm = torch.stack([belief.near_spread_per_m, belief.lens_spread], -1) ** -2.0
        self.trust = belief.trust

    def start(self) -> State:
        """The belief itself."""
        near = self.shared[:, :1].expand(self.trust.shape)
        return State(*(part.detach() for part in (self.R, self.t, near, self.shared)))

    def pull(self, state: State) -> Tensor:
        """Gradient of its half square distance to poses, (B, S, 6)."""
        turned = matrix_to_rotvec(state.R @ self.R.mT)
        moved = self.moves @ (state.t - self.t) + self.bends @ state.t
        return torch.cat([self.turns @ turned, moved], -1)

    def square(self) -> Tensor:
        """Its curvature, (B, 6 S, 6 S)."""
        parts = [self.turns] * 3 + [self.moves + self.bends] * 3
        rows = [
            torch.stack([part * (i == j) for j in range(6)], -1) for i, part in enumerate(parts)
        ]
        return torch.stack(rows, 2).flatten(3).flatten(1, 2)  # (B, S, 6, S, 6)


def without(values: Tensor, index: int) -> Tensor:
    """All but one of dimension 1."""
    return torch.cat([values[:, :index], values[:, index + 1 :]], 1)


def put_back(values: Tensor, one: Tensor, index: int) -> Tensor:
    """Put one back in dimension 1."""
    return torch.cat([values[:, :index], one, values[:, index:]], 1)
