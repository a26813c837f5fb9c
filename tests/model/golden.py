"""The golden network: its configuration in our names, and its checkpoint folder as released."""

import json
import shutil
from pathlib import Path

from mint_hub.model.configuration_mint import MintConfig


def golden_config(golden_dir: Path) -> MintConfig:
    """The tiny network behind the golden outputs."""
    sizes = json.loads((golden_dir / "config.json").read_text())
    return MintConfig(
        image_size=(sizes["H"], sizes["W"]),
        position_grid=sizes["img_size"] // 14,
        hidden_size=sizes["hidden"],
        num_attention_heads=sizes["heads"],
        encoder_layers=sizes["vit_depth"],
        aggregator_layers=sizes["agg_depth"],
        camera_layers=sizes["cam_depth"],
        camera_heads=sizes["cam_heads"],
        fov_hidden_size=sizes["fov_dim"],
        fov_heads=sizes["fov_heads"],
        hand_hidden_size=sizes["hand_dim"],
        hand_heads=sizes["hand_heads"],
        presence_hidden_size=sizes["presence_dim"],
    )


def release_folder(golden_dir: Path, folder: Path, with_config: bool = True) -> Path:
    """A folder laid out like the release: model.safetensors under its own tensor names."""
    folder.mkdir(parents=True, exist_ok=True)
    shutil.copy(golden_dir / "original_checkpoint.safetensors", folder / "model.safetensors")
    if with_config:
        golden_config(golden_dir).save_pretrained(folder)
    return folder
