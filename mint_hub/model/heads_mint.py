"""The four heads that read the aggregator's tokens: camera, field of view, hands, presence.

Shape letters: B batch, T frames, P tokens a frame, W = 2C width of the tokens, H head's own width.
"""

import math

import torch
from torch import Tensor, nn

from ..geometry import hand_state
from ..geometry.hand_state import HAND_STATE_SIZE, HandState
from ..geometry.rotations import matrix_to_quat_xyzw, quat_xyzw_to_matrix, rotvec_to_matrix
from .belief_mint import Belief
from .configuration_mint import MintConfig
from .crop_mint import mirror_signs
from .egomotion_mint import refine_path
from .layers_mint import MintCrossAttention, MintLayer, MintMLP

POSE_SIZE = 7
MAX_ROTATION_STEP = math.radians(30.0)
BELIEF = (math.radians(0.6), 0.004, 2.5, 0.75, 0.08)
"""Of a camera head's path, as long as nothing else was learned: a motion's turn (radians) and
length (metres) may be off by so much; patches are so near (1 / metres), on average, and that may be
off by so much; so may the logarithm of the focal length."""
MAX_LOG_BELIEF = 2.0
KNOWN_LENS_SPREAD = 1e-4
"""Of the logarithm of a focal length that is known."""
INITIAL_TRUST = -2.0
"""Logit."""
INITIAL_FOV_VH_DEG = (60.0, 75.0)
INITIAL_WRIST_M = (0.0, 0.0, 0.4)  # an arm's length before the camera
HAND_PARTS = {"translation": (3, 3), "orientation": (6, 3), "pose": (90, 45), "shape": (10, 10)}
"""Parts of a hand's state, in order: numbers when absolute, numbers of an increment."""


def modulate(x: Tensor, modulation: Tensor) -> Tensor:
    """x + gate * (norm(x) * (1 + scale) + shift), the norm without affine part, eps 1e-6."""
    shift, scale, gate = modulation.chunk(3, -1)
    normed = nn.functional.layer_norm(x, x.shape[-1:], eps=1e-6)
    return gate * (normed * (1 + scale) + shift) + x


def bounded_rotation(rotvec: Tensor) -> Tensor:
    """Rotation vectors (..., 3) -> matrices (..., 3, 3), angles bounded smoothly to 30 degrees."""
    angle = rotvec.square().sum(-1, keepdim=True).clamp_min(1e-12).sqrt()
    bound = MAX_ROTATION_STEP * torch.tanh(angle / MAX_ROTATION_STEP) / angle
    return rotvec_to_matrix(rotvec * bound)


def chained(motions: Tensor) -> Tensor:
    """Poses (B, T, 7) relative to the first frame of motions (B, T, 7) since the frame before.

    The first frame's motion is not used: it is where the window starts. T_k = D_k T_{k-1}, summed
    up over strides 1, 2, 4, ... (Hillis and Steele 1986).
    """
    R, t = quat_xyzw_to_matrix(motions[..., 3:], check=False), motions[..., :3, None]
    pose = torch.cat([R, t], -1)  # (B, T, 3, 4)
    pose = torch.cat([torch.eye(3, 4).to(pose).expand_as(pose[:, :1]), pose[:, 1:]], 1)
    stride, frames = 1, pose.shape[1]
    while stride < frames:
        before, after = pose[:, :-stride], pose[:, stride:]
        moved = after[..., :3] @ before
        moved = torch.cat([moved[..., :3], moved[..., 3:] + after[..., 3:]], -1)
        pose = torch.cat([pose[:, :stride], moved], 1)
        stride *= 2
    return torch.cat([pose[..., 3], matrix_to_quat_xyzw(pose[..., :3])], -1)


class MintCameraHead(nn.Module):
    """World-to-camera pose of each frame, refined over several iterations, causal in time, fp32."""

    def __init__(self, config: MintConfig):
        super().__init__()
        width = 2 * config.hidden_size
        self.iterations = config.camera_iterations
        self.output_scale = config.camera_output_scale
        self.chains = config.camera_relative_to == "previous"
        self.token_norm = nn.LayerNorm(width)
        self.empty_pose = nn.Parameter(torch.zeros(1, 1, POSE_SIZE))
        self.embed_pose = nn.Linear(POSE_SIZE, width)
        self.modulation = nn.Linear(width, 3 * width)
        self.layers = nn.ModuleList(
            MintLayer(
                width,
                config.camera_heads,
                layer_scale=config.aggregator_layer_scale,
                causal=True,
            )
            for _ in range(config.camera_layers)
        )
        self.layers_norm = nn.LayerNorm(width)
        self.pose_mlp = MintMLP(width, width // 2, POSE_SIZE)
        self.refinement = (
            MintPathRefinement(width, config.patch_size)
            if config.camera_refinement == "pictures"
            else None
        )

    def forward(self, camera_tokens: Tensor, implementation: str) -> tuple[Tensor, ...]:
        """(B, T, W) -> per iteration (B, T, 7): translation 3 (metres), quaternion xyzw 4 (raw)."""
        with torch.autocast(camera_tokens.device.type, enabled=False):
            tokens = self.token_norm(camera_tokens.to(self.token_norm.weight.dtype))
            poses: list[Tensor] = []
            for _ in range(self.iterations):
                seen = (
                    poses[-1].detach() if poses else self.empty_pose.expand(*tokens.shape[:2], -1)
                )
                condition = nn.functional.silu(self.embed_pose(seen))
                x = modulate(tokens, self.modulation(condition))
                for layer in self.layers:
                    x = layer(x, implementation)
                step = self.pose_mlp(self.layers_norm(x)) * self.output_scale
                poses.append(poses[-1] + step if poses else step)
            return tuple(chained(pose) for pose in poses) if self.chains else tuple(poses)


class MintPathRefinement(nn.Module):
    """Makes a path exact by its pictures, and learns what of them to believe.

    Which patches stand still, how far the path may be off, and how near things are; weights for
    bundle adjustment are learned through it as in DROID-SLAM (Teed and Deng 2021). The path itself
    does not learn through it: errors that pictures mend would teach it nothing.
    """

    def __init__(self, width: int, patch: int):
        super().__init__()
        self.patch = patch
        self.patch_norm = nn.LayerNorm(width)
        self.trust = MintMLP(width, width // 4, 1)
        self.camera_norm = nn.LayerNorm(width)
        self.belief = nn.Linear(width, len(BELIEF))

    def forward(
        self,
        pose: Tensor,
        fov_vh: Tensor,
        tokens: Tensor,
        pictures: Tensor,
        known_fov_vh: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Refine windows.

        Args:
            pose: (B, T, 7), as of the camera head.
            fov_vh: (B, T, 2) radians; one lens a window, their mean.
            tokens: (B, T, 1 + N, W), the camera's and the patches'.
            pictures: (B, T, 1, H, W), as of `describe`.
            known_fov_vh: (B, 2) radians, of a lens that is known; poses are refined under it.

        Returns:
            Poses (B, T, 7), and the field of view (B, 2) that pictures tell, also of a known lens.
        """
        with torch.autocast(tokens.device.type, enabled=False):
            tokens = tokens.to(self.belief.weight.dtype)
            middle = tokens[:, tokens.shape[1] // 2, 1:]
            trust = self.trust(self.patch_norm(middle))[..., 0].sigmoid()
            told = self.belief(self.camera_norm(tokens[:, :, 0]).mean(1))
            told = (MAX_LOG_BELIEF * torch.tanh(told / MAX_LOG_BELIEF)).exp()
            spreads = [usual * ratio for usual, ratio in zip(BELIEF, told.unbind(-1), strict=True)]
            t, quat = pose.detach().split([3, 4], -1)
            R = quat_xyzw_to_matrix(quat, check=False)
            belief = Belief(R, t, *spreads, trust, fov_vh.float().mean(1))
            R, t, fov = refine_path(pictures, belief, self.patch)
            if known_fov_vh is not None:
                fixed = torch.full_like(belief.lens_spread, KNOWN_LENS_SPREAD)
                belief = belief._replace(fov_vh=known_fov_vh.float(), lens_spread=fixed)
                R, t, _ = refine_path(pictures, belief, self.patch)
            return torch.cat([t, matrix_to_quat_xyzw(R)], -1), fov


class MintFovOutput(nn.Linear):
    """The last layer of the field-of-view head, a class of its own as it starts differently."""


class MintFovHead(nn.Module):
    """Vertical and horizontal field of view of each frame, bidirectional in time."""

    def __init__(self, config: MintConfig):
        super().__init__()
        width = config.fov_hidden_size
        self.input_norm = nn.LayerNorm(2 * config.hidden_size)
        self.input_proj = nn.Linear(2 * config.hidden_size, width)
        self.layers = nn.ModuleList(
            MintLayer(width, config.fov_heads) for _ in range(config.fov_layers)
        )
        self.output_norm = nn.LayerNorm(width)
        self.output = MintFovOutput(width, 2)

    def forward(self, camera_tokens: Tensor, implementation: str) -> Tensor:
        """(B, T, W) -> (B, T, 2) radians (vertical, horizontal), float32."""
        x = self.input_proj(self.input_norm(camera_tokens))
        for layer in self.layers:
            x = layer(x, implementation)
        return nn.functional.softplus(self.output(self.output_norm(x)).float()) + 1e-4


class MintHandHead(nn.Module):
    """The 109 numbers of both hands of each frame: absolute first, then refined by increments."""

    def __init__(self, config: MintConfig):
        super().__init__()
        width = config.hand_hidden_size
        self.iterations = config.hand_iterations
        last = config.num_special_tokens
        self.hand_slots = slice(last - config.num_hand_tokens, last)
        self.queries = nn.Parameter(torch.zeros(1, 2 * len(HAND_PARTS), width))
        self.empty_state = nn.Parameter(torch.zeros(1, 1, HAND_STATE_SIZE))
        self.token_proj = nn.Linear(2 * config.hidden_size, width)
        self.token_norm = nn.LayerNorm(width)
        self.embed_state = nn.Linear(HAND_STATE_SIZE, width)
        self.modulation = nn.Linear(width, 3 * width)
        self.cross_attention = MintCrossAttention(width, config.hand_heads)
        self.layers = nn.ModuleList(
            MintLayer(width, config.hand_heads) for _ in range(config.hand_layers)
        )
        self.out_norm = nn.LayerNorm(width)
        self.absolute_heads = nn.ModuleDict(
            {name: nn.Linear(width, size) for name, (size, _) in HAND_PARTS.items()}
        )
        self.increment_heads = nn.ModuleDict(
            {name: nn.Linear(width, size) for name, (_, size) in HAND_PARTS.items()}
        )

    def forward(
        self, tokens: Tensor, implementation: str, looks: list[Tensor] | None = None
    ) -> tuple[Tensor, ...]:
        """(B, T, P, W) -> per iteration (B, T, 2, 109), camera frame, metres, left hand first.

        To ``looks``, where given, what each iteration attends to is added: (BT, 8, P).
        """
        batch, frames = tokens.shape[:2]
        context = self.token_norm(self.token_proj(tokens.flatten(0, 1)))  # (BT, P, H)
        keys_values = self.cross_attention.project_context(context)
        queries = self.queries.expand(context.shape[0], -1, -1)  # (BT, 8, H)
        crops = context[:, self.hand_slots]  # (BT, 2, H), or none
        if crops.shape[1]:
            queries = queries + crops.repeat_interleave(len(HAND_PARTS), 1)
        states: list[Tensor] = []
        for _ in range(self.iterations):
            seen = states[-1].detach() if states else self.empty_state.expand(len(queries), 2, -1)
            condition = nn.functional.silu(self.embed_state(seen.to(queries.dtype)))
            modulation = self.modulation(condition).repeat_interleave(len(HAND_PARTS), 1)
            x = modulate(queries, modulation)
            x = x + self.cross_attention(x, keys_values, implementation, looks)
            for layer in self.layers:
                x = layer(x, implementation)
            x = self.out_norm(x).unflatten(1, (2, len(HAND_PARTS)))  # (BT, 8, H) -> (BT, 2, 4, H)
            states.append(
                self.refine(states[-1], x) if states else self.read(self.absolute_heads, x)
            )
        if crops.shape[1]:  # what was seen mirrored was told mirrored
            signs = mirror_signs().to(states[0])
            states = [state * signs for state in states]
        return tuple(state.unflatten(0, (batch, frames)) for state in states)

    @staticmethod
    def read(heads: nn.ModuleDict, x: Tensor) -> Tensor:
        """Features (..., 4, H) of the four parts -> their numbers, joined, float32."""
        parts = [heads[name](x[..., i, :]).float() for i, name in enumerate(HAND_PARTS)]
        return torch.cat(parts, -1)

    def refine(self, state: Tensor, x: Tensor) -> Tensor:
        """Add translation and shape increments; compose rotations on the right, R exp([w])."""
        step = self.read(self.increment_heads, x)
        translation, orientation, pose, shape = step.split([n for _, n in HAND_PARTS.values()], -1)
        before = hand_state.unpack(state)
        with torch.autocast(
            state.device.type, enabled=False
        ):  # rotations compose in full precision
            return HandState.from_matrices(
                before.translation + translation,
                before.orientation(check=False) @ bounded_rotation(orientation),
                before.joint_rotations(check=False) @ bounded_rotation(pose.unflatten(-1, (15, 3))),
                before.shape_params + shape,
            ).pack()


class MintPresenceHead(nn.Module):
    """Whether each hand is in the picture: one logit a side, from patch tokens alone."""

    def __init__(self, config: MintConfig):
        super().__init__()
        width = config.presence_hidden_size
        self.queries = nn.Parameter(torch.zeros(1, 2, width))
        self.token_proj = nn.Linear(2 * config.hidden_size, width)
        self.token_norm = nn.LayerNorm(width)
        self.cross_attention = MintCrossAttention(width, config.presence_heads)
        self.out_norm = nn.LayerNorm(width)
        self.classifier = nn.Linear(width, 1)

    def forward(
        self, patch_tokens: Tensor, implementation: str, looks: list[Tensor] | None = None
    ) -> Tensor:
        """(B, T, N, W) -> (B, T, 2) logits, left hand first, float32.

        To ``looks``, where given, what it attends to is added: (BT, 2, N).
        """
        batch, frames = patch_tokens.shape[:2]
        context = self.token_norm(self.token_proj(patch_tokens.flatten(0, 1)))
        queries = self.queries.expand(context.shape[0], -1, -1)
        keys_values = self.cross_attention.project_context(context)
        x = queries + self.cross_attention(queries, keys_values, implementation, looks)
        x = self.out_norm(x)
        return self.classifier(x).squeeze(-1).float().unflatten(0, (batch, frames))
