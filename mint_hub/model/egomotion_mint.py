"""A window's camera path, made exact by its pictures: direct bundle adjustment.

From a path that is believed, poses and how near each patch of the middle frame is are walked to
where that frame's pixels look alike in all others (Alismail et al. 2016; Engel et al. 2018), by
Gauss-Newton with outliers weighted down. Pictures tell turns and directions well and lengths but
for one factor; what was believed has its weight in all of it (maximum a posteriori).

Places are in units of half a picture, -1 to 1, so that sizes do not matter. Nearness is 1 / depth.
Shape letters: B windows, T frames, S = T - 1 of them beside the middle one, N patches of it, Q
pixels of a patch, E = N Q.
"""

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, grid_sample, pad, unfold

from ..geometry.rotations import rotvec_to_matrix
from .alignment_mint import robust_weight, with_slopes
from .belief_mint import Belief, Prior, State, put_back, without
from .layers_mint import patch_centres

NEARNESS_SPREAD_PER_M = 2.0
"""Of patches about their mean, standard deviation."""
OUTLIER_GREY = (0.3, 0.18)
"""Differences from which a pixel counts for less, at half and at full size."""
NOISE_GREY = 0.08
NEARNESS_LIMITS_PER_M = (0.15, 8.0)
FARTHEST_STEP = 0.1
"""Radians, and as many metres, of one step."""
STEPS = (8, 10)
"""At half and at full size."""
STRONGEST = 24
"""Pixels of a patch that are looked at, those with the steepest slopes."""
NEAREST_DEPTH = 0.2
"""Of what is before the camera; less is taken as this."""


class Equations(NamedTuple):
    """Curvature and gradient of half the square error, U = 6 S + 2 unknowns that patches share.

    Attributes:
        square: (B, U, U), poses (turn and motion), mean nearness, lens.
        pull: (B, U).
        cross: (B, N, U), of each patch's nearness with these.
        firm: (B, N), of its nearness alone, and
        drawn: (B, N), gradient.
    """

    square: Tensor
    pull: Tensor
    cross: Tensor
    firm: Tensor
    drawn: Tensor


class Bundle:
    """The pixels of windows at one size of their pictures.

    Args:
        pictures: (B, T, 1, H, W).
        fov_vh: (B, 2) radians.
        patch: side of a patch, pixels.
        outlier: difference from which a pixel counts for less.
    """

    def __init__(self, pictures: Tensor, fov_vh: Tensor, patch: int, outlier: float):
        batch, (height, width) = len(pictures), pictures.shape[-2:]
        middle = pictures.shape[1] // 2
        units = torch.tensor([1, height / 2, width / 2], device=pictures.device)
        looks = with_slopes(pictures) * units[:, None, None]
        self.others = without(looks, middle)  # (B, S, 3, H, W)
        self.tangents = (fov_vh / 2).tan().flip(-1)[:, None, None]  # (B, 1, 1, 2)
        self.border, self.outlier = 1 - 2 / width, outlier
        x, y = patch_centres((height, width), pictures.device)
        places = torch.stack([x, y]).unflatten(1, (height, width)).expand(batch, -1, -1, -1)
        own = unfold(torch.cat([places, looks[:, middle]], 1), patch, stride=patch)
        own = own.unflatten(1, (5, -1)).permute(0, 3, 2, 1)  # (B, N, Q, 5)
        if own.shape[2] > STRONGEST:
            steep = own[..., 3:].square().sum(-1).topk(STRONGEST, -1).indices
            own = own.gather(2, steep[..., None].expand(-1, -1, -1, 5))
        self.patches = own.shape[1:3]
        self.places = own[..., :2].flatten(1, 2)[:, None]  # (B, 1, E, 2)
        self.grey = own[..., 2].flatten(1)[:, None]

    def look(self, state: State) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Pixels of the middle frame in the others.

        Returns:
            Differences and weights (B, S, E), and what a difference changes by: with the pose
            (turn, motion), (B, S, E, 6), with the nearness, and with the lens, (B, S, E).
        """
        near = self.pixels(state.near)[:, None, :, None]
        tangents = self.tangents * (-state.shared[:, 1]).exp()[:, None, None, None]
        rays = self.places * tangents
        turned = pad(rays, (0, 1), value=1.0) @ state.R.mT
        point = turned + state.t[:, :, None] * near
        depth = point[..., 2:].clamp_min(NEAREST_DEPTH)
        flat = point[..., :2] / depth
        at = flat / tangents
        seen = grid_sample(
            self.others.flatten(0, 1), at.flatten(0, 1)[:, None], align_corners=False
        )
        grey, down, right = seen[:, :, 0].unflatten(0, state.t.shape[:2]).unbind(2)
        off = grey - self.grey
        inside = (at.abs() < self.border).all(-1)
        weight = inside * robust_weight(off, self.outlier)
        slope = torch.stack([right, down], -1)
        by_lens = (slope * at).sum(-1)
        slope = slope / tangents / depth
        slope = torch.cat([slope, -(slope * flat).sum(-1, keepdim=True)], -1)
        by_pose = torch.cat([torch.linalg.cross(turned, slope), slope * near], -1)
        by_lens = by_lens - (slope * (rays @ state.R[..., :2].mT)).sum(-1)
        return off, weight, by_pose, (slope * state.t[:, :, None]).sum(-1), by_lens

    def equations(self, state: State, prior: Prior) -> Equations:
        """What one step of Gauss-Newton solves."""
        with torch.no_grad():
            off, weight, by_pose, by_near, by_lens = self.look(state)
        others = state.t.shape[1]
        weight = weight * self.pixels(prior.trust)[:, None] / NOISE_GREY**2
        weighted = by_pose * weight[..., None]
        pull = (weighted * off[..., None]).sum(2) + prior.pull(state)
        own = torch.eye(others, device=off.device)[:, None, :, None]
        square = (weighted.mT @ by_pose)[:, :, :, None] * own  # (B, S, 6, S, 6)
        square = square.flatten(3).flatten(1, 2) + prior.square()
        cross = self.sums(weighted * by_near[..., None]).transpose(1, 2).flatten(2)  # (B, N, 6 S)

        # Two more unknowns: the mean nearness, which all patches keep to, and the lens.
        stiff = NEARNESS_SPREAD_PER_M**-2.0
        apart = state.near - state.shared[:, :1]
        bent = weight * by_lens
        lens = torch.stack([(bent * off).sum((1, 2)), (bent * by_lens).sum((1, 2))], -1)
        of_both = torch.stack([-stiff * apart.sum(1), lens[:, 0]], -1)
        of_both = of_both + prior.firm * (state.shared - prior.shared)
        pull = torch.cat([pull.flatten(1), of_both], 1)
        corner = prior.firm + torch.stack(
            [torch.full_like(lens[:, 1], stiff * apart.shape[1]), lens[:, 1]], -1
        )
        square = pad(square, (0, 2, 0, 2)) + torch.diag_embed(pad(corner, (square.shape[-1], 0)))
        side = pad((bent[..., None] * by_pose).sum(2).flatten(1), (0, 2))
        last = torch.eye(square.shape[-1], device=off.device)[-1]
        square = square + side[:, :, None] * last + (side[:, :, None] * last).mT
        near = (weight * by_near)[..., None] * torch.stack([by_near, off, by_lens], -1)
        firm, drawn, with_lens = self.sums(near).sum(1).unbind(-1)
        to_mean = torch.full_like(with_lens, -stiff)
        cross = torch.cat([cross, torch.stack([to_mean, with_lens], -1)], -1)
        firm, drawn = firm + stiff, drawn + stiff * apart
        return Equations(square, pull, cross, firm, drawn)

    def step(self, state: State, prior: Prior) -> State:
        """One step of Gauss-Newton.

        Each patch's nearness touches only its own pixels, so that it is solved for within the
        system of poses (the Schur complement of bundle adjustment; Triggs et al. 2000).
        """
        square, pull, cross, firm, drawn = self.equations(state, prior)
        others = state.t.shape[1]
        shared = cross / firm[..., None]
        rest = pull - (shared * drawn[..., None]).sum(1)
        move = -torch.linalg.solve(square - shared.mT @ cross, rest)
        nearer = -(drawn + (cross @ move[..., None])[..., 0]) / firm
        moves = move[:, :-2].nan_to_num(0.0).clamp(-FARTHEST_STEP, FARTHEST_STEP)
        turn, moved = moves.unflatten(1, (others, 6)).split([3, 3], -1)
        return State(
            rotvec_to_matrix(turn) @ state.R,
            state.t + moved,
            (state.near + nearer.nan_to_num(0.0)).clamp(*NEARNESS_LIMITS_PER_M),
            state.shared + move[:, -2:].nan_to_num(0.0).clamp(-FARTHEST_STEP, FARTHEST_STEP),
        )

    def pixels(self, values: Tensor) -> Tensor:
        """Of patches (B, N) -> of their pixels (B, E)."""
        return values.repeat_interleave(self.patches[1], 1)

    def sums(self, values: Tensor) -> Tensor:
        """Of pixels (B, S, E, C) -> over those of a patch (B, S, N, C)."""
        return values.unflatten(2, self.patches).sum(3)


def refine_path(pictures: Tensor, belief: Belief, patch: int) -> tuple[Tensor, Tensor, Tensor]:
    """Walk from the path that is believed to the one that pictures and belief agree on.

    Gradients reach the belief through the last step: where steps have ended, that is how the path
    depends on it (implicit function theorem); the field of view is believed but for a factor.

    Args:
        pictures: (B, T, 1, H, W) grey, without local brightness and contrast (`describe`).
        belief: the path, and how sure of it one is.
        patch: side of a patch, pixels, even.

    Returns:
        Poses T_camera_from_world as rotations (B, T, 3, 3) and translations (B, T, 3), metres, the
        first frame's as it was believed; and the field of view (B, 2), radians.
    """
    batch, frames = belief.t.shape[:2]
    if frames == 1:
        return belief.R, belief.t, belief.fov_vh
    prior, fov_vh = Prior(belief), belief.fov_vh.detach()
    state = prior.start()
    with torch.no_grad():
        half = avg_pool2d(pictures.flatten(0, 1), 2).unflatten(0, (batch, frames))
        coarse = Bundle(half, fov_vh, patch // 2, OUTLIER_GREY[0])
        fine = Bundle(pictures, fov_vh, patch, OUTLIER_GREY[1])
        for bundle in [coarse] * STEPS[0] + [fine] * (STEPS[1] - 1):
            state = bundle.step(state, prior)
    state = fine.step(state, prior)
    same = torch.eye(3).to(state.R).expand(batch, 1, 3, 3)
    R = put_back(state.R, same, prior.middle)
    t = put_back(state.t, torch.zeros_like(state.t[:, :1]), prior.middle)
    turn = R[:, :1].mT @ belief.R[:, :1]
    moved = R[:, :1].mT @ (belief.t[:, :1] - t[:, :1])[..., None]
    tangents = (belief.fov_vh / 2).tan() * (-state.shared[:, 1:]).exp()
    return R @ turn, t + (R @ moved)[..., 0], 2 * tangents.atan()
