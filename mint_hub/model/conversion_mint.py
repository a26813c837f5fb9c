"""Checkpoints made elsewhere, under our names: the public release, and LingBot-Map as a start.

`RENAMES` is the one table from the release's tensor names to ours, applied from top to bottom. It
is registered with transformers, so that `MintModel.from_pretrained` reads either naming.
"""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from huggingface_hub import get_safetensors_metadata
from safetensors import SafetensorError, safe_open
from torch import Tensor
from transformers.conversion_mapping import register_checkpoint_conversion_mapping
from transformers.core_model_loading import WeightRenaming

from .configuration_mint import MintConfig

RENAMES: tuple[tuple[str, str], ...] = (
    # The trunk: in each family the rest first, then the named ones, so that either way round a name
    # is renamed once.
    (r"^backbone\.aggregator\.patch_embed\.(?!patch_embed\.|pos_embed|blocks\.)", "encoder."),
    (r"^backbone\.aggregator\.patch_embed\.patch_embed\.proj\.", "encoder.patch_embedding."),
    (r"^backbone\.aggregator\.patch_embed\.pos_embed", "encoder.position_embeddings"),
    (r"^backbone\.aggregator\.patch_embed\.blocks\.", "encoder.layers."),
    (r"^backbone\.aggregator\.(?!patch_embed\.|frame_blocks\.|global_blocks\.)", "aggregator."),
    (r"^backbone\.aggregator\.frame_blocks\.", "aggregator.frame_layers."),
    (r"^backbone\.aggregator\.global_blocks\.", "aggregator.global_layers."),
    (r"^backbone\.camera_head\.", "camera_head."),
    (r"^backbone\.fov_head\.", "fov_head."),
    (r"^hand_presence_head\.", "presence_head."),
    # Layers.
    (r"_head\.trunk\.", "_head.layers."),
    (r"\.attn\.qkv\.", ".attention.qkv."),
    (r"\.attn\.q_norm\.", ".attention.q_norm."),
    (r"\.attn\.k_norm\.", ".attention.k_norm."),
    (r"\.attn\.proj\.", ".attention.out."),
    (r"\.ls1\.gamma", ".layer_scale1"),
    (r"\.ls2\.gamma", ".layer_scale2"),
    # Heads.
    (r"camera_head\.empty_pose_tokens", "camera_head.empty_pose"),
    (r"camera_head\.trunk_norm\.", "camera_head.layers_norm."),
    (r"camera_head\.poseLN_modulation\.1\.", "camera_head.modulation."),
    (r"camera_head\.pose_branch\.", "camera_head.pose_mlp."),
    (r"^hand_head\.empty_pred", "hand_head.empty_state"),
    (r"^hand_head\.embed_pred\.", "hand_head.embed_state."),
    (r"^hand_head\.adaln_mod\.1\.", "hand_head.modulation."),
    (r"^hand_head\.query(?!s)", "hand_head.queries"),
    (r"presence_head\.query(?!s)", "presence_head.queries"),
    (r"\.cross_attn\.in_proj_weight", ".cross_attention.qkv.weight"),
    (r"\.cross_attn\.in_proj_bias", ".cross_attention.qkv.bias"),
    (r"\.cross_attn\.out_proj\.", ".cross_attention.out."),
    *(
        (rf"^hand_head\.{theirs}\.{i}\.", f"hand_head.{ours}.{part}.")
        for theirs, ours in (
            ("comp_heads", "absolute_heads"),
            ("refine_comp_heads", "increment_heads"),
        )
        for i, part in enumerate(("translation", "orientation", "pose", "shape"))
    ),
)
"""(pattern of the release's names, replacement), every one applied in order to every key.

Every pattern finds its tensors under their released names, and each step can be undone, so that
transformers can also write those (`save_pretrained(..., save_original_format=True)`)."""

RELEASE_MARKER = "backbone.aggregator.camera_token"
"""A tensor name that every checkpoint under the release's naming has, and none of ours."""


def rename_key(key: str) -> str:
    """Our name of a tensor of the release; our own names come back unchanged."""
    for pattern, replacement in RENAMES:
        key = re.sub(pattern, replacement, key)
    return key


def register_conversion(class_name: str = "MintModel") -> None:
    """Let `from_pretrained` of the named class read the release's tensor names."""
    register_checkpoint_conversion_mapping(
        class_name,
        [WeightRenaming(pattern, replacement) for pattern, replacement in RENAMES],
        overwrite=True,
    )


def read_layout(source: str | Path, **hub: Any) -> dict[str, tuple[int, ...]]:
    """Tensor names and shapes of `model.safetensors` in a folder or hub repository, headers only.

    Args:
        source: a folder, or a repository id.
        hub: `revision` and `token`, for a repository.

    Raises:
        FileNotFoundError: a folder without safetensors weights, naming the folder.
    """
    folder = Path(source)
    if not folder.is_dir():
        try:
            metadata = get_safetensors_metadata(str(source), **hub)
        except Exception as error:
            raise OSError(
                f"{source}: no such folder, and no weights could be read from a hub repository of "
                f"that name: {type(error).__name__}: {error}"
            ) from error
        return {
            key: tuple(info.shape)
            for file in metadata.files_metadata.values()
            for key, info in file.tensors.items()
        }
    files = sorted(folder.glob("*.safetensors"))
    if not files:
        raise FileNotFoundError(
            f"{folder}: expected model.safetensors, found no *.safetensors file"
        )
    layout: dict[str, tuple[int, ...]] = {}
    for file in files:
        try:
            handle = safe_open(file, "pt")
        except SafetensorError as error:
            raise ValueError(f"{file}: damaged or cut short: {error}") from error
        with handle:
            layout |= {k: tuple(handle.get_slice(k).get_shape()) for k in handle.keys()}  # noqa: SIM118
    return layout


def config_from_layout(layout: Mapping[str, tuple[int, ...]], source: object) -> MintConfig:
    """The configuration of a checkpoint that came without one: `full()`, if its shapes are those.

    Head counts cannot be read off shapes, so nothing but the released layout is ever guessed.

    Raises:
        ValueError: another layout, asking for `config=`.
    """
    from .modeling_mint import MintModel  # the model registers this module's table

    config = MintConfig.full()
    with torch.device("meta"):
        expected = {k: tuple(v.shape) for k, v in MintModel(config).state_dict().items()}
    got = {rename_key(key): tuple(shape) for key, shape in layout.items()}
    if got == expected:
        return config
    differing = sorted(expected.keys() ^ got.keys()) or sorted(
        key for key in expected if expected[key] != got[key]
    )
    first = differing[0]
    shapes = f"expected {expected.get(first, 'absent')}, got {got.get(first, 'absent')}"
    raise ValueError(
        f"{source}: has weights but no config.json of ours, and they are not the public release's "
        f"({len(differing)} tensors differ, first {first}: {shapes}). Head counts cannot be read "
        "off shapes: pass config=MintConfig(...)"
    )


def lingbot_state_dict(path: str | Path) -> dict[str, Tensor]:
    """Weights of a LingBot-Map checkpoint under our names, without its camera head.

    Args:
        path: `lingbot-map.pt`, a torch pickle; read with weights_only=True, so no code in it runs.

    Returns:
        Tensors of the encoder and the aggregator (and whatever else it holds, renamed alike).

    Raises:
        ValueError: not such a checkpoint.
    """
    try:
        state = torch.load(path, map_location="cpu", weights_only=True, mmap=True)
    except FileNotFoundError:
        raise
    except Exception as error:
        raise ValueError(f"{path}: expected a LingBot-Map torch checkpoint: {error}") from error
    for wrapper in ("model", "state_dict"):
        if isinstance(state, dict) and isinstance(state.get(wrapper), dict):
            state = state[wrapper]
    if not isinstance(state, dict) or "aggregator.camera_token" not in state:
        raise ValueError(
            f"{path}: expected a LingBot-Map state dict with 'aggregator.camera_token'; "
            f"got {sorted(state)[:5] if isinstance(state, dict) else type(state).__name__}"
        )
    return {
        rename_key(f"backbone.{key}"): tensor
        for key, tensor in state.items()
        if not key.startswith("camera_head") and isinstance(tensor, Tensor)
    }


def load_lingbot(model: torch.nn.Module, path: str | Path) -> dict[str, list[str]]:
    """Start a model from a LingBot-Map checkpoint: encoder and aggregator loaded, heads untouched.

    Args:
        model: a `MintModel`; its encoder and aggregator must fit the checkpoint.
        path: `lingbot-map.pt`.

    Returns:
        {"loaded": names now from the checkpoint, "kept": names that keep their initial values,
        "unused": names in the checkpoint that the model has no place for}, each sorted.

    Raises:
        ValueError: a tensor of the encoder or aggregator is missing or has another shape.
    """
    weights = lingbot_state_dict(path)
    own = model.state_dict()
    needed = [k for k in own if k.startswith(("encoder.", "aggregator."))]
    missing = [k for k in needed if k not in weights]
    wrong = [k for k in needed if k in weights and weights[k].shape != own[k].shape]
    if missing or wrong:
        first = (missing + wrong)[0]
        got = tuple(weights[first].shape) if first in weights else "absent"
        raise ValueError(
            f"{path}: {len(missing)} tensors missing and {len(wrong)} of another shape for this "
            f"configuration, first {first}: expected {tuple(own[first].shape)}, got {got}"
        )
    with torch.no_grad():
        for key in needed:
            own[key].copy_(weights[key])
    return {
        "loaded": sorted(needed),
        "kept": sorted(set(own) - set(needed)),
        "unused": sorted(set(weights) - set(needed)),
    }


def convert_checkpoint(
    source: str | Path,
    out: Path,
    *,
    config: str | Path | None = None,
    dtype: str | None = None,
    revision: str | None = None,
) -> list[str]:
    """Write a checkpoint made elsewhere as a folder in our format: config, weights, processor.

    Args:
        source: folder or hub repository with `model.safetensors` under either naming; or a
            LingBot-Map `.pt` file, whose encoder and aggregator are taken and whose heads start
            afresh (seed 0).
        out: folder to write; it must not exist yet, or be empty.
        config: a configuration (folder or `config.json`) for weights that come without one.
        dtype: "float32", "bfloat16" or "float16"; as stored when None.
        revision: of a hub repository.

    Returns:
        Lines that say what was read and written.

    Raises:
        ValueError: weights that do not fit, or an `out` that holds something.
        FileNotFoundError: no such source.
    """
    from .loading_mint import cast_weights, first_names
    from .modeling_mint import MintModel
    from .processing_mint import MintProcessor

    if out.exists() and any(out.iterdir()):
        raise ValueError(f"{out}: expected a new or empty folder, got one that holds files")
    if dtype not in (None, "float32", "bfloat16", "float16"):
        raise ValueError(f"dtype: expected float32, bfloat16 or float16, got {dtype!r}")
    sizes = None if config is None else MintConfig.from_pretrained(config)
    lines = []
    if str(source).endswith((".pt", ".pth", ".bin")):
        torch.manual_seed(0)
        model = MintModel(sizes or MintConfig.full())
        report = load_lingbot(model, source)
        lines += [f"{kind}: {len(names)} tensors" for kind, names in report.items()]
        lines.append(f"freshly initialised (seed 0): {first_names(report['kept'])}")
        if report["unused"]:
            lines.append(f"not used: {first_names(report['unused'])}")
    else:
        options = {} if revision is None else {"revision": revision}
        model = MintModel.from_pretrained(source, config=sizes, **options)
    if dtype is not None:
        cast_weights(model, getattr(torch, dtype))
    model.save_pretrained(out)
    MintProcessor.for_config(model.config).save_pretrained(out)
    parameters = sum(p.numel() for p in model.parameters())
    return [*lines, f"wrote {len(model.state_dict())} tensors, {parameters:,} parameters, to {out}"]
