"""The MINT network once more, as plainly as it can be written: the yardstick for `forward.py`.

One function a part, over a state dict under our names; explicit softmax attention, separate
products for queries, keys and values, nothing cached, nothing fused, every window from its pixels.
"""

import math

import torch
from torch import Tensor
from torch.nn import functional as F

from mint_hub.model.configuration_mint import MintConfig

Weights = dict[str, Tensor]


def sub(weights: Weights, prefix: str) -> Weights:
    return {k[len(prefix) + 1 :]: v for k, v in weights.items() if k.startswith(prefix + ".")}


def linear(w: Weights, name: str, x: Tensor) -> Tensor:
    return x @ w[f"{name}.weight"].T + w[f"{name}.bias"]


def norm(w: Weights, name: str, x: Tensor, eps: float = 1e-5) -> Tensor:
    mean, variance = x.mean(-1, keepdim=True), x.var(-1, keepdim=True, unbiased=False)
    return (x - mean) / (variance + eps).sqrt() * w[f"{name}.weight"] + w[f"{name}.bias"]


def rope(x: Tensor, positions: Tensor) -> Tensor:
    """Rotate (B, h, L, d): first half by the row, second half by the column."""
    halves = []
    for half, position in zip(x.chunk(2, -1), positions.T, strict=True):
        quarter = half.shape[-1] // 2
        angle = position[:, None] * 100.0 ** (-torch.arange(quarter) / quarter)
        cos, sin = (torch.cat([f(angle)] * 2, -1).to(x.dtype) for f in (torch.cos, torch.sin))
        a, b = half.chunk(2, -1)
        halves.append(half * cos + torch.cat([-b, a], -1) * sin)
    return torch.cat(halves, -1)


def heads_of(x: Tensor, heads: int) -> Tensor:
    return x.unflatten(-1, (heads, -1)).transpose(1, 2)


def softmax_attention(q: Tensor, k: Tensor, v: Tensor, causal: bool = False) -> Tensor:
    scores = q @ k.transpose(-1, -2) / math.sqrt(q.shape[-1])
    if causal:
        later = torch.ones(scores.shape[-2:], dtype=torch.bool).triu(1)
        scores = scores.masked_fill(later, float("-inf"))
    return (scores.softmax(-1) @ v).transpose(1, 2).flatten(2)


def attention(w: Weights, x: Tensor, heads: int, positions=None, causal=False) -> Tensor:
    weights, biases = w["qkv.weight"].chunk(3), w["qkv.bias"].chunk(3)
    q, k, v = (heads_of(x @ a.T + b, heads) for a, b in zip(weights, biases, strict=True))
    if "q_norm.weight" in w:
        q, k = norm(w, "q_norm", q), norm(w, "k_norm", k)
    if positions is not None:
        q, k = rope(q, positions), rope(k, positions)
    return linear(w, "out", softmax_attention(q, k, v, causal))


def layer(w: Weights, x: Tensor, heads: int, eps=1e-5, positions=None, causal=False) -> Tensor:
    one = w.get("layer_scale1", torch.ones((), dtype=x.dtype))
    two = w.get("layer_scale2", torch.ones((), dtype=x.dtype))
    branch = attention(sub(w, "attention"), norm(w, "norm1", x, eps), heads, positions, causal)
    x = x + one * branch
    return x + two * linear(w, "mlp.fc2", F.gelu(linear(w, "mlp.fc1", norm(w, "norm2", x, eps))))


def encoder(w: Weights, config: MintConfig, frames: Tensor) -> Tensor:
    mean, std = (
        torch.tensor(v).view(3, 1, 1) for v in ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225))
    )
    images = ((frames - mean) / std).to(w["cls_token"].dtype)
    x = F.conv2d(
        images, w["patch_embedding.weight"], w["patch_embedding.bias"], stride=config.patch_size
    )
    rows, columns = x.shape[-2:]
    x = x.flatten(2).transpose(1, 2)
    cls, grid = w["position_embeddings"].split([1, config.position_grid**2], 1)
    if (rows, columns) != (config.position_grid,) * 2:
        grid = grid.float().unflatten(1, (config.position_grid,) * 2).permute(0, 3, 1, 2)
        grid = F.interpolate(grid, (rows, columns), mode="bicubic", antialias=True)
        grid = grid.flatten(2).transpose(1, 2)
    count = len(x)
    first = (w["cls_token"] + cls).expand(count, -1, -1)
    x = torch.cat([first, w["register_tokens"].expand(count, -1, -1), x + grid.to(x.dtype)], 1)
    for i in range(config.encoder_layers):
        x = layer(sub(w, f"layers.{i}"), x, config.num_attention_heads, 1e-6)
    return norm(w, "norm", x, 1e-6)[:, 1 + config.num_register_tokens :]


def aggregator(w: Weights, config: MintConfig, patches: Tensor, grid: tuple[int, int]) -> Tensor:
    batch, frames = patches.shape[:2]
    special = torch.cat([w["camera_token"], w["register_token"], w["scale_token"]], 2)
    special = torch.cat([special[:, :1], special[:, 1:].expand(-1, frames - 1, -1, -1)], 1)
    x = torch.cat([special.expand(batch, -1, -1, -1), patches], 2)
    rows, columns = torch.meshgrid(*(torch.arange(1, n + 1) for n in grid), indexing="ij")
    positions = torch.stack([rows.flatten(), columns.flatten()], -1)
    positions = torch.cat([torch.zeros(special.shape[2], 2), positions])
    tokens, heads = x.shape[2], config.num_attention_heads
    within = x
    for i in range(config.aggregator_layers):
        flat = x.reshape(batch * frames, tokens, -1)
        flat = layer(sub(w, f"frame_layers.{i}"), flat, heads, positions=positions)
        within = flat.reshape(batch, frames, tokens, -1)
        flat = within.reshape(batch, frames * tokens, -1)
        every = positions.repeat(frames, 1)
        flat = layer(sub(w, f"global_layers.{i}"), flat, heads, positions=every)
        x = flat.reshape(batch, frames, tokens, -1)
    return torch.cat([within, x], -1)


def modulate(x: Tensor, modulation: Tensor) -> Tensor:
    shift, scale, gate = modulation.chunk(3, -1)
    plain = (x - x.mean(-1, keepdim=True)) / (x.var(-1, keepdim=True, unbiased=False) + 1e-6).sqrt()
    return gate * (plain * (1 + scale) + shift) + x


def camera_head(w: Weights, config: MintConfig, tokens: Tensor) -> Tensor:
    tokens = norm(w, "token_norm", tokens.float())
    pose = None
    for _ in range(config.camera_iterations):
        seen = w["empty_pose"].expand(*tokens.shape[:2], -1) if pose is None else pose
        x = modulate(tokens, linear(w, "modulation", F.silu(linear(w, "embed_pose", seen))))
        for i in range(config.camera_layers):
            x = layer(sub(w, f"layers.{i}"), x, config.camera_heads, causal=True)
        step = linear(
            w, "pose_mlp.fc2", F.gelu(linear(w, "pose_mlp.fc1", norm(w, "layers_norm", x)))
        )
        pose = step if pose is None else pose + step
    return pose


def fov_head(w: Weights, config: MintConfig, tokens: Tensor) -> Tensor:
    x = linear(w, "input_proj", norm(w, "input_norm", tokens))
    for i in range(config.fov_layers):
        x = layer(sub(w, f"layers.{i}"), x, config.fov_heads)
    return F.softplus(linear(w, "output", norm(w, "output_norm", x)).float()) + 1e-4


def cross_attention(w: Weights, queries: Tensor, context: Tensor, heads: int) -> Tensor:
    (a, b, c), (d, e, f) = w["qkv.weight"].chunk(3), w["qkv.bias"].chunk(3)
    q, k, v = (
        heads_of(x @ m.T + n, heads)
        for x, m, n in ((queries, a, d), (context, b, e), (context, c, f))
    )
    return linear(w, "out", softmax_attention(q, k, v))


def rows_to_matrix(rows: Tensor) -> Tensor:
    a, b = rows[..., :3], rows[..., 3:]
    a = F.normalize(a, dim=-1)
    b = F.normalize(b - (a * b).sum(-1, keepdim=True) * a, dim=-1)
    return torch.stack([a, b, torch.linalg.cross(a, b)], -2)


def hand_head(w: Weights, config: MintConfig, tokens: Tensor) -> Tensor:
    batch, frames = tokens.shape[:2]
    context = norm(w, "token_norm", linear(w, "token_proj", tokens.flatten(0, 1)))
    state = None
    for _ in range(config.hand_iterations):
        seen = w["empty_state"].expand(len(context), 2, -1) if state is None else state
        seen = seen.to(context.dtype)
        condition = linear(w, "modulation", F.silu(linear(w, "embed_state", seen)))
        x = modulate(w["queries"].expand(len(context), -1, -1), condition.repeat_interleave(4, 1))
        x = x + cross_attention(sub(w, "cross_attention"), x, context, config.hand_heads)
        for i in range(config.hand_layers):
            x = layer(sub(w, f"layers.{i}"), x, config.hand_heads)
        x = norm(w, "out_norm", x).unflatten(1, (2, 4))
        kind = "absolute_heads" if state is None else "increment_heads"
        names = ("translation", "orientation", "pose", "shape")
        parts = [linear(w, f"{kind}.{n}", x[:, :, i]).float() for i, n in enumerate(names)]
        if state is None:
            state = torch.cat(parts, -1)
            continue
        turn = torch.cat(parts[1:3], -1).unflatten(-1, (16, 3))
        angle = turn.norm(dim=-1, keepdim=True).clamp_min(1e-6)
        limit = math.radians(30)
        turn = turn * (limit * torch.tanh(angle / limit) / angle)
        zero = torch.zeros_like(turn[..., 0])
        p, q, r = turn.unbind(-1)
        cross = torch.stack([zero, -r, q, r, zero, -p, -q, p, zero], -1).unflatten(-1, (3, 3))
        turned = rows_to_matrix(state[..., 3:99].unflatten(-1, (16, 6))) @ torch.matrix_exp(cross)
        rows = turned[..., :2, :].flatten(-3)
        state = torch.cat([state[..., :3] + parts[0], rows, state[..., 99:] + parts[3]], -1)
    return state.unflatten(0, (batch, frames))


def presence_head(w: Weights, config: MintConfig, patches: Tensor) -> Tensor:
    context = norm(w, "token_norm", linear(w, "token_proj", patches.flatten(0, 1)))
    queries = w["queries"].expand(len(context), -1, -1)
    found = cross_attention(sub(w, "cross_attention"), queries, context, config.presence_heads)
    logits = linear(w, "classifier", norm(w, "out_norm", queries + found)).squeeze(-1)
    return logits.float().unflatten(0, patches.shape[:2])


def plain_forward(weights: Weights, config: MintConfig, pixels: Tensor) -> dict[str, Tensor]:
    """(B, T, 3, H, W) -> pose (B, T, 7), fov, hands (B, T, 2, 109), presence logits."""
    patches = encoder(sub(weights, "encoder"), config, pixels.flatten(0, 1))
    patches = patches.unflatten(0, pixels.shape[:2])
    grid = (pixels.shape[-2] // config.patch_size, pixels.shape[-1] // config.patch_size)
    tokens = aggregator(sub(weights, "aggregator"), config, patches, grid)
    return {
        "pose": camera_head(sub(weights, "camera_head"), config, tokens[:, :, 0]),
        "fov": fov_head(sub(weights, "fov_head"), config, tokens[:, :, 0]),
        "hands": hand_head(sub(weights, "hand_head"), config, tokens),
        "presence": presence_head(
            sub(weights, "presence_head"), config, tokens[:, :, config.num_special_tokens :]
        ),
    }
