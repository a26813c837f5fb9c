"""Building blocks of the network: attention, rotary positions, and the pre-norm transformer layer.

Shape letters: B sequences, L tokens, C width, h heads, d = C / h.
"""

from collections.abc import Callable

import torch
from torch import Tensor, nn
from transformers.modeling_layers import GradientCheckpointingLayer
from transformers.modeling_utils import ALL_ATTENTION_FUNCTIONS

ROPE_BASE = 100.0
Rotary = tuple[Tensor, Tensor]
"""Cosines and sines, each (P, d), of one frame's tokens."""


def eager_attention(
    module: nn.Module,
    query: Tensor,
    key: Tensor,
    value: Tensor,
    attention_mask: Tensor | None = None,
    scaling: float | None = None,
    dropout: float = 0.0,
    is_causal: bool | None = None,
    **kwargs: object,
) -> tuple[Tensor, Tensor]:
    """Plain softmax attention, (B, h, L, d) -> (B, L, h, d), which also returns its weights."""
    scaling = query.shape[-1] ** -0.5 if scaling is None else scaling
    scores = query @ key.transpose(-1, -2) * scaling
    if attention_mask is not None:
        scores = scores + attention_mask
    if is_causal:
        later = torch.ones(scores.shape[-2:], dtype=torch.bool, device=scores.device).triu(1)
        scores = scores.masked_fill(later, float("-inf"))
    weights = nn.functional.dropout(scores.softmax(-1), dropout, module.training)
    return (weights @ value).transpose(1, 2), weights


def attend(
    module: nn.Module, query: Tensor, key: Tensor, value: Tensor, implementation: str, causal: bool
) -> tuple[Tensor, Tensor | None]:
    """Attention by the named implementation: (B, h, L, d) -> (B, L, h d), and weights."""
    interface: Callable[..., tuple[Tensor, Tensor | None]] = ALL_ATTENTION_FUNCTIONS.get_interface(
        implementation, eager_attention
    )
    output, weights = interface(
        module, query, key, value, None, scaling=query.shape[-1] ** -0.5, is_causal=causal
    )
    return output.flatten(2), weights


def rotary_positions(grid_hw: tuple[int, int], num_special: int, head_dim: int, device) -> Rotary:
    """Cosines and sines, each (P, d), of a frame's tokens: specials at (0, 0), patches from (1, 1).

    The head is split in two halves, the first turned by the row, the second by the column; within
    a half, feature i turns with feature i + d / 4 (2-D RoPE, axial form, base 100; Heo et al.
    2024).
    """
    rows, columns = grid_hw
    row = torch.arange(1, rows + 1, device=device).repeat_interleave(columns)
    column = torch.arange(1, columns + 1, device=device).repeat(rows)
    positions = torch.stack([row, column], -1)  # (N, 2)
    positions = torch.cat([positions.new_zeros(num_special, 2), positions]).float()
    quarter = head_dim // 4
    exponents = torch.arange(quarter, device=device, dtype=torch.float32) / quarter
    angles = positions[:, :, None] * ROPE_BASE**-exponents  # (P, 2, d/4)
    angles = torch.cat([angles, angles], -1).flatten(1)  # (P, d)
    return angles.cos(), angles.sin()


def patch_centres(grid_hw: tuple[int, int], device) -> tuple[Tensor, Tensor]:
    """Centres x and y of patches, (N,) each, row by row, in -1 to 1 over the picture."""
    y, x = (torch.linspace(1 / n - 1, 1 - 1 / n, n, device=device) for n in grid_hw)
    y, x = torch.meshgrid(y, x, indexing="ij")
    return x.flatten(), y.flatten()


def rotate(x: Tensor, rotary: Rotary) -> Tensor:
    """Apply rotary positions of one frame to x (B, h, L, d), L a whole number of frames."""
    cos, sin = (part.to(x.dtype) for part in rotary)
    frames = x.unflatten(2, (-1, cos.shape[0]))  # (B, h, L, d) -> (B, h, T, P, d)
    a, b, c, d = frames.chunk(4, -1)
    turned = torch.cat([-b, a, -d, c], -1)
    return (frames * cos + turned * sin).flatten(2, 3)


class MintAttention(nn.Module):
    """Self-attention with fused q, k, v; optionally LayerNorm on the heads of q and k, and RoPE."""

    def __init__(self, width: int, num_heads: int, *, qk_norm=False, causal=False, small=False):
        super().__init__()
        self.num_heads = num_heads
        self.is_causal = causal
        self.small = small
        self.qkv = nn.Linear(width, 3 * width)
        self.q_norm = nn.LayerNorm(width // num_heads) if qk_norm else None
        self.k_norm = nn.LayerNorm(width // num_heads) if qk_norm else None
        self.out = nn.Linear(width, width)

    def forward(self, x: Tensor, implementation: str, rotary: Rotary | None = None):
        """(B, L, C) -> (B, L, C), and the weights (B, h, L, L) if the implementation has them."""
        qkv = self.qkv(x).unflatten(-1, (3, self.num_heads, -1))  # (B, L, 3C) -> (B, L, 3, h, d)
        query, key, value = qkv.permute(2, 0, 3, 1, 4)  # 3 x (B, h, L, d)
        if self.q_norm is not None:
            query, key = self.q_norm(query).to(value.dtype), self.k_norm(key).to(value.dtype)
        if rotary is not None:
            query, key = rotate(query, rotary), rotate(key, rotary)
        if self.small:
            implementation = small_attention(implementation)
        output, weights = attend(self, query, key, value, implementation, self.is_causal)
        return self.out(output), weights


class MintCrossAttention(nn.Module):
    """Queries (B, Lq, C) reading context (B, Lk, C); one fused projection as in the release."""

    def __init__(self, width: int, num_heads: int):
        super().__init__()
        self.num_heads = num_heads
        self.qkv = nn.Linear(width, 3 * width)
        self.out = nn.Linear(width, width)

    def project_context(self, context: Tensor) -> tuple[Tensor, Tensor]:
        """Keys and values (B, h, Lk, d) of a context, to be used by several calls."""
        width = context.shape[-1]
        pair = nn.functional.linear(context, self.qkv.weight[width:], self.qkv.bias[width:])
        key, value = pair.unflatten(-1, (2, self.num_heads, -1)).permute(2, 0, 3, 1, 4)
        return key, value

    def forward(
        self,
        queries: Tensor,
        keys_values: tuple[Tensor, Tensor],
        implementation: str,
        looks: list[Tensor] | None = None,
    ):
        """(B, Lq, C) -> (B, Lq, C); weights (B, Lq, Lk), mean of heads, are added to ``looks``."""
        width = queries.shape[-1]
        query = nn.functional.linear(queries, self.qkv.weight[:width], self.qkv.bias[:width])
        query = query.unflatten(-1, (self.num_heads, -1)).transpose(1, 2)  # (B, h, Lq, d)
        implementation = small_attention("eager" if looks is not None else implementation)
        output, weights = attend(self, query, *keys_values, implementation, False)
        if looks is not None:
            looks.append(weights.float().mean(1))
        return self.out(output)


class MintConvolutionalStem(nn.Sequential):
    """(F, 3, H, W) -> (F, C, H / patch, W / patch): 3 x 3 convolutions that halve the picture.

    All but the last are followed by LayerNorm over channels and GELU; widths double up to C. The
    last two sizes have ``blocks`` residual blocks each.
    """

    def __init__(self, width: int, patch: int, blocks: int = 0):
        halvings = patch.bit_length() - 1
        widths = [3, *(max(width >> left, 1) for left in reversed(range(halvings)))]
        layers: list[nn.Module] = []
        for i in range(halvings):
            layers.append(nn.Conv2d(widths[i], widths[i + 1], 3, stride=2, padding=1))
            if i + 2 >= halvings:
                layers += [MintConvolutionalBlock(widths[i + 1]) for _ in range(blocks)]
            if i + 1 < halvings:
                layers += [MintChannelNorm(widths[i + 1], eps=1e-6), nn.GELU()]
        super().__init__(*layers)

    def forward(self, images: Tensor) -> Tensor:
        """Keep the channels of a pixel beside each other in memory, as the norms need them."""
        return super().forward(images.contiguous(memory_format=torch.channels_last))


class MintConvolutionalBlock(nn.Module):
    """x + conv(gelu(norm(conv(gelu(norm x))))), (F, C, h, w) -> (F, C, h, w) (He et al. 2016)."""

    def __init__(self, width: int):
        super().__init__()
        self.norm1 = MintChannelNorm(width, eps=1e-6)
        self.conv1 = nn.Conv2d(width, width, 3, padding=1)
        self.norm2 = MintChannelNorm(width, eps=1e-6)
        self.conv2 = nn.Conv2d(width, width, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        """Add the branch."""
        branch = self.conv1(nn.functional.gelu(self.norm1(x)))
        return x + self.conv2(nn.functional.gelu(self.norm2(branch)))


class MintChannelNorm(nn.LayerNorm):
    """LayerNorm over the channels of each pixel, (F, C, h, w) -> (F, C, h, w)."""

    def forward(self, x: Tensor) -> Tensor:
        """Normalise with channels last."""
        return super().forward(x.permute(0, 2, 3, 1)).permute(0, 3, 1, 2)


def small_attention(implementation: str) -> str:
    """Which implementation the heads use: eager where asked for, else SDPA.

    Their sequences are short and the camera head runs in float32, which flash kernels refuse.
    """
    return "eager" if implementation == "eager" else "sdpa"


class MintMLP(nn.Module):
    """Linear, GELU (erf), linear."""

    def __init__(self, width: int, hidden: int, output: int | None = None):
        super().__init__()
        self.fc1 = nn.Linear(width, hidden)
        self.fc2 = nn.Linear(hidden, output or width)

    def forward(self, x: Tensor) -> Tensor:
        """(..., C) -> (..., output)."""
        return self.fc2(nn.functional.gelu(self.fc1(x)))


class MintLayer(GradientCheckpointingLayer):
    """Pre-norm transformer layer: x + s1 attention(norm1 x), then x + s2 mlp(norm2 x)."""

    def __init__(
        self,
        width: int,
        num_heads: int,
        *,
        eps: float = 1e-5,
        layer_scale: float | None = None,
        qk_norm: bool = False,
        causal: bool = False,
        small: bool = True,
    ):
        super().__init__()
        self.norm1 = nn.LayerNorm(width, eps=eps)
        self.attention = MintAttention(
            width, num_heads, qk_norm=qk_norm, causal=causal, small=small
        )
        self.norm2 = nn.LayerNorm(width, eps=eps)
        self.mlp = MintMLP(width, 4 * width)
        self.initial_layer_scale = layer_scale
        for name in ("layer_scale1", "layer_scale2"):
            scale = None if layer_scale is None else nn.Parameter(torch.full((width,), layer_scale))
            self.register_parameter(name, scale)

    def forward(self, x: Tensor, implementation: str, rotary: Rotary | None = None) -> Tensor:
        """(B, L, C) -> (B, L, C)."""
        branch, _ = self.attention(self.norm1(x), implementation, rotary)
        x = x + (branch if self.layer_scale1 is None else branch * self.layer_scale1)
        branch = self.mlp(self.norm2(x))
        return x + (branch if self.layer_scale2 is None else branch * self.layer_scale2)


class MintEncoderLayer(MintLayer):
    """A layer of the patch encoder: tokens of one frame, no positions inside attention."""


class MintAggregatorLayer(MintLayer):
    """A layer of the aggregator, of either kind: (B, T, P, C) -> (B, T, P, C)."""


class MintFrameLayer(MintAggregatorLayer):
    """A layer of the aggregator within each frame: (B, T, P, C) -> (B, T, P, C)."""

    def forward(self, x: Tensor, implementation: str, rotary: Rotary | None = None) -> Tensor:
        """Attend over the P tokens of each of the B T frames."""
        return super().forward(x.flatten(0, 1), implementation, rotary).view_as(x)


class MintGlobalLayer(MintAggregatorLayer):
    """A layer of the aggregator over all frames of the window: (B, T, P, C) -> (B, T, P, C)."""

    def forward(self, x: Tensor, implementation: str, rotary: Rotary | None = None) -> Tensor:
        """Attend over the T P tokens of each window, in both directions of time."""
        return super().forward(x.flatten(1, 2), implementation, rotary).view_as(x)
